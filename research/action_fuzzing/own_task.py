"""Fuzzing of a task without a campaign of its own, through every guidance that it has."""

from guiderail.diagrams.guidance.registry import possible_guidance
from guiderail.diagrams.tasks.registry import TASKS
from research.action_fuzzing.campaign import Campaign, Case

# Guidance that satisfies the task's constraints, or the template's active ones.
CONSTRAINED = ("kgrl", "skgrl", "sct")


def campaign_of(task: str) -> Campaign:
    """Return a campaign of every guidance of a task, with the default options.

    The poses of a template's objects are unknown, so its commands are evaluated by what guidance reports. Those of a
    task with constraints are recomputed. Waiting, and stopping before a wall, is not a failure.

    Args:
        task: Name of the task.
    """
    cases = [
        Case(name, {"guidance": name}, constrained=name in CONSTRAINED, may_wait=name not in ("kgrl", "skgrl"))
        for name in possible_guidance(TASKS.get(task).provides())
    ]
    return Campaign(task, cases, {}, frames=None)
