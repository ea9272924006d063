"""Files that are either complete or not there, and pictures that can be written."""

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
        InputError: for an ending that is none of `PICTURES`.
    """
    if path.suffix.lower() not in PICTURES:
        raise InputError(f"{path} has the ending {path.suffix!r}: a picture is {', '.join(PICTURES)}")
