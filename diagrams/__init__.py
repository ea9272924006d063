"""Wiring: stations, guidance, tasks, and the Gymnasium environments made of them.

Importing this package registers the environments of all tasks that are known: this package's own, and those of
installed packages. Gymnasium does it in one go: `gymnasium.make("guiderail.diagrams:guiderail/NarrowPassage-v0")`.
"""

from guiderail.diagrams.tasks.registry import register_envs

__all__ = ["register_envs"]

register_envs()
