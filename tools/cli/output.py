"""Printed results of the `guiderail` command: JSON for programs, aligned text for users, messages on stderr."""

import json
import math
import sys
from collections.abc import Mapping
from typing import Any

import typer

COLUMN = 19  # characters of a value in a table with several columns


def print_message(sentence: str) -> None:
    """Print a message on standard error."""
    print(f"guiderail: {sentence}", file=sys.stderr, flush=True)


def print_progress(text: str) -> None:
    """Print a line on standard output at once."""
    print(text, flush=True)


def to_json(result: Mapping[str, Any]) -> str:
    """Return a result as JSON, with null for NaN and infinite numbers, which JSON does not have."""

    def convert(value: Any) -> Any:
        if isinstance(value, Mapping):
            return {key: convert(item) for key, item in value.items()}
        if isinstance(value, list | tuple):
            return [convert(item) for item in value]
        return None if isinstance(value, float) and not math.isfinite(value) else value

    return json.dumps(convert(result), allow_nan=False)


def print_result(result: Mapping[str, Any], as_json: bool, space: str = " ") -> None:
    """Print a result, with a column for every baseline policy in `baselines`.

    Args:
        result: Values by name.
        as_json: Whether one JSON object is printed instead.
        space: Replacement of an underscore in a name.
    """
    if as_json:
        typer.echo(to_json(result))
        return
    from guiderail.tools.evaluation.metrics import STATISTICS, SYMBOLS
    from guiderail.tools.tables import cell

    columns = [*result.get("baselines", ())]
    labels = {key: key if " " in key else key.replace("_", space) for key in result}
    units = {key: STATISTICS[key].unit for key in {*result} & {*STATISTICS}}
    labels |= {key: f"{labels[key]} [{unit}]" for key, unit in units.items() if unit in SYMBOLS}
    width = max(len(label) for label in labels.values())
    if columns:
        titles = ["policy", *("demonstration alone" if name == "demonstration" else name for name in columns)]
        typer.echo("  ".join([" " * width, *(f"{title:<{COLUMN}}" for title in titles)]).rstrip())
    for key, value in result.items():
        if key == "baselines" or any(key.startswith(f"{name}_") for name in (*columns, "demonstration")):
            continue
        cells = [cell(value), *(cell(result[f"{name}_{key}"]) for name in columns if f"{name}_{key}" in result)]
        typer.echo("  ".join([f"{labels[key]:<{width}}", *(f"{text:<{COLUMN}}" for text in cells)]).rstrip())
