"""Trained policies that come with the package, named `pretrained:NAME`: run folders without a checkpoint.

`pretrained:insertion` has no configuration either, because it acts in tasks that it was not trained in (`--task`).

`make pretrained` trains and evaluates them again (`research/pretrained.py`).
"""

from pathlib import Path

from guiderail.models.common.errors import InputError, brief
from guiderail.models.common.registry import did_you_mean

PRETRAINED = "pretrained:"  # prefix of a name
PRETRAINED_FOLDER = Path(__file__).parent


def pretrained_names() -> list[str]:
    """Return the names of the policies that come with the package."""
    return sorted(file.parent.name for file in PRETRAINED_FOLDER.glob("*/policy.json"))


def find_run(source: str | Path) -> Path:
    """Return the folder of a run or a policy; that of `pretrained:NAME` is in the package."""
    if not str(source).startswith(PRETRAINED):
        return Path(source)
    name = str(source).removeprefix(PRETRAINED)
    if name not in pretrained_names():
        raise InputError(f"there is no pretrained policy {brief(name)}: {did_you_mean(name, pretrained_names())}")
    return PRETRAINED_FOLDER / name
