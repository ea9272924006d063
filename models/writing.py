"""Writing a file that is either complete or not there."""

import os
from contextlib import suppress
from pathlib import Path

from guiderail.models.errors import InputError


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
