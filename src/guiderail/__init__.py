"""Reinforcement learning of contact tasks that breaks nothing: RL-SCT, KGRL and sKGRL as Drake systems diagrams.

The four folders of the repository are the four parts of this package: `models` (what is known, without Drake systems),
`systems` (one LeafSystem a file), `diagrams` (wiring) and `tools` (what a person runs).
"""

from importlib.metadata import version

__version__ = version("guiderail")
