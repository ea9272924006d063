"""Constrained reinforcement learning for contact-rich manipulation: RL-SCT, KGRL and sKGRL as Drake systems diagrams.

The four folders of the repository are the four parts of this package: `models` (numerics without Drake systems),
`systems` (the LeafSystems of one concept in a file), `diagrams` (wiring) and `tools` (the command and the Python API).
Importing the package registers the environments of all tasks with Gymnasium. The names in `__init__.pyi` are imported
on first use. Movement primitives, templates and `GuidedEnv` need neither Drake nor PyTorch, which the extras `sim` and
`learn` install.
"""

from importlib.metadata import version

import lazy_loader

from guiderail.diagrams.tasks.registry import register_envs
from guiderail.models.common.errors import explain_missing

__version__ = version("guiderail")
_load, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> object:
    """Import a public name.

    Raises:
        MissingExtraError: If the name needs an extra that is not installed.
    """
    try:
        return _load(name)
    except ModuleNotFoundError as error:
        raise (explain_missing(error) or error) from error


register_envs()
