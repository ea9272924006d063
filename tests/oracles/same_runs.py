"""Comparison of two run folders or study folders, without wall-clock times."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
from safetensors import safe_open

CLOCKS = ("wall_time", "training_wall_time")
# Files that differ between equal runs.
IGNORED = {"logs", "replay.html", "learning_curve.png"}


def differences(first: Path, second: Path) -> list[str]:
    """Return a line for each difference between two folders.

    Tables are compared by cell without wall-clock times, checkpoints by array and value, other files by byte.
    """
    files = _files(first), _files(second)
    result = [f"{name} exists in one folder only" for name in sorted(files[0].keys() ^ files[1].keys())]
    for name in sorted(files[0].keys() & files[1].keys()):
        if _content(files[0][name]) != _content(files[1][name]):
            result.append(f"{name} differs")
    return result


def _files(folder: Path) -> dict[str, Path]:
    result = {str(path.relative_to(folder)): path for path in folder.rglob("*") if path.is_file()}
    return {name: path for name, path in result.items() if not IGNORED & set(Path(name).parts)}


def _content(path: Path) -> object:
    if path.suffix == ".csv":
        table = pd.read_csv(path, dtype=str, keep_default_na=False)
        return table.drop(columns=[name for name in CLOCKS if name in table]).to_csv()
    if path.suffix == ".md":
        return ""  # repeats the CSV table, with wall-clock times
    if path.name == "state.safetensors":
        return _checkpoint(path)
    return path.read_bytes()


def _checkpoint(path: Path) -> object:
    with safe_open(path, framework="numpy") as file:
        arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a dictionary)
        values = json.loads(file.metadata()["values"])
    for row in values["rows"]:
        row.pop("wall_time")
    contents = {name: (str(x.dtype), x.shape, np.ascontiguousarray(x).tobytes()) for name, x in arrays.items()}
    return contents, json.dumps(values)
