"""Whether two run folders, or two studies of them, are the same but for the time that they took."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
from safetensors import safe_open

CLOCKS = ("wall_time", "training_wall_time")
# What says when and by whom a run was made, or draws it.
UNLIKE = {"logs", "replay.html", "learning_curve.png"}


def differences(first: Path, second: Path) -> list[str]:
    """What differs between two folders, a line each; nothing where they are the same.

    Tables are compared cell by cell without their clocks, checkpoints array by array and value by value, everything
    else byte by byte. A file that only one of them has is a difference.
    """
    one, two = _files(first), _files(second)
    found = [f"{name} is in one of them only" for name in sorted(one.keys() ^ two.keys())]
    for name in sorted(one.keys() & two.keys()):
        if _content(one[name]) != _content(two[name]):
            found.append(f"{name} differs")
    return found


def _files(folder: Path) -> dict[str, Path]:
    found = {str(path.relative_to(folder)): path for path in folder.rglob("*") if path.is_file()}
    return {name: path for name, path in found.items() if not UNLIKE & set(Path(name).parts)}


def _content(path: Path) -> object:
    if path.suffix == ".csv":
        table = pd.read_csv(path, dtype=str, keep_default_na=False)
        return table.drop(columns=[name for name in CLOCKS if name in table]).to_csv()
    if path.suffix == ".md":
        return ""  # it is the table again, clocks included
    if path.name == "state.safetensors":
        return _checkpoint(path)
    return path.read_bytes()


def _checkpoint(path: Path) -> object:
    with safe_open(path, framework="numpy") as file:
        arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (it is no dictionary)
        values = json.loads(file.metadata()["values"])
    for row in values["rows"]:
        row.pop("wall_time")
    held = {name: (str(one.dtype), one.shape, np.ascontiguousarray(one).tobytes()) for name, one in arrays.items()}
    return held, json.dumps(values)
