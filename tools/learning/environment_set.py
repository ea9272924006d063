"""Training over a set of environments: another environment in each episode, such as another part, station or engine."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from guiderail.diagrams.envs.task_diagram import Symmetry
from guiderail.models.common.errors import InputError, brief
from guiderail.models.common.yaml import load_yaml
from guiderail.tools.environments import check_environment, make_environment, task_content, task_named, trained_task
from guiderail.tools.learning.run_folder import RunConfig, SetMember, as_arguments
from guiderail.tools.spaces import describe_space

_NAME = re.compile(r"[A-Za-z][\w .+-]*")  # name of a variant; not a number, because tables would read it as one


class EnvironmentSet(gymnasium.Env):
    """Environment in which every episode is an episode of one of several environments with equal interfaces.

    `select` chooses the environment of an episode. Within a block of as many episodes as there are environments, each
    environment is chosen once, in a random order that depends only on the seed and the block. All other attributes,
    such as `trace` or `diagram`, are those of the current environment.

    Attributes:
        members: Environments by name.
        current: Name of the current environment.
        privileged_space: Space of the privileged observation; None if an environment has none, or they differ.
        observes_privileged: As in `DiagramEnv`; it is set in all environments.
    """

    metadata = {"render_modes": []}  # noqa: RUF012 (Gymnasium's own convention)

    def __init__(self, members: Mapping[str, gymnasium.Env], seed: int):
        """Construct the set from environments by name, at least one; `close` closes them."""
        self.members, self.current, self._seed = dict(members), next(iter(members)), seed
        first = self.members[self.current]
        self.observation_space, self.action_space = first.observation_space, first.action_space
        for name, env in self.members.items():
            _check_interface(self.current, first, name, env)
        spaces = [getattr(env.unwrapped, "privileged_space", None) for env in self.members.values()]
        self.privileged_space = spaces[0] if all(space == spaces[0] for space in spaces) else None

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_") or name in ("members", "current"):
            raise AttributeError(name)
        return getattr(self.members[self.current].unwrapped, name)

    @property
    def observes_privileged(self) -> bool:
        """True if the environments provide privileged observations."""
        return all(getattr(env.unwrapped, "observes_privileged", False) for env in self.members.values())

    @observes_privileged.setter
    def observes_privileged(self, value: bool) -> None:
        for env in self.members.values():
            env.unwrapped.observes_privileged = value  # type: ignore[attr-defined]

    def select(self, index: int) -> str:
        """Choose the environment of the episode number `index`, from 0, and return its name."""
        block, place = divmod(index, len(self.members))
        order = np.random.default_rng([self._seed, block]).permutation(len(self.members))
        self.current = list(self.members)[order[place]]
        return self.current

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start an episode in the current environment.

        With a seed, all environments are reset with it, which samples their values that are constant in a run. They
        share the random generator of the set.
        """
        super().reset(seed=seed)
        if seed is not None:
            for env in self.members.values():
                env.reset(seed=seed)
        env = self.members[self.current]
        env.unwrapped.np_random = self.np_random
        return env.reset(options=options)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Return the result of a step of the current environment."""
        return self.members[self.current].step(action)

    def close(self) -> None:
        """Close the environments."""
        for env in self.members.values():
            env.close()


def _check_interface(first_name: str, first: gymnasium.Env, name: str, env: gymnasium.Env) -> None:
    """Raise an InputError if an environment of a set has another interface than the first one."""
    for what, own, other in (
        ("observations", env.observation_space, first.observation_space),
        ("actions", env.action_space, first.action_space),
    ):
        if own != other:
            raise InputError(
                f"{name} has the {what} {describe_space(own)} and {first_name} {describe_space(other)}: the "
                "environments of a set need the same observation, guidance and action_dims"
            )
    diagrams = (getattr(each.unwrapped, "diagram", None) for each in (env, first))
    own_terms, other_terms = (getattr(diagram, "reward_terms", None) for diagram in diagrams)
    if own_terms != other_terms:
        raise InputError(
            f"{name} has the reward terms {own_terms or 'of another package'} and {first_name} "
            f"{other_terms or 'of another package'}: give the environments of a set the same reward"
        )


@dataclass(frozen=True)
class TrainedSet:
    """Properties of a set of environments that training uses, as a task diagram has them."""

    observation_space: gymnasium.Space[Any]  # observations of every environment
    num_steps: int  # largest number of actions in an episode, times the mean action repeat
    symmetry: Symmetry | None  # symmetries of all environments
    near_symmetry: Symmetry | None  # symmetries of any environment: a turned part is another part


def make_run_environment(config: RunConfig) -> gymnasium.Env:
    """Make the environment of a run, or the set of its environments."""
    if not config.members:
        return make_environment(config.task, config.resolved)
    envs: dict[str, gymnasium.Env] = {}
    try:
        for member in config.members:
            envs[member.name] = make_environment(member.task, member.environment)
        return EnvironmentSet(envs, config.seed)
    except BaseException:
        for env in envs.values():
            env.close()
        raise


def select_environment(env: gymnasium.Env, index: int) -> str | None:
    """Choose the environment of an episode in a set and return its name; None for a single environment."""
    base = env.unwrapped
    return base.select(index) if isinstance(base, EnvironmentSet) else None


def trained_set(env: EnvironmentSet, config: RunConfig) -> TrainedSet:
    """Return the properties of a set that training uses."""
    tasks = {member.name: trained_task(env.members[member.name], member.task) for member in config.members}
    repeats = {name: getattr(each.unwrapped, "action_repeat", 1) for name, each in env.members.items()}
    actions = max(-(-task.num_steps // repeats[name]) for name, task in tasks.items())
    near = [task.near_symmetry for task in tasks.values()]
    exact = [task.symmetry for task in tasks.values()]
    return TrainedSet(
        env.observation_space,
        actions * config.action_repeat,
        _join(exact, shared=True),
        _join([each for each in near if each is not None], shared=False),
    )


def _join(symmetries: Sequence[Symmetry | None], *, shared: bool) -> Symmetry | None:
    """Return the symmetries that all of several environments have, or with `shared` False those that any has."""
    sides: dict[bytes, list[Any]] = {}
    for symmetry in symmetries:
        if symmetry is None:
            return None
        for number, (observation, action) in enumerate(zip(symmetry.observations, symmetry.actions, strict=True)):
            privileged = None if symmetry.privileged is None else symmetry.privileged[number]
            entry = sides.setdefault(observation.tobytes() + action.tobytes(), [observation, action, privileged, 0])
            entry[3] += 1
            entry[2] = entry[2] if privileged is not None else None
    chosen = [entry for entry in sides.values() if entry[3] == len(symmetries) or not shared]
    if not chosen:
        return None
    observations, actions, privileged, _ = zip(*chosen, strict=True)
    has_privileged = all(matrix is not None for matrix in privileged)
    return Symmetry(np.array(observations), np.array(actions), np.array(privileged) if has_privileged else None)


Variants = Mapping[str, Mapping[str, Any]]
"""Options of environments by the name of the variant; the option `task` names another task or task folder."""


def load_variants(source: Variants | Path | str | None) -> Variants:
    """Return variants, or those of a YAML file; none for None.

    The paths of task folders in a file are relative to the file.
    """
    if source is None:
        return {}
    path = None if isinstance(source, Mapping) else Path(source)
    values = source if path is None else load_yaml(path, "file of variants")
    what = "variants" if path is None else str(path)
    if not isinstance(values, Mapping) or not values:
        raise InputError(f"{what} must be options of the environment by the variant's name, not {brief(values)}")
    variants = {}
    for name, options in values.items():
        if not (isinstance(name, str) and _NAME.fullmatch(name)):
            raise InputError(f"{what}: a variant's name begins with a letter, and is not {brief(name)}")
        if not isinstance(options, Mapping) or not all(isinstance(key, str) for key in options):
            raise InputError(f"{what}: {name} must be options of the environment by name, not {brief(options)}")
        options = as_arguments(dict(options))
        if path is not None and "task" in options and (path.parent / str(options["task"]) / "task.yaml").is_file():
            options["task"] = str(path.parent / str(options["task"]))
        variants[name] = options
    return variants


def find_members(
    tasks: Sequence[str], environment: Mapping[str, Any], variants: Variants, imports: Sequence[str] = ()
) -> tuple[tuple[SetMember, ...], tuple[str, ...]]:
    """Return the environments of a set, and the task folders that a run must import.

    Every task is combined with every variant. The options of a variant replace those in `environment`.

    Args:
        tasks: Names of tasks, or task folders.
        environment: Options of all environments.
        variants: Variants by name; empty for the tasks alone.
        imports: Modules and files that register tasks, as `import_modules` returns them.
    """
    members: list[SetMember] = []
    folders: dict[str, None] = {}
    for task in tasks:
        for variant, options in (variants or {"": {}}).items():
            values = {**environment, **options}
            name, more = task_named(str(values.pop("task", task)))
            folders |= dict.fromkeys(more)
            label = " ".join(part for part in (name if len(tasks) > 1 or not variant else "", variant) if part)
            resolved = check_environment(name, values)
            content = task_content(name, resolved, imports)
            members.append(SetMember(label, name, as_arguments(resolved), content))
    names = [member.name for member in members]
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"two environments of the set are called {name}: give each task once")
    kinds = {member.environment.get("guidance") for member in members}
    if len(kinds) > 1:
        raise InputError(
            f"the environments of a set need the same guidance, not {' and '.join(map(str, kinds))}: give --guidance"
        )
    return tuple(members), tuple(folders)


def member_config(config: RunConfig, member: SetMember) -> RunConfig:
    """Return the configuration of a run with one environment of its set as the only one."""
    return replace(
        config, task=member.task, environment=member.environment, task_content=member.task_content, members=()
    )


def member_configs(config: RunConfig) -> dict[str, RunConfig]:
    """Return a configuration for each environment of a run's set, by its name; empty for a single environment."""
    return {member.name: member_config(config, member) for member in config.members}
