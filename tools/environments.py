"""Environments by name: tasks, their options, and `make_environment`."""

from __future__ import annotations

import hashlib
import inspect
import logging
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import gymnasium
import numpy as np
from gymnasium.envs.registration import load_env_creator
from gymnasium.spaces import Box

from guiderail.diagrams.envs.options import (
    Options,
    flat_options,
    kernel_from_options,
    option_fields,
)
from guiderail.diagrams.stations.registry import STATIONS
from guiderail.diagrams.tasks.registry import (
    GIVEN,
    TASKS,
    check_task_name,
    content_digest,
    environment_id,
    is_task_folder,
    register_task_folder,
)
from guiderail.models.common.arrays import parse_number
from guiderail.models.common.errors import InputError, brief
from guiderail.models.common.registry import did_you_mean

_LOGGER = logging.getLogger(__name__)
_POLICY_FILES = ("policy.json", "policy.safetensors")  # files of a policy in its folder


def task_named(name_or_folder: str) -> tuple[str, tuple[str, ...]]:
    """Return the name of a task from its name or folder, and the imports that a run of the task needs.

    An unknown name is returned unchanged.
    """
    if name_or_folder in TASKS.names() or not is_task_folder(name_or_folder):
        return name_or_folder, ()
    name = register_task_folder(name_or_folder)
    return name, (str(Path(name_or_folder).resolve()),)


def task_content(task: str, environment: Mapping[str, Any], imports: Iterable[str]) -> str:
    """Return a digest of the files that a task consists of; "" if all of them belong to installed packages.

    The digest covers the task folder and the imported files. It also covers the files that an option of the environment
    names, such as demonstrations or the code of FILE.py:FUNCTION, and the policy in a folder that an option names.
    Relative paths are skipped; `import_modules` returns absolute ones.
    """
    declared = TASKS.get(task) if task in TASKS.names() else None
    folder, folder_digest = (None, "") if declared is None else (declared.folder, content_digest(declared))
    texts = [value for _, value in sorted(environment.items()) if isinstance(value, str)]
    sources = [*imports, *(re.sub(r"\.py:\w+$", ".py", text) for text in texts)]
    paths = [path for path in map(Path, sources) if path.is_absolute() and folder not in (path, *path.parents)]
    files = [file for path in paths for file in (path, *(path / name for name in _POLICY_FILES)) if file.is_file()]
    if not files:
        return folder_digest
    digest = hashlib.blake2b(folder_digest.encode(), digest_size=16)
    for file in files:
        try:
            content = file.read_bytes()
        except OSError as error:
            raise InputError(f"{file} cannot be read ({error.strerror}): restore it") from error
        digest.update(len(content).to_bytes(8, "big") + content)
    return digest.hexdigest()


def task_options(task: str) -> dict[str, Any]:
    """Return the options of a task's environment with their defaults, `inspect.Parameter.empty` if there is none."""
    if task in TASKS.names():
        return check_environment(task, {})
    check_task_name(task)
    entry = gymnasium.spec(environment_id(task)).entry_point
    creator = load_env_creator(entry) if isinstance(entry, str) else cast(Any, entry)
    parameters = inspect.signature(creator).parameters.items()
    return {name: parameter.default for name, parameter in parameters if name not in ("self", "render_mode")}


def check_environment(task: str, arguments: Mapping[str, Any]) -> dict[str, Any]:
    """Return the arguments of a task's environment with all defaults filled in; see `resolve_environment`."""
    resolved = resolve_environment(task, arguments)
    return resolved if isinstance(resolved, dict) else resolved.options


def resolve_environment(task: str, arguments: Mapping[str, Any]) -> Any:
    """Return the validated `EnvConfig` of a registered task; for another task, its arguments with all defaults."""
    if task in TASKS.names():
        from guiderail.diagrams.envs.config import EnvConfig  # imports Drake

        return EnvConfig.resolve(task, arguments)
    options = task_options(task)
    for name, value in arguments.items():
        if name not in options:
            raise InputError(f"{task} has no option {brief(name)}: {did_you_mean(name, options)}")
        if not _is_like(value, options[name]):
            raise InputError(f"{task}'s {name} cannot be {brief(value)}: give a value such as {options[name]!r}")
    if task in gymnasium.registry:  # of another package, whose defaults may be any objects
        return dict(arguments)
    values = {name: arguments.get(name, default) for name, default in options.items()}
    return {name: value for name, value in values.items() if value is not inspect.Parameter.empty}


