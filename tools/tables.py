"""Tables: exact as CSV, and readable as Markdown."""

import csv
import io
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import pandas as pd

from guiderail.models.common.errors import InputError
from guiderail.models.common.files import read_bytes
from guiderail.tools.files import write_atomically

_INTEGER = re.compile(r"-?[0-9]{1,18}")
_NUMBER = re.compile(r"[-+]?([0-9]+(\.[0-9]*)?|\.[0-9]+)([eE][-+]?[0-9]+)?|-?inf|nan")

MAX_FILE_SIZE = 200_000_000  # largest CSV file [bytes]
_MAX_LIST = 1_000  # number of list elements that count as one row of a Parquet file
MAX_ROWS = 20_000_000  # largest number of rows of Parquet files that are read together

Rows: TypeAlias = pd.DataFrame | Sequence[Mapping[str, Any]]


def table_text(rows: Rows) -> str:
    """Return rows as CSV with a header; `read_table` returns the same numbers, bit for bit."""
    table = pd.DataFrame(rows, dtype=object)  # integers stay integers in a column with missing values
    return table.to_csv(index=False, lineterminator="\n") if len(table.columns) else ""


def read_table(path: Path) -> pd.DataFrame:
    """Read a CSV file.

    A column of only numbers and empty cells is numeric; its empty cells are NaN. A column of only True and False is
    boolean. All other columns are text; their empty cells are "".
    """
    if not path.is_file():
        raise InputError(f"{path} is missing: the run has no finished episode yet, or the file was moved")
    data = read_bytes(path, "table", MAX_FILE_SIZE)
    try:
        header, *rows = csv.reader(io.StringIO(data.decode("utf-8"), newline=""), strict=True)
        if not all(header) or len({*header}) != len(header):
            raise ValueError("missing or repeated names")
        columns = zip(*rows, strict=True) if rows else ([] for _ in header)
        return pd.DataFrame({name: _parse_column(cells) for name, cells in zip(header, columns, strict=True)})
    except (ValueError, csv.Error) as error:
        raise InputError(f"{path} is not a table of episodes: restore it, or train again") from error


def _parse_column(cells: Sequence[str]) -> pd.Series:
    """Return the cells of a column as integers, floats, booleans or text, the same type for all."""
    if all(map(_INTEGER.fullmatch, cells)):
        return pd.Series([*map(int, cells)], dtype=np.int64 if cells else object)
    if all(cell == "" or _NUMBER.fullmatch(cell) for cell in cells):
        return pd.Series([float(cell or "nan") for cell in cells])
    if {*cells} <= {"True", "False"}:
        return pd.Series([cell == "True" for cell in cells], dtype=object)
    return pd.Series(cells, dtype=object)


def check_parquet(files: Iterable[Path], max_rows: int = MAX_ROWS) -> None:
    """Check the numbers of rows in the footers of Parquet files, before memory is allocated for the rows."""
    import pyarrow as arrow
    import pyarrow.parquet as parquet

    num_rows = 0
    for file in files:
        try:
            if not file.is_file():  # reading a pipe would block
                raise InputError(f"{file} is not a regular file: restore it")
            metadata = parquet.read_metadata(file)
        except (arrow.ArrowException, OSError) as error:
            raise InputError(f"{file} is damaged: restore it, or record it again") from error
        groups = [metadata.row_group(number) for number in range(metadata.num_row_groups)]
        values = [group.column(number).num_values for group in groups for number in range(group.num_columns)]
        num_rows += max(metadata.num_rows, max(values, default=0) // _MAX_LIST)
    if num_rows > max_rows:
        raise InputError(f"{file} and the files before it have more than {max_rows} rows: read fewer files")


def write_table(path: Path, rows: Rows, summary: Rows | None = None) -> Path:
    """Write rows as CSV and Markdown, with the endings .csv and .md appended to `path`; return the Markdown file.

    With a `summary` the Markdown file has its rows instead.
    """
    table = pd.DataFrame(rows, dtype=object)
    # Not `with_suffix`, which would replace a part of a name such as "bound-0.5".
    csv_file, markdown_file = path.with_name(f"{path.name}.csv"), path.with_name(f"{path.name}.md")
    write_atomically(csv_file, table_text(table).encode())
    table = table if summary is None else pd.DataFrame(summary, dtype=object)
    lines = [[name.replace("_", " ") for name in table], ["---"] * len(table.columns)]
    lines += [[cell(value).replace("|", "\\|") for value in row] for row in table.itertuples(index=False)]
    write_atomically(markdown_file, "".join(f"| {' | '.join(line)} |\n" for line in lines).encode())
    return markdown_file


def cell(value: Any) -> str:
    """Return a value as text of a readable table: four significant digits, and a dash for a missing value."""
    if isinstance(value, list | tuple):
        return ", ".join(map(str, value))
    if value is None or value is pd.NA or (isinstance(value, float) and value != value):
        return "–"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
