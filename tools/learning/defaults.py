"""How a task is learned where nobody says otherwise: the one place where tools know it."""

from typing import Any

from guiderail.diagrams.tasks.registry import TASKS

DEFAULTS: dict[str, Any] = {"algorithm": "tqc", "preset": "robust", "episodes": 60, "seed": 0}


def own_defaults(task: str) -> dict[str, Any]:
    """The learner that a task declares, taken where neither algorithm nor preset is asked for."""
    return dict(TASKS.get(task).learner) if task in TASKS.names() else {}
