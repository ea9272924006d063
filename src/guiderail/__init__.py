"""Constrained reinforcement learning for contact-rich manipulation: RL-SCT, KGRL and sKGRL as Drake systems diagrams.

The four folders of the repository are the four parts of this package: `models` (numerics without Drake systems),
`systems` (one LeafSystem a file), `diagrams` (wiring) and `tools` (the command and the Python API). Importing it
registers the environments of all tasks with Gymnasium. The names in `__init__.pyi` are imported on first use.
"""

from importlib.metadata import version

import lazy_loader

from guiderail.diagrams.tasks.registry import register_envs

__version__ = version("guiderail")
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

register_envs()
