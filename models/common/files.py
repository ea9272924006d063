"""Reading a file that a person named."""

import hashlib
import os
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

import numpy as np

from guiderail.models.common.errors import InputError


def write_atomically(path: Path, content: bytes) -> None:
    """Writes a file so that a reader, or a run that was killed, finds the old content or the new, never a part.

    Raises:
        InputError: if the file cannot be written.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with open(temporary, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except OSError as error:
        with suppress(OSError):  # below a file there is no folder to remove anything from
            temporary.unlink(missing_ok=True)
        raise InputError(f"{path} cannot be written ({error.strerror}): choose a folder with room to write") from error


def digest(arrays: Mapping[str, np.ndarray], text: str) -> str:
    """A digest of names, types, shapes and contents, and of a text."""
    found = hashlib.blake2b(text.encode())
    for key in sorted(arrays):
        found.update(f"{key} {arrays[key].dtype} {arrays[key].shape}".encode())
        found.update(arrays[key].tobytes())
    return found.hexdigest()


def read_bytes(path: Path, what: str, most: int) -> bytes:
    """The content of a file of at most `most` bytes; `what` names its kind in messages.

    Raises:
        InputError: if there is no such regular file, it can't be read, or it is larger.
    """
    try:
        if not path.is_file():  # a pipe or a device would be waited for
            raise InputError(f"there is no {what} '{path}': check the path")
        with path.open("rb") as file:
            data = file.read(most + 1)
    except OSError as error:
        raise InputError(f"the {what} '{path}' can't be read ({error.strerror}): check the path") from error
    if len(data) > most:
        raise InputError(f"the {what} '{path}' is larger than {most} bytes: leave out what is not needed")
    return data
