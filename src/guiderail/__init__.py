"""Reinforcement learning of contact tasks that breaks nothing: RL-SCT, KGRL and sKGRL as Drake systems diagrams.

The four folders of the repository are the four parts of this package: `models` (what is known, without Drake systems),
`systems` (one LeafSystem a file), `diagrams` (wiring) and `tools` (what a person runs). The names in `__init__.pyi` are
imported when they are first used.
"""

from importlib.metadata import version

import lazy_loader

__version__ = version("guiderail")
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
