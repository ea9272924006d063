"""Evaluation of a policy on held-out episodes, together with baseline policies."""

import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, cast

import gymnasium
import numpy as np
import pandas as pd

from guiderail.diagrams.guidance.registry import GUIDANCE
from guiderail.diagrams.tasks.registry import TASKS
from guiderail.models.common.errors import InputError
from guiderail.models.policy import Policy
from guiderail.models.primitives import Demonstrations
from guiderail.tools.datasets.paths import ENDINGS, check_new
from guiderail.tools.environments import changed_environment, make_environment
from guiderail.tools.evaluation.baselines import MakePolicy, make_baseline, scripted_policies, zero_policy
from guiderail.tools.evaluation.cache import (
    BASELINES_FOLDER,
    POLICY,
    POLICY_FOLDER,
    episodes_file,
    load_or_compute,
    policy_digest,
)
from guiderail.tools.evaluation.metrics import episodes_to_convergence, summary
from guiderail.tools.evaluation.progress import EpisodeProgress
from guiderail.tools.evaluation.rollout import PolicyFn, check_compatible, check_seed, is_compatible, rollout
from guiderail.tools.files import write_atomically
from guiderail.tools.learning.run_folder import RunConfig, RunFolder
from guiderail.tools.tables import table_text
from guiderail.tools.visualization.style import is_demonstrated

HELD_OUT_SEED = 1_000_000  # seed of the first held-out episode
COMPARED = (
    "success_rate", "success_low", "success_high", "mean_return", "mean_steps", "max_commanded_violation",
    "max_measured_violation", "collisions", "collision_steps", "peak_force", "mean_force",
)  # fmt: skip
"""Statistics of the policy and of every baseline policy."""
COLLISIONS = ("collisions", "collision_steps")  # those that need a task with a collision signal
LABELS = {
    POLICY: "policy", "demonstration": "demonstration alone", "zero": "zero action",
    "uniform_random": "uniform random actions", "constant": "constant action", "scripted": "scripted policy",
}  # fmt: skip
SIGNALS = ("commanded", "measured")  # poses that can be saved as demonstrations


def evaluate_policy(
    env: gymnasium.Env,
    act: PolicyFn,
    *,
    episodes: int,
    seed: int = HELD_OUT_SEED,
    options: Mapping[str, Any] | None = None,
    label: str = "",
    on_episode: Callable[[gymnasium.Env, Mapping[str, Any]], None] | None = None,
) -> pd.DataFrame:
    """Return the rows of held-out episodes.

    Args:
        env: Environment; what is constant in a run stays as it is, unless the reset option `new_run` is given.
        act: Policy.
        episodes: Number of episodes.
        seed: Seed of the first; episode i has seed + i.
        options: Further options of the resets.
        label: Name of the progress bar on standard error; no bar if empty.
        on_episode: Called with the environment and the row after each episode.

    Raises:
        InputError: If a number is out of range.
    """
    if episodes < 1:
        raise InputError(f"an evaluation needs at least one episode, not {episodes}")
    check_seed(seed)
    rows = []
    with EpisodeProgress(episodes, name=label, window=None) if label else nullcontext() as progress:
        for i in range(episodes):
            rows.append(rollout(env, act, index=i, seed=seed + i, held_out=True, options=options))
            if on_episode is not None:
                on_episode(env, rows[-1])
            if progress is not None:
                progress.update(rows[-1])
    return pd.DataFrame(rows)


def evaluate_run(
    config: RunConfig,
    make_policy: MakePolicy,
    environment: Mapping[str, Any] | None = None,
    **how: Any,
) -> pd.DataFrame:
    """Return the rows of held-out episodes in a run's environment, or with other options of it.

    What is hidden and constant in the run is what it was in training.

    Args:
        config: Configuration of the run.
        make_policy: Makes the policy for the environment.
        environment: Options of the environment; those of the run by default.
        how: Arguments of `evaluate_policy`.
    """
    env = make_environment(config.task, config.environment if environment is None else environment)
    try:
        env.reset(seed=config.seed)
        return evaluate_policy(env, make_policy(env), **how)
    finally:
        env.close()


