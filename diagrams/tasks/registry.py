"""Tasks by name."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from guiderail.diagrams.envs.options import STANDARD, Options, ResetOptions
from guiderail.models.common.errors import InputError, brief
from guiderail.models.common.registry import Registry

if TYPE_CHECKING:
    from guiderail.diagrams.tasks.task import Task

    AnyTask = TypeVar("AnyTask", bound=type[Task])

import gymnasium

TASKS: Registry[type[Task]] = Registry(
    "task", package="guiderail.diagrams.tasks", decorator="register_task", entry_points="guiderail.tasks"
)


def register_task(name: str) -> Callable[[AnyTask], AnyTask]:
    """A decorator that adds a task.

    Args:
        name: what it is called; it may have a namespace of its own, as in "lab/Peg".

    Raises:
        InputError: when it decorates, if another task has that name, or what it declares is not of the right kind.
    """

    def add(task: AnyTask) -> AnyTask:
        _check(name, task)
        task.name = name
        TASKS.register(name, task)
        return task

    return add


def _check(name: str, task: type[Task]) -> None:
    """Refuses declarations of the wrong kind, while whoever wrote them looks on."""
    for attribute, kind in (("Options", Options), ("Reset", ResetOptions)):
        given = getattr(task, attribute)
        if not (isinstance(given, type) and issubclass(given, kind)):
            raise InputError(f"{attribute} of {name} must be a class made of {kind.__name__}, not {brief(given)}")
    for attribute in ("rewards", "observations"):
        given = getattr(task, attribute)
        if isinstance(given, str) or not given:
            raise InputError(f"{attribute} of {name} must be some words, such as ('sparse',), not {brief(given)}")
    if STANDARD not in task.difficulties:
        raise InputError(f"difficulties of {name} must have {STANDARD!r}, not only {brief(list(task.difficulties))}")
    num_steps = getattr(task, "num_steps", None)  # some say it in their constructor, or as a property
    if isinstance(num_steps, int | float | complex | str | np.number):
        check_num_steps(name, num_steps)
    if not isinstance(task.clip, int | float) or not task.clip > 0:
        raise InputError(f"clip of {name} must be a positive number, not {brief(task.clip)}")


def check_num_steps(name: str, num_steps: Any) -> None:
    """Refuses what no episode can last.

    Raises:
        InputError: if it is no whole number of at least 1.
    """
    if isinstance(num_steps, bool) or not isinstance(num_steps, int | np.integer) or num_steps < 1:
        raise InputError(f"num_steps of {name} must be a whole number of at least 1, not {brief(num_steps)}")


def is_task_folder(name: str | Path) -> bool:
    """Whether that is a folder that `guiderail onboard` made, by its path."""
    return (Path(name) / "task.yaml").is_file()


def register_task_folder(folder: str | Path) -> str:
    """Adds the task of a folder, and returns what it is called. Doing it again reads the folder anew.

    Raises:
        InputError: if something in it makes no sense, or another task has its name.
    """
    from guiderail.diagrams.tasks.part.task import load_task_folder  # Drake takes a second

    task = load_task_folder(Path(folder))
    register_task(task.file.name)(task)
    return task.name


def environment_id(name: str) -> str:
    """What `gymnasium.make` calls a task."""
    return f"{name if '/' in name else f'guiderail/{name}'}-v0"


def register_envs() -> None:
    """Registers `guiderail/<Task>-v0`, or `<namespace>/<Task>-v0`, for every task; calling it again adds new ones."""
    for name in TASKS.names():
        if environment_id(name) not in gymnasium.registry:
            gymnasium.register(
                id=environment_id(name), entry_point="guiderail.diagrams.envs.make:make_env", kwargs={"task": name}
            )
