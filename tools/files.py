"""Files that are either complete or not there, and pictures that can be written."""

import os
from pathlib import Path

from guiderail.models.errors import InputError
from guiderail.models.writing import write_atomically as write_atomically

PICTURES = (".png", ".jpg", ".jpeg", ".svg", ".pdf")


def remove_parts(folder: Path) -> None:
    """Removes what `write_atomically` left where it was killed; call it where nobody else is writing."""
    for part in folder.rglob(".*.part"):
        part.unlink(missing_ok=True)


def check_picture(path: Path) -> None:
    """Refuses a picture that cannot be written, before anything is run for it.

    Raises:
        InputError: for an ending that is none of `PICTURES`, or a place where nothing can be written.
    """
    if path.suffix.lower() not in PICTURES:
        raise InputError(f"{path} has the ending {path.suffix!r}: a picture is {', '.join(PICTURES)}")
    check_writable(path)


def check_writable(path: Path) -> None:
    """Refuses a file, or a folder that is to be made, where nothing can be written, before anything is run for it.

    Raises:
        InputError: for a path below a file, in a folder that cannot be written to, or that no system takes.
    """
    try:
        above = next(one for one in path.absolute().parents if one.exists())
        if not above.is_dir():
            raise InputError(f"{path} cannot be written, as {above} is a file: choose another folder")
        if not os.access(above, os.W_OK):
            raise InputError(f"{path} cannot be written: choose a folder with room to write")
    except OSError as error:  # such as a name that is too long
        raise InputError(f"{path} cannot be written ({error.strerror}): choose another name") from error
