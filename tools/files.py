"""Output files and folders: written atomically, and checked before their content is computed."""

from __future__ import annotations

import glob
import os
import re
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

from guiderail.models.common.errors import InputError, brief
from guiderail.models.common.files import write_atomically as write_atomically
from guiderail.models.common.files import write_error as write_error

PICTURES = (".png", ".jpg", ".jpeg", ".svg", ".pdf")
PAGES = (".html", ".htm")
VIDEOS = (".webp", ".gif")
LOCK = ".lock"  # lock file in a folder that one process at a time writes into
_PARTIAL = re.compile(r"\..*\.(\d+)\.part")


def remove_partial_files(folder: Path) -> None:
    """Remove partial files that killed calls of `write_atomically` and `atomic_folder` left in a folder and below it.

    Files that another process is still writing are not removed, nor is anything in a subfolder with its own lock file.
    """
    for parent, subfolders, files in os.walk(folder):
        for name in filter(_is_abandoned, subfolders):
            shutil.rmtree(Path(parent, name), ignore_errors=True)
        subfolders[:] = [
            name for name in subfolders if not _PARTIAL.fullmatch(name) and not Path(parent, name, LOCK).exists()
        ]
        for name in filter(_is_abandoned, files):
            Path(parent, name).unlink(missing_ok=True)


def _is_abandoned(name: str) -> bool:
    """Return True for the name of a partial file whose writer has ended or is this process."""
    match = _PARTIAL.fullmatch(name)
    if match is None or int(match[1]) == os.getpid():
        return match is not None
    try:
        os.kill(int(match[1]), 0)  # signal 0 only tests whether the process exists
    except (ProcessLookupError, OverflowError):
        return True
    except PermissionError:  # the process exists and belongs to another user
        pass
    return False


def refuse_links(folder: Path) -> None:
    """Raise an InputError if a folder inside of a run's folder is a link to a place outside of it.

    Such a link would let a run that came from elsewhere read and overwrite files of other folders.
    """
    inside = folder.resolve()
    for parent, subfolders, _ in os.walk(folder):
        for path in (Path(parent, name) for name in subfolders):
            if path.is_symlink() and not path.resolve().is_relative_to(inside):
                raise InputError(f"{path} is a link to a folder outside of {folder}: replace the link by a folder")


def _check_output(kind: str, endings: tuple[str, ...], path: Path) -> None:
    """Raise an InputError if the ending of a path is none of `endings`, or the file cannot be written."""
    if path.suffix.lower() not in endings:
        raise InputError(f"{path} has the ending {path.suffix!r}: a {kind} is {', '.join(endings)}")
    check_writable(path)


# Functions of a path that raise an InputError if its ending is wrong or the file cannot be written.
check_picture = partial(_check_output, "picture", PICTURES)
check_video = partial(_check_output, "video", VIDEOS)
check_page = partial(_check_output, "page", PAGES)


def check_writable(path: Path) -> None:
    """Raise an InputError if a file, or a new folder, cannot be written.

    The causes are a folder at the path, a parent that is a file or has no write permission, or a path that is too long.
    """
    try:
        if path.is_dir():
            raise InputError(f"{path} is a folder that already exists: name another path")
        parent = next(folder for folder in path.absolute().parents if folder.exists())
        with tempfile.TemporaryFile(dir=parent):  # permission bits do not suffice: root can ignore them
            pass
    except OSError as error:
        raise write_error(path, error) from error


@contextmanager
def atomic_folder(out: Path) -> Iterator[Path]:
    """Yield a temporary folder that is renamed to `out` at the end, or removed after an error.

    Partial folders that killed processes left for the same path are removed first.
    """
    temporary = out.with_name(f".{out.name}.{os.getpid()}.part")
    for partial_folder in out.parent.glob(f".{glob.escape(out.name)}.*.part"):
        if _is_abandoned(partial_folder.name) and not partial_folder.is_symlink():
            shutil.rmtree(partial_folder, ignore_errors=True)
    try:
        temporary.mkdir(parents=True)
        yield temporary
        temporary.rename(out)
    except OSError as error:
        error_path = str(temporary if error.filename is None else error.filename)
        if not (error_path.startswith(str(temporary)) or str(temporary).startswith(error_path)):
            raise
        raise write_error(out, error) from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def path_exists(path: Path) -> bool:
    """Return True if a path is an existing file or folder."""
    try:
        return path.exists()
    except OSError as error:
        raise InputError(f"the path {brief(str(path))} cannot be read ({error.strerror}): check it") from error


def check_new(out: Path, what: str) -> None:
    """Raise an InputError if a path exists or cannot be written; `what` is a noun for the message."""
    if path_exists(out):
        raise InputError(f"{out} already exists: name another {what}")
    check_writable(out)


ENDINGS = (".npz", ".csv")  # endings of demonstration files


def refuse_existing_run(path: Path) -> None:
    """Raise an InputError if the path of a new run is a file, or a folder with content that is not hidden.

    Hidden files may be left over from a run that was killed before its configuration was written.
    """
    try:
        is_taken = path.exists() and not (path.is_dir() and all(file.name.startswith(".") for file in path.iterdir()))
    except OSError as error:
        raise InputError(f"{brief(path)} is no folder for a run: {error.strerror}") from error
    if is_taken and path == Path():  # also the empty path
        raise InputError("a run needs a folder of its own, and the current folder is not empty: name one, such as RUN")
    if is_taken:
        raise InputError(f"{path} already exists: name another folder, or resume that run with --resume")
