"""Demonstrations as people have them: files of `guiderail record`, a CSV with a header like `t,x,y,z`, a folder."""

from pathlib import Path

from guiderail.models.errors import InputError
from guiderail.models.primitives import Demonstrations
from guiderail.tools.recording.places import in_order, is_there

ENDINGS = (".npz", ".csv")


def load_demonstrations(path: Path) -> Demonstrations:
    """The demonstrations of a file, or of all files of a folder by their names.

    A file is read as `Demonstrations.load` does: what is checked or exported can be learned from.

    Raises:
        InputError: if there are none, or what is there makes no sense.
    """
    if is_there(path) and path.is_dir():
        files = in_order(file for file in path.iterdir() if file.suffix in ENDINGS)
        if not files:
            raise InputError(f"there is no file {' or '.join(ENDINGS)} in {path}: name a folder of demonstrations")
        parts = [load_demonstrations(file) for file in files]
        for file, part in zip(files, parts, strict=True):
            if part.names != parts[0].names:
                raise InputError(
                    f"{file} has the outputs {', '.join(part.names)}, and {files[0].name} {', '.join(parts[0].names)}: "
                    "record the same ones in all of them"
                )
        times, outputs = ([one for part in parts for one in getattr(part, of)] for of in ("times", "outputs"))
        return Demonstrations(times, outputs, parts[0].names)
    return Demonstrations.load(path)
