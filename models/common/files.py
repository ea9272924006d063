"""Bounded reading, atomic writing and digests of files."""

import hashlib
import os
import re
import threading
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path

import numpy as np

from guiderail.models.common.errors import InputError


def write_atomically(path: Path, content: bytes) -> None:
    """Write a file atomically: readers find the old content or the new, even if the process is killed.

    Missing folders are created. Several processes and threads may write the same file; the last content remains.
    `tools/files.py` finds abandoned temporary files by the last number of their name, the process.

    Raises:
        InputError: If the file cannot be written.
    """
    temporary = path.with_name(f".{path.name}.{threading.get_native_id()}.{os.getpid()}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with open(temporary, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except OSError as error:
        with suppress(OSError):  # the parent may be a file
            temporary.unlink(missing_ok=True)
        raise write_error(path, error) from error


def write_error(path: Path, error: OSError) -> InputError:
    """Return the error for a path that cannot be written."""
    return InputError(f"{path} cannot be written ({error.strerror or error}): choose a folder with room to write")


def digest(arrays: Mapping[str, np.ndarray], text: str) -> str:
    """Compute a digest of a text and of arrays with their names, types and shapes.

    It is stored in policies and checkpoints, which another digest would make unreadable.
    """
    hasher = hashlib.blake2b(text.encode())
    for key in sorted(arrays):
        hasher.update(f"{key} {arrays[key].dtype} {arrays[key].shape}".encode())
        hasher.update(arrays[key].tobytes())
    return hasher.hexdigest()


def read_bytes(path: Path, what: str, max_size: int) -> bytes:
    """Read a regular file of at most `max_size` bytes; `what` is its kind for messages, such as "template".

    Raises:
        InputError: If the file does not exist, cannot be read, or is too large.
    """
    try:
        if not path.is_file():  # reading a pipe or a device would block
            raise InputError(f"there is no {what} '{path}': check the path")
        with path.open("rb") as file:
            data = file.read(max_size + 1)
    except OSError as error:
        raise InputError(f"the {what} '{path}' can't be read ({error.strerror}): check the path") from error
    if len(data) > max_size:
        raise InputError(f"the {what} '{path}' is larger than {max_size} bytes: leave out what is not needed")
    return data


def in_order(paths: Iterable[Path]) -> list[Path]:
    """Return paths sorted by name, numbers in names by value: `demo_9` precedes `demo_10`."""

    def key(path: Path) -> list[tuple[int, str]]:
        return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", path.name)]

    return sorted(paths, key=key)
