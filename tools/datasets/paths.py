"""Paths of demonstrations: existing files, new files, and files in the order of their numbers."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

from guiderail.models.common.errors import InputError, brief
from guiderail.models.primitives import Demonstrations
from guiderail.tools.files import check_writable


def path_exists(path: Path) -> bool:
    """Return True if there is a file or a folder.

    Raises:
        InputError: If the file system refuses the path, as for a name that is too long.
    """
    try:
        return path.exists()
    except OSError as error:
        raise InputError(f"the path {brief(str(path))} cannot be read ({error.strerror}): check it") from error


def in_order(paths: Iterable[Path]) -> list[Path]:
    """Return paths sorted by name, numbers in names by value: recording_2 precedes recording_10."""

    def key(path: Path) -> list[tuple[int, str]]:
        return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", path.name)]

    return sorted(paths, key=key)


def check_new(out: Path, what: str) -> None:
    """Refuse a path that exists or cannot be written, before anything is computed for it.

    Args:
        out: Path.
        what: Noun for the message, such as "file".

    Raises:
        InputError: If the path exists, or its folder cannot be written to.
    """
    if path_exists(out):
        raise InputError(f"{out} already exists: name another {what}")
    check_writable(out)


ENDINGS = (".npz", ".csv")


def load_demonstrations(path: Path) -> Demonstrations:
    """Return the demonstrations of a file, or of all .npz and .csv files of a folder.

    Files are read by `Demonstrations.load`, so that validated and exported demonstrations can be learned from.

    Raises:
        InputError: If there are none, or a file is invalid.
    """
    if path_exists(path) and path.is_dir():
        files = in_order(file for file in path.iterdir() if file.suffix in ENDINGS)
        if not files:
            raise InputError(f"there is no file {' or '.join(ENDINGS)} in {path}: name a folder of demonstrations")
        parts = [load_demonstrations(file) for file in files]
        for file, part in zip(files, parts, strict=True):
            if part.names != parts[0].names:
                raise InputError(
                    f"{file} has the outputs {', '.join(part.names)}, and {files[0].name} {', '.join(parts[0].names)}: "
                    "record the same ones in all of them"
                )
        times, outputs = ([array for part in parts for array in getattr(part, name)] for name in ("times", "outputs"))
        return Demonstrations(times, outputs, parts[0].names)
    return Demonstrations.load(path)
