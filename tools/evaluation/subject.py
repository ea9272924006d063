"""Policy that is evaluated or shown, the episode that is shown, and the baseline policies of an evaluation."""

from __future__ import annotations

import os
import re
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium

from guiderail.diagrams.envs.options import flat_options
from guiderail.diagrams.guidance.registry import is_demonstrated
from guiderail.diagrams.tasks.registry import TASKS, known_tasks
from guiderail.models.common.errors import InputError, brief
from guiderail.models.common.registry import did_you_mean
from guiderail.models.policy import Policy
from guiderail.tools.environments import changed_environment
from guiderail.tools.evaluation.baselines import BASELINES, BaselinePolicy, MakePolicy, make_baseline, scripted_policies
from guiderail.tools.evaluation.episode import HELD_OUT_SEED, PolicyFn, check_seed
from guiderail.tools.evaluation.evaluation import policy_digest
from guiderail.tools.evaluation.metrics import COLLISION
from guiderail.tools.evaluation.policies import (
    FunctionPolicy,
    as_policy,
    check_compatible,
    is_compatible,
    is_policy_file,
    load_policy,
)
from guiderail.tools.files import path_exists
from guiderail.tools.learning.learner import INTERFACE_OPTIONS
from guiderail.tools.learning.run_folder import RunConfig, RunFolder, configure
from guiderail.tools.pretrained import PRETRAINED, find_run


def default_baselines(task: str, environment: Mapping[str, Any]) -> list[str]:
    """Return the names of the baseline policies that a task's evaluation includes by default."""
    zero = [] if is_demonstrated(environment.get("guidance")) else ["zero"]
    has_scripted = bool(scripted_policies(task)) and not str(environment.get("observation")).startswith("image")
    return [*zero, "uniform_random", "constant", *(["scripted"] if has_scripted else [])]


def refuse_guidance_change(own: Mapping[str, Any], other: Mapping[str, Any]) -> None:
    """Raise an InputError if the guidance is not that of the training: guidance defines the meaning of actions."""
    trained, used = own.get("guidance"), other.get("guidance")
    if trained != used:
        raise InputError(
            f"the policy was trained with guidance {trained}, and its actions have another meaning with {used}: leave "
            "guidance out of --env, or train a policy with that guidance"
        )


def evaluation_scope(task: str, environment: Mapping[str, Any], resample_offsets: bool) -> str:
    """Return the scope of an evaluation, as text: the conditions that its result is valid for."""
    if resample_offsets and not _has_hidden_offset(task):
        raise InputError(f"a run of {task} has no hidden offset to resample: leave --resample-offsets out")
    if not has_held_out_distribution(task):
        return f"conditions as in training: {task} declares no held-out conditions"
    if not _has_hidden_offset(task):
        return "held-out starts"
    if resample_offsets or not has_constant_offset(task, environment):
        return "any offset: sampled again in every episode"
    return "the one offset that is hidden in this run (--resample-offsets: any offset)"


def has_constant_offset(task: str, environment: Mapping[str, Any]) -> bool:
    """Return True if all episodes of a run have the same hidden offset, unless a reset has the option `new_run`."""
    return _has_hidden_offset(task) and environment.get("fixture_offset", "per_run") == "per_run"


def _has_hidden_offset(task: str) -> bool:
    return task in TASKS.names() and "new_run" in TASKS.get(task).Reset.model_fields


def counts_collisions(task: str) -> bool:
    """Return True if a task declares a collision signal (a `TerminationTerm` does not count) or is not in `TASKS`."""
    return task not in TASKS.names() or TASKS.get(task).model_validate({}).collision is not None


def has_held_out_distribution(task: str) -> bool:
    """Return True if a task declares held-out conditions, or is registered with Gymnasium only."""
    return task not in TASKS.names() or TASKS.get(task).has_held_out_distribution


@dataclass(frozen=True)
class Subject:
    """Policy that is evaluated or shown."""

    name: str  # name of the policy
    # Configuration of its run. Without a run: configuration of the environment that it acts in, or None if the
    # environment is given as an object.
    config: RunConfig | None
    make_policy: MakePolicy  # function from an environment to the policy
    folder: RunFolder | None = None  # folder of its run, or None
    is_stored: bool = False  # True if evaluated episodes are stored in the run's folder
    digest: str | None = None  # digest of the policy, or name of a baseline policy, for the names of stored files

    def changed_environment(self, changes: Mapping[str, Any]) -> dict[str, Any]:
        """Return the environment's options with changes; `config` must not be None."""
        assert self.config is not None
        changed = changed_environment(self.config.task, self.config.environment, changes)
        if self.folder is not None:
            refuse_guidance_change(self.config.environment, changed)
        return changed


