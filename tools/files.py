"""Files and folders that are either complete or not there, and whether they can be written."""

import os
import re
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from guiderail.models.common.errors import InputError
from guiderail.models.common.files import write_atomically as write_atomically

PICTURES = (".png", ".jpg", ".jpeg", ".svg", ".pdf")
PAGES = (".html", ".htm")
VIDEOS = (".webp", ".gif")


LOCK = ".lock"
"""In a folder that one process at a time writes into."""
_PART = re.compile(r"\..*\.(\d+)\.part")


def remove_parts(folder: Path) -> None:
    """Removes what `write_atomically` and `whole_folder` left in a folder and below it where they were killed.

    What another process is still writing stays, and so does all that is in a folder below with a lock of its own.
    """
    for place, below, files in os.walk(folder):
        left = [name for name in below if _is_left(name)]
        below[:] = [name for name in below if not _PART.fullmatch(name) and not Path(place, name, LOCK).exists()]
        for name in left:
            shutil.rmtree(Path(place, name), ignore_errors=True)
        for name in filter(_is_left, files):
            Path(place, name).unlink(missing_ok=True)


def _is_left(name: str) -> bool:
    """Whether it is the name of a part whose writer is no process any more, or this one."""
    part = _PART.fullmatch(name)
    if part is None or int(part[1]) == os.getpid():
        return part is not None
    try:
        os.kill(int(part[1]), 0)  # 0 is no signal: it asks
    except (ProcessLookupError, OverflowError):
        return True
    except PermissionError:  # somebody else's
        pass
    return False


def check_picture(path: Path) -> None:
    """Refuses a picture that cannot be written, before anything is run for it.

    Raises:
        InputError: for an ending that is none of `PICTURES`, or a place where nothing can be written.
    """
    _check_named(path, "picture", PICTURES)


def check_video(path: Path) -> None:
    """Refuse a video that cannot be written, before anything is run for it.

    Raises:
        InputError: For an ending that is none of `VIDEOS`, or a folder that cannot be written to.
    """
    _check_named(path, "video", VIDEOS)


def check_page(path: Path) -> None:
    """Refuses a page that cannot be written, or that nobody would name so, before anything is run for it.

    Raises:
        InputError: for an ending that is none of `PAGES`, or a place where nothing can be written.
    """
    _check_named(path, "page", PAGES)


def _check_named(path: Path, what: str, endings: tuple[str, ...]) -> None:
    if path.suffix.lower() not in endings:
        raise InputError(f"{path} has the ending {path.suffix!r}: a {what} is {', '.join(endings)}")
    check_writable(path)


def check_writable(path: Path) -> None:
    """Refuses a file, or a folder that is to be made, where nothing can be written, before anything is run for it.

    Raises:
        InputError: for a folder that is there, a path below a file, in a folder that takes nothing, or with a name that
            is too long.
    """
    try:
        if path.is_dir():
            raise InputError(f"{path} is a folder that is already there: name another place")
        above = next(one for one in path.absolute().parents if one.exists())
        with tempfile.TemporaryFile(dir=above):  # rights alone don't say it: root has them all
            pass
    except OSError as error:
        raise _unwritable(path, error) from error


@contextmanager
def whole_folder(out: Path) -> Iterator[Path]:
    """A folder to write into that becomes `out` in the end; if that fails there is none, so that one can try again.

    Raises:
        InputError: if it can't be written.
    """
    made = out.with_name(f".{out.name}.{os.getpid()}.part")
    shutil.rmtree(made, ignore_errors=True)
    try:
        made.mkdir(parents=True)
        yield made
        made.rename(out)
    except OSError as error:
        raise _unwritable(out, error) from error
    finally:
        shutil.rmtree(made, ignore_errors=True)


def _unwritable(path: Path, error: OSError) -> InputError:
    return InputError(f"{path} cannot be written ({error.strerror or error}): choose a folder with room to write")
