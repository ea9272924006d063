"""Tables: exact as CSV, readable as Markdown."""

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import pandas as pd

from guiderail.models.errors import InputError
from guiderail.tools.files import write_atomically

Rows: TypeAlias = pd.DataFrame | Sequence[Mapping[str, Any]]


def table_text(rows: Rows) -> str:
    """Rows as CSV, the columns' names first. Numbers are written so that reading them gives the same number."""
    table = pd.DataFrame(rows, dtype=object)  # a whole number stays one in a column where some are unknown
    return table.to_csv(index=False, lineterminator="\n") if len(table.columns) else ""


def read_table(path: Path) -> pd.DataFrame:
    """A CSV file; an empty cell is NaN in a column of numbers and an empty word in one of words.

    Raises:
        InputError: if the file is missing or is no table.
    """
    if not path.is_file():
        raise InputError(f"{path} is missing: the run has no finished episode yet, or the file was moved")
    try:
        with path.open(newline="", encoding="utf-8") as file:
            if len({len(row) for row in csv.reader(file)}) != 1:
                raise ValueError("rows of unequal length")
        table = pd.read_csv(path, keep_default_na=False, na_values=[""])
    except (ValueError, csv.Error) as error:
        raise InputError(f"{path} is not a table of episodes: restore it, or train anew") from error
    words = table.select_dtypes(exclude="number").columns
    return table.assign(**{name: table[name].astype(object).fillna("") for name in words})


def write_table(path: Path, rows: Rows) -> Path:
    """The same rows as `path`.csv and as `path`.md; returns the latter."""
    table = pd.DataFrame(rows, dtype=object)
    write_atomically(path.with_suffix(".csv"), table_text(table).encode())
    lines = [[name.replace("_", " ") for name in table], ["---"] * len(table.columns)]
    lines += [[cell(value) for value in row] for row in table.itertuples(index=False)]
    write_atomically(path.with_suffix(".md"), "".join(f"| {' | '.join(line)} |\n" for line in lines).encode())
    return path.with_suffix(".md")


def cell(value: Any) -> str:
    """A value as a person reads it."""
    if isinstance(value, list | tuple):
        return ", ".join(map(str, value))
    if value is None or value is pd.NA or (isinstance(value, float) and value != value):
        return "–"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