def find_environment(env: Any) -> Any:
    """Return the environment or the name of the task that `env` denotes.

    For an id of another package the environment is made, and for "guiderail/NAME-v0" the task's name is returned. Any
    other value is returned unchanged, including an unknown name.

    Args:
        env: Environment, name or folder of a task, id of an environment registered with Gymnasium, or None.
    """
    if env is None or isinstance(env, gymnasium.Env | os.PathLike):
        return env
    if not isinstance(env, str):
        raise InputError(
            f"an evaluation needs a policy and then the name of a task, the id of an environment registered with "
            f"Gymnasium, or an environment, not {brief(env)}"
        )
    if env in known_tasks() or not re.fullmatch(r"([\w.:-]+/)?[\w.:-]+-v\d+", env):
        return env
    spec = gymnasium.registry.get(env)
    if spec is None:
        raise InputError(
            f"no environment {brief(env)} is registered with Gymnasium: check the id, or import its package"
        )
    if spec.namespace == "guiderail":
        return spec.name
    try:
        return gymnasium.make(spec)
    except Exception as error:  # the constructor of another package can raise any exception
        raise InputError(f"the environment {env} cannot be made: {brief(str(error))}") from error


def find_subject(
    policy: Any, env: Any, environment: Mapping[str, Any] | None = None, *, trust_policy: bool = False
) -> Subject:
    """Return the subject of an evaluation or a visualization: a policy, and where it acts.

    Args:
        policy: A run, its folder, or `pretrained:NAME`. With `env`: any policy that `load_policy` or `as_policy` takes,
            or the name of a baseline policy.
        env: Name of the task, or an environment, that a policy without a run acts in; None for a run.
        environment: Options of the task's environment that differ from the defaults; unused for a run. `guidance` and
            `observation` are by default those with which a policy of this package was trained.
        trust_policy: True to read a policy file that can execute code.
    """
    if isinstance(policy, os.PathLike):
        policy = Path(policy)
    if env is None:
        if not isinstance(policy, Path | str) or is_policy_file(policy):
            raise InputError("a policy without a run acts in a task: name the task (--task)")
        if str(policy) in known_tasks() and not Path(policy).is_dir():
            raise InputError(f"{policy} is a task: name the policy that acts in it, such as --policy scripted")
        folder = RunFolder(find_run(policy))
        run_config = folder.config()
        run_config.refuse_changed_task(
            folder.path, "train again; with --task and --env its policy acts in the changed task"
        )
        # The policy is checked against the environment, which is not necessarily that of the run.
        make_policy = partial(check_compatible, Policy.load(folder.path), learned_in=run_config.environment)
        is_stored = not str(policy).startswith(PRETRAINED)
        return Subject(folder.path.name, run_config, make_policy, folder, is_stored, policy_digest(folder.path))
    source = find_run(policy) if isinstance(policy, Path | str) else None
    acting = None
    if source is not None and (is_policy_file(policy) or (path_exists(source) and source.is_dir())):
        acting = load_policy(source, trust_policy=trust_policy)
    config = None if isinstance(env, gymnasium.Env) else _configure(acting, env, environment or {})
    if not isinstance(policy, Path | str):
        act = as_policy(policy)
        digest = str(time.time_ns())  # unique, so that a function's stored episodes are never used again
        if isinstance(act, FunctionPolicy) or (act is policy and not isinstance(act, Policy)):
            return Subject("policy", config, lambda env: act, digest=digest)
        return Subject("policy", config, partial(check_compatible, act), digest=digest)
    if source is not None and acting is not None:
        make_policy = partial(check_compatible, acting)
        return Subject(source.name.replace(":", "."), config, make_policy, digest=policy_digest(source))
    name = str(policy)
    make_policy = partial(_make_compatible, name, make_baselines(config, {}, [name])[name])
    return Subject(name, config, make_policy, digest=name)