def flat_environment(task: str, options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options of a task's environment with entries of structured options as options; see `flat_options`."""
    return flat_options(options, TASKS.get(task).model_fields) if task in TASKS.names() else dict(options)


def warn_of_deviation(config: Any) -> None:
    """Warn if the motion without actions deviates from the demonstrations of an `EnvConfig`, if there are any.

    The motion deviates if less than the fraction `MIN_SHARE` of its steps lies within a standard deviation of the
    demonstrations.
    """
    from guiderail.models.primitives.fit import MIN_SHARE, share_within_spread  # imports SciPy, which takes a second

    reference = config.reference()
    if reference is None:
        return
    values = config.options
    chosen = {name: values[name] for name in ("lambda_", "beta", "horizon")}
    share = share_within_spread(reference, kernel_from_options(values), **chosen)
    if share < MIN_SHARE:
        _LOGGER.warning(
            "without actions, %.0f%% of the steps stay within a standard deviation of the demonstrations: let "
            "guiderail dataset validate FILE --fit choose length_scale, lambda_ and beta, and give them by --env",
            100 * share,
        )


def beyond_defaults(task: str, environment: Mapping[str, Any]) -> dict[str, Any]:
    """Return the arguments of an environment that differ from the defaults.

    Guidance, station and difficulty are compared with the task's defaults. All other arguments are compared with the
    defaults that these three determine.
    """
    environment = flat_environment(task, environment)
    names: tuple[str, ...] = ("guidance", "station", "difficulty")
    chosen = {key: environment[key] for key in names if key in environment}
    defaults = check_environment(task, chosen) | {key: check_environment(task, {}).get(key) for key in chosen}
    missing = object()
    return {key: value for key, value in environment.items() if defaults.get(key, missing) != value}


def changed_environment(task: str, environment: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return all arguments of a run's environment with changes.

    A change of difficulty replaces the settings that the run's own difficulty determined. A change of station removes
    the options that the new station does not have.
    """
    environment, changes = flat_environment(task, environment), flat_environment(task, changes)
    removed = _options_of_station_only(environment.get("station"), changes.get("station"))
    environment = {key: value for key, value in environment.items() if key not in removed}
    own = environment.get("difficulty")
    if changes.get("difficulty", own) == own:
        return {**environment, **changes}
    return check_environment(task, {**beyond_defaults(task, environment), **changes})


def _options_of_station_only(own: Any, other: Any) -> set[str]:
    """Return the options that the station `own` has and `other` does not have."""
    if other in (None, own) or not {own, other} <= {*STATIONS.names()}:
        return set()
    own_options, other_options = (option_fields(STATIONS.get(name).options or Options) for name in (own, other))
    return {*own_options} - {*other_options}


def _is_like(value: Any, default: Any) -> bool:
    """Return True if a value has the type of the default, or the default is missing or None."""
    if default is None or default is inspect.Parameter.empty:
        return True
    if isinstance(default, float):
        return isinstance(value, int | float) and not isinstance(value, bool)
    if isinstance(default, tuple):
        return isinstance(value, tuple | list)
    return isinstance(value, type(default)) and isinstance(value, bool) == isinstance(default, bool)


def as_value(text: str) -> Any:
    """Return a value typed on the command line, parsed as YAML; text that is not YAML is returned unchanged.

    A list becomes a tuple. Text that `float` accepts becomes a number, even if it is quoted.
    """
    # Plain values do not need the YAML reader, which is slow to import.
    if re.fullmatch(r"-?(0|[1-9][0-9]{0,14})", text):
        return int(text)
    if text not in ("null", "true", "false") and re.fullmatch(r"-?[0-9]{1,9}\.[0-9]{1,15}|[a-z_]+", text):
        return _parse_numbers(text)
    from guiderail.models.common.yaml import parse_yaml

    try:
        return _parse_numbers(parse_yaml(text))
    except InputError:
        return text


def _parse_numbers(value: Any) -> Any:
    if isinstance(value, list):
        return tuple(map(_parse_numbers, value))
    try:
        return parse_number(value) if isinstance(value, str) else value
    except ValueError:
        return value


def make_environment(task: str, arguments: Any, render_mode: str | None = None) -> gymnasium.Env:
    """Make the environment of a task from its options, or from a result of `resolve_environment`; see `make_env`."""
    resolved = resolve_environment(task, arguments) if isinstance(arguments, Mapping) else arguments
    keywords = dict(resolved) if isinstance(resolved, Mapping) else {"task": resolved}
    if render_mode is not None or environment_id(task) != task:  # others may not have the argument
        keywords["render_mode"] = render_mode
    return gymnasium.make(environment_id(task), disable_env_checker=True, **keywords)


class _KeptOpen(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Environment of the caller, which stays open."""

    def close(self) -> None:
        """Do nothing."""


def register_environment(env: gymnasium.Env) -> str:
    """Register an environment that is given as an object with Gymnasium, for this process; return its id."""
    kind = re.sub(r"\W", "", type(env.unwrapped).__name__) or "Environment"
    name = f"{GIVEN}{kind}-v{sum(known.startswith(f'{GIVEN}{kind}-v') for known in gymnasium.registry)}"

    def entry_point(**arguments: Any) -> gymnasium.Env[Any, Any]:
        return _KeptOpen(env)

    gymnasium.register(name, entry_point=entry_point, disable_env_checker=True, order_enforce=False)
    return name


@dataclass(frozen=True)
class OtherTask:
    """Properties of an environment of another package that training uses."""

    observation_space: gymnasium.Space[Any]  # observations
    num_steps: int  # largest number of actions in an episode
    symmetry: None = None  # no symmetry is known
    near_symmetry: None = None


def trained_task(env: gymnasium.Env, name: str) -> Any:
    """Return the task of an environment, or an `OtherTask` for an environment of another package."""
    task = getattr(env.unwrapped, "diagram", None)
    if hasattr(env.unwrapped, "trace") and task is not None:
        return task
    actions, observations = env.action_space, env.observation_space
    is_bounded = (
        isinstance(actions, Box) and len(actions.shape) == 1 and np.isfinite([*actions.low, *actions.high]).all()
    )
    if not is_bounded:
        raise InputError(
            f"{name} has the actions {brief(actions)}, and a learner needs a Box of shape (A,) with finite bounds: "
            "wrap the environment"
        )
    if not isinstance(observations, Box) or len(observations.shape) != 1:
        raise InputError(
            f"{name} has the observations {brief(observations)}, and a learner needs a Box of shape (n,): wrap the "
            "environment in gymnasium.wrappers.FlattenObservation"
        )
    num_steps = _step_limit(env)
    if num_steps is None:
        raise InputError(
            f"{name} has no limit of steps, so that an episode might never end: wrap it in "
            "gymnasium.wrappers.TimeLimit, or register it with max_episode_steps"
        )
    return OtherTask(observations, num_steps)


def _step_limit(env: Any) -> int | None:
    """Return the largest number of actions in an episode; None if no wrapper limits it."""
    from guiderail.tools.guided.guided_env import GuidedEnv

    repeat, limits = 1, []
    while isinstance(env, gymnasium.Wrapper):
        if isinstance(env, gymnasium.wrappers.TimeLimit):
            limits.append(-(-env._max_episode_steps // repeat))
        if isinstance(env, GuidedEnv):
            if (steps := getattr(env.guide, "num_steps", None)) is not None:
                limits.append(-(-steps // (repeat * env.action_repeat)))
            repeat *= env.action_repeat
        env = env.env
    return min(limits, default=None)


def task_of(env: gymnasium.Env, name: str) -> Any:
    """Return the task of an environment; `name` is the environment's name for the message."""
    task = getattr(env.unwrapped, "diagram", None)
    if task is None:
        raise InputError(f"{name} has no task of guiderail, so it can only be evaluated: register a task for it")
    return task
