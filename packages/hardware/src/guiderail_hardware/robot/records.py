"""Records of a robot, which cannot be repeated: room is checked in advance, and another folder is tried."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from guiderail.models.common.errors import InputError
from guiderail.tools.files import write_error


def check_room(path: Path, size: int) -> None:
    """Raise an InputError if the file system of a file or a new folder has room for less than `size` bytes."""
    try:
        room = shutil.disk_usage(next(folder for folder in path.absolute().parents if folder.exists())).free
    except OSError as error:
        raise write_error(path, error) from error
    if room < size:
        raise InputError(
            f"{path.parent} has room for {room:,} bytes, and the record may need {size:,}: choose a folder with room"
        )


def write_record(path: Path, write: Callable[[Path], object]) -> tuple[Path, str]:
    """Write a record that cannot be repeated; if that fails, write it into a temporary folder or the home folder.

    Args:
        path: File to write.
        write: Function that writes the file of a path.

    Returns:
        The path of the written file, and a sentence on the failure, empty if there was none.
    """
    try:
        write(path)
    except (InputError, OSError) as error:
        for parent in (None, os.path.expanduser("~")):
            with suppress(InputError, OSError):
                fallback = Path(tempfile.mkdtemp(prefix="guiderail-", dir=parent)) / path.name
                write(fallback)
                return fallback, f"{path} cannot be written, so the record is in {fallback}"
        raise InputError(f"{error}; the record could not be written to another folder either") from error
    return path, ""
