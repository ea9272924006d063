"""Files that are either complete or not there, and pictures that can be written."""

import os
from pathlib import Path

from guiderail.models.errors import InputError

PICTURES = (".png", ".jpg", ".jpeg", ".svg", ".pdf")


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
        temporary.unlink(missing_ok=True)
        raise InputError(f"{path} cannot be written ({error.strerror}): choose a folder with room to write") from error


def remove_parts(folder: Path) -> None:
    """Removes what `write_atomically` left where it was killed; call it where nobody else is writing."""
    for part in folder.rglob(".*.part"):
        part.unlink(missing_ok=True)


def check_picture(path: Path) -> None:
    """Refuses a picture that cannot be written, before anything is run for it.

    Raises:
        InputError: for an ending that is none of `PICTURES`.
    """
    if path.suffix.lower() not in PICTURES:
        raise InputError(f"{path} has the ending {path.suffix!r}: a picture is {', '.join(PICTURES)}")
