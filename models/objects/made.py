"""Files of objects that are made to measure: written once a process, into a folder that goes when the process does."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

# A folder is removed when the last reference to it goes: a simulator may read a mesh long after it read the SDF file.
_FOLDERS: list[TemporaryDirectory[str]] = []


@cache
def made(files: Callable[..., dict[str, str]], *dimensions: Hashable) -> Path:
    """The folder that holds `files(*dimensions)`, which gives what each file holds by its name."""
    folder = TemporaryDirectory(prefix="guiderail-")
    _FOLDERS.append(folder)
    for name, content in files(*dimensions).items():
        Path(folder.name, name).write_text(content)
    return Path(folder.name)
