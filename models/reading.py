"""Reading a file that a person named."""

from pathlib import Path

from guiderail.models.errors import InputError


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
