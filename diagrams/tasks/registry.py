"""Tasks by name."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, TypeVar

from guiderail.models.registry import Registry

if TYPE_CHECKING:
    from guiderail.diagrams.tasks.task import Task

    AnyTask = TypeVar("AnyTask", bound=type[Task])

TASKS: Registry[type[Task]] = Registry(
    "task", package="guiderail.diagrams.tasks", decorator="register_task", entry_points="guiderail.tasks"
)


def register_task(name: str) -> Callable[[AnyTask], AnyTask]:
    """A decorator that adds a task.

    Args:
        name: what it is called; it may have a namespace of its own, as in "lab/Peg".

    Raises:
        InputError: when it decorates, if another task has that name.
    """

    def add(task: AnyTask) -> AnyTask:
        task.name = name
        TASKS.register(name, task)
        return task

    return add


def environment_id(name: str) -> str:
    """What `gymnasium.make` calls a task."""
    return f"{name if '/' in name else f'guiderail/{name}'}-v0"