def evaluate_once(
    folder: Path,
    name: str,
    config: RunConfig,
    make_policy: MakePolicy,
    environment: Mapping[str, Any],
    *,
    about: Any = None,
    **how: Any,
) -> pd.DataFrame | None:
    """Return the rows of held-out episodes from a folder, or evaluate and store them there.

    Args:
        folder: Folder of the files.
        name: Name of the policy, in the file and as the default label of the progress.
        config: Configuration of the run, for its task and what is hidden in it.
        make_policy: Makes the policy for the environment.
        environment: Options of the environment.
        about: Anything else that the rows depend on.
        how: Arguments of `evaluate_policy`.

    Returns:
        None if the observation or action of the policy is not that of the environment.
    """
    file = episodes_file(folder, name, config, environment, about=about, **how)
    how.setdefault("label", name)
    try:
        return load_or_compute(
            file, partial(evaluate_run, config, partial(_make_compatible, make_policy), environment, **how)
        )
    except _IncompatibleError:
        return None


class _IncompatibleError(Exception):
    """Policy with other observations or actions than an environment."""


def _make_compatible(make_policy: MakePolicy, env: gymnasium.Env) -> PolicyFn:
    if not is_compatible(make_policy, env):
        raise _IncompatibleError
    return make_policy(env)


@dataclass(frozen=True)
class _Subject:
    """Policy that is evaluated.

    Attributes:
        config: Configuration of its run; of no run, one with the environment it is evaluated in.
        make_policy: Makes the policy for an environment.
        folder: Its run, or None.
        is_learned: Whether its actions were learned through the run's guidance.
    """

    config: RunConfig
    make_policy: MakePolicy
    folder: RunFolder | None
    is_learned: bool