def _configure(policy: PolicyFn | None, task: str, options: Mapping[str, Any]) -> RunConfig:
    """Return the configuration of a task for a policy.

    Options on which the meaning of a policy's actions depends have by default the values with which it was trained, if
    the task accepts them; otherwise `check_compatible` names the difference.
    """
    declared = policy.description.get("environment") if isinstance(policy, Policy) else None
    if isinstance(declared, Mapping):
        own = {name: declared[name] for name in INTERFACE_OPTIONS if name in declared}
        try:
            return configure(task, own | flat_options(options))
        except InputError:
            pass
    return configure(task, options)


def _make_compatible(name: str, make_policy: MakePolicy, env: gymnasium.Env) -> PolicyFn:
    """Return a baseline or scripted policy for an environment; raise an InputError if it does not fit."""
    if not is_compatible(make_policy, env):
        raise InputError(
            f"the policy {name!r} does not fit the observations or actions of this environment: choose another policy, "
            "or the options that the policy is written for, such as difficulty=hard"
        )
    return make_policy(env)


def make_baselines(
    config: RunConfig | None, environment: Mapping[str, Any], baselines: Mapping[str, MakePolicy] | Sequence[str] | None
) -> Mapping[str, MakePolicy]:
    """Return functions that make baseline policies, by name.

    Args:
        config: Configuration with the task and the seed; None if the environment is given as an object.
        environment: Options of the environment, which determine the default set.
        baselines: Names of baseline policies, or the functions themselves by name; None for the default set.
    """
    if isinstance(baselines, Mapping):
        return baselines
    if config is not None:
        names = default_baselines(config.task, environment) if baselines is None else baselines
        return {name: make_baseline(config.task, name, config.seed) for name in names}
    names = ["zero", "uniform_random", "constant"] if baselines is None else baselines
    for name in names:
        if name not in BASELINES:
            raise InputError(f"there is no baseline policy {name!r}: {did_you_mean(name, BASELINES)}")
    return {name: partial(BaselinePolicy, BASELINES[name]) for name in names}


@dataclass(frozen=True)
class EpisodeSpec:
    """Held-out episode that is shown."""

    task: str  # name of the task
    environment: Mapping[str, Any]  # options of the environment
    policy: MakePolicy  # function that returns the policy for an environment
    acting: str  # label of the policy's motion
    title: str  # name of the policy or learner in the heading
    run_seed: int = 0  # seed of the run, from which its hidden values are sampled
    seed: int = HELD_OUT_SEED  # seed of the episode
    run: Path | None = None  # folder of the run; None without one, or for a pretrained policy

    @classmethod
    def of_policy(
        cls,
        policy: Path | str,
        environment: Mapping[str, Any] | None = None,
        seed: int = HELD_OUT_SEED,
        *,
        task: str | None = None,
        trust_policy: bool = False,
    ) -> EpisodeSpec:
        """Return an episode of a policy of any origin; a run's policy acts deterministically.

        Args:
            policy: Folder of a run, or `pretrained:NAME`; with `task`, any policy that `find_subject` takes.
            environment: Options of the environment that differ from the run's, or from the task's defaults.
            seed: Seed of the episode.
            task: Task of a policy without a run.
            trust_policy: True to read a policy file that can execute code.
        """
        subject = find_subject(policy, task, environment, trust_policy=trust_policy)
        config, folder = subject.config, subject.folder
        assert config is not None
        return cls(
            task=config.task,
            environment=subject.changed_environment(environment or {}),
            policy=subject.make_policy,
            acting=subject.name if folder is None else "after learning",
            title=subject.name if folder is None else config.learner.algorithm.upper(),
            run_seed=config.seed,
            seed=seed,
            run=folder.path if folder is not None and subject.is_stored else None,
        )

    def __post_init__(self) -> None:
        object.__setattr__(self, "seed", check_seed(self.seed))

    @property
    def heading(self) -> str:
        """Heading of the episode in one line."""
        parts = (self.task, self.environment.get("guidance"), self.title, self.environment.get("station"))
        return " · ".join(str(part) for part in parts if part)


def outcome(row: Mapping[str, Any]) -> str:
    """Describe the end of an episode, from its row: termination, control steps and, if known, peak force."""
    reason = row["termination"] or "running"
    meaning = f" ({COLLISION})" if reason == "collision" else ""
    force = f", peak force {row['peak_force']:.1f} N" if "peak_force" in row else ""
    return f"{reason} after {row['steps']} control steps{force}{meaning}"
