"""Demonstrations as people have them: files of `guiderail record`, a CSV with a header like `t,x,y,z`, a folder."""

import csv
from pathlib import Path

import pandas as pd

from guiderail.models.errors import InputError
from guiderail.models.primitives import Demonstrations

ENDINGS = (".npz", ".csv")


def load_demonstrations(path: Path) -> Demonstrations:
    """The demonstrations of a file, or of all files of a folder by their names.

    A CSV whose first column is the time and whose others are outputs is one demonstration.

    Raises:
        InputError: if there are none, or what is there makes no sense.
    """
    if path.is_dir():
        files = sorted(file for file in path.iterdir() if file.suffix in ENDINGS)
        if not files:
            raise InputError(f"there is no file {' or '.join(ENDINGS)} in {path}: name a folder of demonstrations")
        parts = [load_demonstrations(file) for file in files]
        for file, part in zip(files, parts, strict=True):
            if part.names != parts[0].names:
                raise InputError(
                    f"{file} has the outputs {', '.join(part.names)}, and {files[0].name} {', '.join(parts[0].names)}: "
                    "record the same ones in all of them"
                )
        times, outputs = ([one for part in parts for one in getattr(part, of)] for of in ("times", "outputs"))
        return Demonstrations(times, outputs, parts[0].names)
    if path.suffix != ".csv":
        return Demonstrations.load(path)
    try:
        with path.open(newline="", encoding="utf-8") as lines:
            header = next(csv.reader(lines), [])
        if [name.strip() for name in header[:2]] == ["demonstration", "time"]:
            return Demonstrations.load(path)
        table = pd.read_csv(path, skipinitialspace=True).astype(float)
    except (ValueError, OSError, csv.Error) as error:
        raise InputError(f"{path} is no table of numbers under a line of names such as t,x,y,z: {error}") from error
    if len(table.columns) < 2:
        raise InputError(f"{path} has one column: give the time first, then at least one output, such as t,x,y,z")
    if any(name.lstrip("+-").replace(".", "", 1).isdigit() for name in map(str, table.columns)):
        raise InputError(f"the first line of {path} has no names: begin it with a line such as t,x,y,z")
    try:
        return Demonstrations([table.iloc[:, 0]], [table.iloc[:, 1:]], [str(name) for name in table.columns[1:]])
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