def evaluate(
    run_or_policy: Path | str | PolicyFn,
    task: str | None = None,
    *,
    environment: Mapping[str, Any] | None = None,
    episodes: int = 100,
    seed: int = HELD_OUT_SEED,
    baselines: Mapping[str, MakePolicy] | Sequence[str] | None = (),
    resample_offsets: bool = False,
    save: Path | None = None,
    signal: str = "commanded",
    describe_differences: Callable[[RunConfig], Sequence[str]] | None = None,
) -> dict[str, Any]:
    """Evaluate a policy on held-out episodes, together with baseline policies on the same episodes.

    The rows of the baseline policies are stored in the run's folder and used again; so are those of the run's policy in
    its own environment, for a report.

    Args:
        run_or_policy: Folder of a run. With `task`: the folder of a policy, a function from an observation to an
            action, or the name of a baseline policy.
        task: Name of the task that a policy without a run is evaluated in.
        environment: Options of the environment that differ from those of the run, or of the task's defaults.
        episodes: Number of held-out episodes.
        seed: Seed of the first; episode i has seed + i.
        baselines: Baseline policies: their names, or functions that make them, by name; None for the default set of
            the task. The demonstration alone is always evaluated where the guidance has one.
        resample_offsets: Whether what is hidden and constant in a run is sampled again in every episode.
        save: File of demonstrations to write from the successful episodes, .npz or .csv; it must not exist.
        signal: Poses that are saved: "commanded", which a primitive should learn under impedance control because the
            contact force is in their difference from the measured ones, or "measured".
        describe_differences: Returns sentences on how a configuration differs from a reference, for `differences`.

    Returns:
        `evaluation_scope`, what the result is valid for; the statistics `COMPARED`, each also as
        `demonstration_<name>` (None without a demonstration) and `<baseline>_<name>`; `baselines`, the names of the
        baseline policies evaluated, and `skipped_baselines`, those with another observation or action;
        `episodes` and `seed`; `episodes_to_convergence` and `trained_episodes` of the training, None without a run;
        `saved`, the number of saved demonstrations, if `save` is given; `differences`, if `describe_differences` is.
        Collisions are None if the task declares no collision signal.

    Raises:
        InputError: If there is no trained policy, an argument is out of range, the policy's observation, action or
            guidance does not match the environment, nothing can be resampled, or an episode would repeat the offset of
            the run.
    """
    if signal not in SIGNALS:
        raise InputError(f"there is no signal {signal!r} to save: choose one of {', '.join(SIGNALS)}")
    check_seed(seed)
    if save is not None:
        if save.suffix not in ENDINGS:
            raise InputError(f"{save} has the ending {save.suffix!r}: demonstrations are .npz or .csv")
        check_new(save, "file")
    subject = _find_subject(run_or_policy, task, environment or {})
    config, folder = subject.config, subject.folder
    where = changed_environment(config.task, config.environment, environment or {})
    scope = evaluation_scope(config.task, where, resample_offsets)
    if subject.is_learned and (remark := check_guidance_change(config.environment, where)):
        scope += f"; {remark}"
        print(f"the policy acts {remark}", file=sys.stderr, flush=True)
    how: dict[str, Any] = {"episodes": episodes, "seed": seed}
    if resample_offsets:
        how["options"] = {"new_run": True}
        if seed <= config.seed < seed + episodes:  # the offset of a run is sampled with its seed
            raise InputError(
                f"episode {config.seed - seed} of these has the offset of the run itself: give another --seed, such as "
                f"{config.seed + 1}"
            )
    others = {"demonstration": zero_policy} if is_demonstrated(where.get("guidance")) else {}
    if not isinstance(baselines, Mapping):
        names = default_baselines(config.task, where) if baselines is None else baselines
        baselines = {name: make_baseline(config.task, name, config.seed) for name in names}
    others |= baselines
    labels = {
        name: f"series {number} of {1 + len(others)}: {LABELS.get(name, name)}"
        for number, name in enumerate((POLICY, *others), start=1)
    }
    recorder = None if save is None else _DemonstrationRecorder(signal)
    rows = evaluate_run(config, subject.make_policy, where, label=labels[POLICY], on_episode=recorder, **how)
    if folder is not None and subject.is_learned and where == config.environment and not resample_offsets:
        digest = policy_digest(folder)
        file = episodes_file(folder.path / POLICY_FOLDER, POLICY, config, where, about=digest, **how)
        write_atomically(file, table_text(rows).encode())
    evaluated: dict[str, pd.DataFrame] = {}
    for name, make_policy in others.items():
        found = _evaluate_baseline(folder, name, config, make_policy, where, label=labels[name], **how)
        if found is not None:
            evaluated[name] = found
    statistics = summary(rows, COMPARED)
    for name, found in ({"demonstration": pd.DataFrame()} | evaluated).items():
        statistics |= summary(found, COMPARED, f"{name}_")
    counts = _counts_collisions(config.task)
    trained = None if folder is None else folder.episodes()
    result = {
        "evaluation_scope": scope,
        **{key: value if counts or not key.endswith(COLLISIONS) else None for key, value in statistics.items()},
        "baselines": [*evaluated],
        "skipped_baselines": [name for name in others if name not in evaluated],
        "episodes": episodes,
        "seed": seed,
        "episodes_to_convergence": None if trained is None else episodes_to_convergence(trained),
        "trained_episodes": None if trained is None else len(trained),
    }
    if recorder is not None and save is not None:
        result["saved"] = recorder.save(save)
    if describe_differences is not None:
        result["differences"] = list(describe_differences(replace(config, environment=where)))
    return result


def _find_subject(run_or_policy: Path | str | PolicyFn, task: str | None, environment: Mapping[str, Any]) -> _Subject:
    """Return the policy that is evaluated, with the configuration of its run or of the task."""
    if task is None:
        if not isinstance(run_or_policy, Path | str):
            raise InputError("a policy without a run is evaluated in a task: name it")
        folder = RunFolder(run_or_policy)
        config, policy = folder.config(), Policy.load(folder.path)
        make_policy = partial(check_compatible, policy, learned_in=config.environment)
        return _Subject(config, make_policy, folder, True)
    from guiderail.tools.learning.train import configure

    config = configure(task, environment)
    if not isinstance(run_or_policy, Path | str):
        return _Subject(config, lambda env: run_or_policy, None, False)
    if Path(run_or_policy).is_dir():
        return _Subject(config, partial(check_compatible, Policy.load(Path(run_or_policy))), None, False)
    return _Subject(config, make_baseline(task, str(run_or_policy), config.seed), None, False)


