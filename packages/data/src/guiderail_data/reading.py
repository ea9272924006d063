"""Demonstrations of a file or of a folder of files."""

from collections.abc import Collection
from pathlib import Path

from guiderail.models.common.errors import InputError
from guiderail.models.common.files import in_order
from guiderail.models.primitives import Demonstrations
from guiderail.tools.files import ENDINGS, path_exists


def load_demonstrations(path: Path) -> Demonstrations:
    """Return the demonstrations of a file, or of all .npz and .csv files of a folder that are not hidden.

    Each file is read by `Demonstrations.load`, as in training. `Demonstrations.load` itself accepts only folders of
    .csv files.
    """
    if path_exists(path) and path.is_dir():
        files = visible_files(path, ENDINGS)
        if not files:
            raise InputError(f"there is no file {' or '.join(ENDINGS)} in {path}: name a folder of demonstrations")
        parts = [Demonstrations.load(file) for file in files]
        for file, part in zip(files, parts, strict=True):
            if part.names != parts[0].names:
                raise InputError(
                    f"{file} has the outputs {', '.join(part.names)}, and {files[0].name} {', '.join(parts[0].names)}: "
                    "record the same outputs in all files"
                )
        times, outputs = ([array for part in parts for array in getattr(part, name)] for name in ("times", "outputs"))
        return Demonstrations(times, outputs, parts[0].names)
    return Demonstrations.load(path)


def visible_files(folder: Path, endings: Collection[str]) -> list[Path]:
    """Return the paths of the files in a folder with one of the endings, in order; hidden files are left out.

    Raises:
        InputError: If the name of a folder has one of the endings.
    """
    paths = [path for path in folder.iterdir() if path.suffix in endings and not path.name.startswith(".")]
    for path in paths:
        if path.is_dir():
            raise InputError(f"{path} is a folder with the name of a file: rename it, or move it to another place")
    return in_order(paths)
