"""Tasks by name: the one place where tools ask which there are and what they take."""

import inspect
from collections.abc import Mapping
from typing import Any, cast

import gymnasium
from gymnasium.envs.registration import load_env_creator
from threadpoolctl import threadpool_limits

import guiderail.diagrams  # noqa: F401 (registers the environments)
from guiderail.models.errors import InputError


def known_tasks() -> list[str]:
    """The tasks that there are."""
    return sorted(spec.name for spec in gymnasium.registry.values() if spec.namespace == "guiderail")


def check_environment(task: str, arguments: Mapping[str, Any]) -> dict[str, Any]:
    """The arguments of a task's environment, its defaults filled in.

    Raises:
        InputError: for an unknown task, or an argument that it does not take.
    """
    if task not in known_tasks():
        raise InputError(f"there is no task {task!r}: choose one of {', '.join(known_tasks())}")
    entry = gymnasium.spec(f"guiderail/{task}-v0").entry_point
    creator = load_env_creator(entry) if isinstance(entry, str) else cast(Any, entry)
    taken = {k: v for k, v in inspect.signature(creator).parameters.items() if k not in ("self", "render_mode")}
    unknown = sorted(set(arguments) - set(taken))
    if unknown:
        raise InputError(f"{task} has no argument {unknown[0]}: it takes {', '.join(taken)}")
    defaults = {key: parameter.default for key, parameter in taken.items()}
    return {k: arguments.get(k, v) for k, v in defaults.items() if k in arguments or v is not inspect.Parameter.empty}


def make_environment(task: str, arguments: Mapping[str, Any], render_mode: str | None = None) -> gymnasium.Env:
    """The environment of a task. From here on this process calculates with one thread.

    Matrices are small here. Where another process wants the cores too, threads that wait for each other take eighty
    times as long (a movement primitive with a history: 78 s for 1), and sums would depend on how many there are.

    Raises:
        InputError: for an unknown task or argument, or a pairing that makes no sense.
    """
    threadpool_limits(1)
    arguments = check_environment(task, arguments)
    return gymnasium.make(f"guiderail/{task}-v0", disable_env_checker=True, render_mode=render_mode, **arguments)


def most_decisions(env: gymnasium.Env) -> int:
    """The most decisions that an episode can take."""
    base = cast(Any, env.unwrapped)
    return -(-base.task.num_steps // base.hold)