def _evaluate_baseline(
    folder: RunFolder | None,
    name: str,
    config: RunConfig,
    make_policy: MakePolicy,
    environment: Mapping[str, Any],
    *,
    label: str,
    **how: Any,
) -> pd.DataFrame | None:
    """Return the rows of a baseline policy; stored in the run's folder, if there is a run."""
    if folder is None:
        try:
            return evaluate_run(config, partial(_make_compatible, make_policy), environment, label=label, **how)
        except _IncompatibleError:
            return None
    stored = folder.path / BASELINES_FOLDER
    if episodes_file(stored, name, config, environment, **how).exists():
        print(f"{label}: evaluated before, and used again", file=sys.stderr, flush=True)
    return evaluate_once(stored, name, config, make_policy, environment, label=label, **how)


class _DemonstrationRecorder:
    """Collects the poses of successful episodes."""

    def __init__(self, signal: str):
        self._signal = signal
        self._times: list[Any] = []
        self._outputs: list[Any] = []

    def __call__(self, env: gymnasium.Env, row: Mapping[str, Any]) -> None:
        if row["success"]:
            trace = cast(Any, env.unwrapped).trace
            self._outputs.append(getattr(trace, self._signal).copy())
            self._times.append(trace.period * np.arange(1, len(trace) + 1))

    def save(self, file: Path) -> int:
        """Write the demonstrations, if there are any; return their number."""
        if self._outputs:
            Demonstrations(self._times, self._outputs).save(file)
        return len(self._outputs)


def default_baselines(task: str, environment: Mapping[str, Any]) -> list[str]:
    """Return the names of the baseline policies that a task's evaluation includes by default.

    Args:
        task: Name of the task.
        environment: Options of its environment.
    """
    zero = [] if is_demonstrated(environment.get("guidance")) else ["zero"]
    has_scripted = bool(scripted_policies(task)) and environment.get("observation") != "image"
    return [*zero, "uniform_random", "constant", *(["scripted"] if has_scripted else [])]


def check_guidance_change(own: Mapping[str, Any], other: Mapping[str, Any]) -> str:
    """Return a remark if an environment has another guidance than the policy was trained with; empty if not.

    Args:
        own: Options of the environment that the policy was trained in.
        other: Options of the environment that it acts in.

    Raises:
        InputError: If actions of one guidance displace outputs and those of the other do not.
    """
    trained, used = str(own.get("guidance")), str(other.get("guidance"))
    if trained == used:
        return ""
    if not all(GUIDANCE.get(name).displaces for name in (trained, used)):
        raise InputError(
            f"the policy was trained with guidance {trained}, and its actions mean something else with {used}: leave "
            "guidance out of --env"
        )
    return f"with guidance {used}, and was trained with {trained}"


def evaluation_scope(task: str, environment: Mapping[str, Any], resample_offsets: bool) -> str:
    """Return what an evaluation is valid for: the hidden offset of one run, or offsets sampled in every episode.

    Args:
        task: Name of the task.
        environment: Options of its environment.
        resample_offsets: Whether what a run hides is sampled again in every episode.

    Raises:
        InputError: If `resample_offsets` is True and a run of the task hides nothing.
    """
    if resample_offsets and not _can_hide(task):
        raise InputError(f"a run of {task} has no hidden offset to resample: leave --resample-offsets out")
    if not has_held_out_distribution(task):
        return f"conditions as in training: {task} declares no held-out conditions"
    if not _can_hide(task):
        return "held-out starts"
    if resample_offsets or not hides(task, environment):
        return "any offset: sampled again in every episode"
    return "the one offset that is hidden in this run (--resample-offsets: any offset)"


def hides(task: str, environment: Mapping[str, Any]) -> bool:
    """Return True if something hidden is constant in all episodes of a run, unless `new_run` samples it again."""
    return _can_hide(task) and environment.get("fixture_offset", "per_run") == "per_run"


def _can_hide(task: str) -> bool:
    return task in TASKS.names() and "new_run" in TASKS.get(task).Reset.model_fields


def _counts_collisions(task: str) -> bool:
    """Return True if a task declares a collision signal; a `TerminationTerm` named collision is not one."""
    return task not in TASKS.names() or TASKS.get(task).declares_collision()


def has_held_out_distribution(task: str) -> bool:
    """Return True if a task declares held-out conditions, or is registered with Gymnasium only."""
    return task not in TASKS.names() or TASKS.get(task).has_held_out_distribution
