"""Tries to make a task of one's own fail, through every guidance that it has."""

from guiderail.diagrams.guidance.registry import possible_guidance
from guiderail.diagrams.tasks.registry import TASKS
from research.action_fuzzing.campaign import Campaign, Case

# Guidance that keeps the task's constraints, or the template's active ones.
CONSTRAINED = ("kgrl", "skgrl", "sct")


def campaign_of(task: str) -> Campaign:
    """Every guidance that a task has, with its defaults otherwise.

    What moves a template's frames nobody knows here, so that its commands are judged by what guidance says of them;
    those of a task with constraints are recomputed. To wait, and to stop before a wall, is no failure.

    Args:
        task: its name.
    """
    cases = [
        Case(name, {"guidance": name}, constrained=name in CONSTRAINED, waits=name not in ("kgrl", "skgrl"))
        for name in possible_guidance(TASKS.get(task).provides())
    ]
    return Campaign(task, cases, {}, frames=None)
