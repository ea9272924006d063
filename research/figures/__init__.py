"""Figures and tables of the thesis, each reproduced as a picture and a table with its numbers."""

import inspect
import json
import shlex
import time
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

from guiderail.models.common.errors import InputError
from guiderail.models.common.registry import did_you_mean
from guiderail.tools.files import write_atomically
from research.figures.thesis import THESIS

# Function of each figure, in the module of its chapter; imported on use, so that listing figures is fast.
FIGURES = {
    **{f"table {n}": f"table_{n.replace('.', '_')}" for n in ("3.2", "3.3", "4.1")},
    "2.2": "figure_2_2",
    **{f"3.{n}": f"figure_3_{n}" for n in (4, 5, 6, 7, 8, 10, 11)},
    **{f"4.{n}": f"figure_4_{n}" for n in range(2, 9)},
    **{f"5.{n}": f"figure_5_{n}" for n in range(2, 11)},
}


def reproduce(
    figure: str, *, seeds: int = 3, episodes: int | None = None, out: Path = Path("reproductions")
) -> dict[str, Any]:
    """Reproduce one figure or table.

    Args:
        figure: Number of the figure or table in the thesis, such as "4.2" or "table 3.3".
        seeds: Number of training runs of each method; unused if the figure needs no training.
        episodes: Number of training episodes of each run; each figure has its own default.
        out: Folder of pictures, tables and runs. Finished runs in it are reused, also by other figures.

    Returns:
        `figure`, `picture`, `table`, the figure's own results, and the result in the thesis. A JSON file next to the
        table has the same entries, the command and the duration, for `python -m research.results`.

    Raises:
        InputError: For an unknown figure or a number out of range.
    """
    number = figure.lower().removeprefix("figure").strip()
    if number not in FIGURES:
        raise InputError(f"there is no figure {figure!r} to reproduce: {did_you_mean(number, FIGURES)}")
    if seeds < 1 or (episodes is not None and episodes < 1):
        raise InputError(f"a figure needs at least one seed and one episode, not {seeds} and {episodes}")
    if out.exists() and not out.is_dir():
        raise InputError(f"{out} is a file: name a folder with --out")
    make = find_figure(number)
    accepted = inspect.signature(make).parameters
    options: dict[str, Any] = {"seeds": seeds, "episodes": episodes}
    options = {name: value for name, value in options.items() if name in accepted and value is not None}
    started = time.perf_counter()
    result = {"figure": number, **make(out, **options), "the thesis": THESIS[number]}
    record = {
        "command": " ".join([figure_command(number), *(f"--{name} {value}" for name, value in options.items())]),
        "seconds": round(time.perf_counter() - started, 1),
        "seeds": options.get("seeds"),
        **result,
    }
    write_atomically(out / f"{FIGURES[number]}.json", json.dumps(record, indent=1, default=str).encode() + b"\n")
    return result


def figure_command(number: str) -> str:
    """Return the command that makes a figure with its defaults."""
    return f"python -m research.figures {shlex.quote(number)}"


def find_figure(number: str) -> Callable[..., dict[str, Any]]:
    """Return the function that makes a figure; `number` is a key of `FIGURES`."""
    chapter = number.removeprefix("table ").split(".")[0]
    return getattr(import_module(f"research.figures.chapter_{chapter}"), FIGURES[number])
