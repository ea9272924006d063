"""Study files of the research, one YAML file a study."""

from pathlib import Path

from guiderail.models.common.errors import InputError
from guiderail.models.common.registry import did_you_mean

FOLDER = Path(__file__).parent


def study_names() -> list[str]:
    """Return the names of the studies in this folder, sorted."""
    return sorted(path.stem for path in FOLDER.glob("*.yaml"))


def study_path(name: str) -> Path:
    """Return the YAML file of a study in this folder.

    Args:
        name: Name of the study, its file's name without the ending.

    Raises:
        InputError: If there is no such study.
    """
    path = FOLDER / f"{name}.yaml"
    if not path.is_file():
        raise InputError(f"there is no study {name!r}: {did_you_mean(name, study_names())}")
    return path
