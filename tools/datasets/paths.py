"""Where recordings are read from and written to."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

from guiderail.models.common.errors import InputError, brief
from guiderail.models.primitives import Demonstrations
from guiderail.tools.files import check_writable


def is_there(path: Path) -> bool:
    """Whether there is a file or a folder.

    Raises:
        InputError: if that can't be found out, as of a name that is too long.
    """
    try:
        return path.exists()
    except OSError as error:
        raise InputError(f"the path {brief(str(path))} can't be read ({error.strerror}): check it") from error


def in_order(paths: Iterable[Path]) -> list[Path]:
    """Sorted by name, and numbers in a name by their size: recording_2 comes before recording_10."""

    def key(path: Path) -> list[tuple[int, str]]:
        return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", path.name)]

    return sorted(paths, key=key)


def check_new(out: Path, what: str) -> None:
    """Refuses a place that nothing can be written to, before anything is done for it; `what` is what it would be.

    Raises:
        InputError: if something is there already, or nothing can be written above it.
    """
    if is_there(out):
        raise InputError(f"{out} already exists: name another {what}")
    check_writable(out)


ENDINGS = (".npz", ".csv")


def load_demonstrations(path: Path) -> Demonstrations:
    """The demonstrations of a file, or of all files of a folder by their names.

    A file is read as `Demonstrations.load` does: what is checked or exported can be learned from.

    Raises:
        InputError: if there are none, or what is there makes no sense.
    """
    if is_there(path) and path.is_dir():
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
        times, outputs = ([one for part in parts for one in getattr(part, of)] for of in ("times", "outputs"))
        return Demonstrations(times, outputs, parts[0].names)
    return Demonstrations.load(path)
