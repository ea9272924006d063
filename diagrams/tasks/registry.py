"""Registry of tasks, and their registration as Gymnasium environments.

This module is imported by `import guiderail`, so it imports neither Drake nor pydantic.
"""

from __future__ import annotations

from collections.abc import Callable
from difflib import get_close_matches
from pathlib import Path
from types import FunctionType
from typing import TYPE_CHECKING, TypeVar

import gymnasium

from guiderail.models.common.errors import InputError, brief
from guiderail.models.common.registry import Registry, check_class, check_methods, did_you_mean, load_plugin

if TYPE_CHECKING:
    from guiderail.diagrams.tasks.task import Task

    TaskClass = TypeVar("TaskClass", bound=type[Task])

GIVEN = "given/"  # namespace of environments that are given as objects, which exist in one process only
IMPORT_HINT = ", or --import the file that registers it"
TASKS: Registry[type[Task]] = Registry("task", plugin="task", check=lambda name, task: _check(name, task))


def register_task(name: str) -> Callable[[TaskClass], TaskClass]:
    """Return a decorator that registers a task, and its environment with Gymnasium.

    Args:
        name: Name of the task; it may have a namespace, as in "lab/Peg".

    Raises:
        InputError: If the name is not a word. The decorator raises it if another task has this name, or a required
            method is missing.
    """
    TASKS.check_name(name)

    def add(task: TaskClass) -> TaskClass:
        TASKS.register(name, task)
        task.name = name
        _register_env(name)
        return task

    return add


def known_tasks() -> list[str]:
    """Return the names of all registered tasks and of all environments in the namespace "guiderail"."""
    registered = (spec.name for spec in gymnasium.registry.values() if spec.namespace == "guiderail")
    return sorted({*TASKS.names(), *registered})


def check_task_name(name: object) -> None:
    """Check that a task with this name exists, without importing any task.

    Raises:
        InputError: If there is no such task.
    """
    if name not in known_tasks() and name not in gymnasium.registry:
        if str(name).startswith((".", "/", "~")):
            raise InputError(f"there is no task.yaml in {name}: name a folder that guiderail create-task made")
        if str(name).startswith(GIVEN):
            raise InputError(
                f"{name} was given to training as an object: evaluate the run in Python with guiderail.evaluate(run, "
                "env), or register the environment with Gymnasium in a file and train it by its id with --import"
            )
        raise InputError(f"there is no task {brief(name)}: {did_you_mean(name, known_tasks(), IMPORT_HINT)}")


def _check(name: str, task: type[Task]) -> None:
    """Raise an `InputError` if an object is no task class, or the class lacks or misspells a method."""
    from guiderail.diagrams.tasks.task import Task

    check_class(name, task, Task)
    check_methods(task, Task)
    bases = [base for base in task.__mro__[1:] if issubclass(base, Task)]
    known = {each for base in bases for each in (*vars(base), *base.__annotations__)}
    # A method in place of an option becomes its default value.
    for own in (name for name, option in task.model_fields.items() if isinstance(option.default, FunctionType)):
        raise InputError(f"{own!r} is an option of {task.__name__}, not a method: {did_you_mean(own, known)}")
    for own in [each for each in vars(task) if not each.startswith("_") and each not in known]:
        # The environment would ignore the method in silence. Other public methods are helpers of the task.
        if own == "motion_constraints":
            raise InputError("motion constraints are part of the prior: return Prior(reference, linear, motion=...)")
        is_method = isinstance(vars(task)[own], FunctionType | property)
        if get_close_matches(own, known, 1, 0.6 if is_method else 0.8):
            raise InputError(f"Task has no method {own!r}: {did_you_mean(own, known)} Begin a helper's name with '_'")


def is_task_folder(name: str | Path) -> bool:
    """Return True if `name` is the path of a folder that `guiderail create-task` made."""
    try:
        return (Path(name) / "task.yaml").is_file()
    except (OSError, TypeError):  # not a path, or refused by the file system, for example because it is too long
        return False


def register_task_folder(folder: str | Path) -> str:
    """Register the task of a folder and return its name; each call reads the folder.

    If a task folder with the same name and content is already registered, it is used instead.

    Raises:
        InputError: If the folder's task is not valid, another task has its name, or guiderail-parts, which reads
            task folders, is not installed.
    """
    task = _read_task_folder(Path(folder))
    name = task.name
    registered = TASKS.get(name) if name in TASKS.names() else task
    existing_folder = registered.folder
    if existing_folder is not None and existing_folder != task.folder:
        if is_task_folder(existing_folder) and content_digest(registered) == task.digest:
            return register_task_folder(existing_folder)
        raise InputError(
            f"the tasks in {task.folder} and {existing_folder} are both called {name}: change 'name:' in the "
            "task.yaml of one of them"
        )
    register_task(name)(task)
    return task.name


def _read_task_folder(folder: Path) -> type[Task]:
    return load_plugin("task_folder", "part", sibling="parts")(folder)


def content_digest(task: type[Task]) -> str:
    """Return a digest of the files of a task's folder as they are now; "" if the task has no folder."""
    return "" if task.folder is None else _read_task_folder(task.folder).digest


def environment_id(name: str) -> str:
    """Return the id of a task's environment for `gymnasium.make`; an id of another package is returned unchanged."""
    if name not in TASKS.names() and name in gymnasium.registry:
        return name
    return f"{name if '/' in name else f'guiderail/{name}'}-v0"


def register_envs() -> None:
    """Register the environments of all tasks of this package and of installed packages; `import guiderail` calls it."""
    for name in TASKS.names():
        _register_env(name)


def _register_env(name: str) -> None:
    if environment_id(name) not in gymnasium.registry:
        gymnasium.register(
            id=environment_id(name),
            entry_point="guiderail.diagrams.envs.make:make_env",
            vector_entry_point="guiderail.diagrams.envs.make:make_vector_env",
            kwargs={"task": name},
        )
