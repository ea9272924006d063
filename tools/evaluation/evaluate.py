"""`guiderail evaluate`: what a policy achieves on held-out conditions, beside the demonstration alone."""

import hashlib
import json
import sys
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import pandas as pd

from guiderail.diagrams.tasks.registry import TASKS
from guiderail.models.common.errors import InputError
from guiderail.models.policy import Policy
from guiderail.tools.environments import changed_environment, make_environment, task_content
from guiderail.tools.evaluation.baselines import still
from guiderail.tools.evaluation.metrics import episodes_to_convergence, summary
from guiderail.tools.evaluation.progress import EpisodeProgress
from guiderail.tools.evaluation.rollout import PolicyFn, check_compatible, check_seed, is_compatible, rollout
from guiderail.tools.files import write_atomically
from guiderail.tools.learning.run_folder import RunConfig, RunFolder, installed_versions
from guiderail.tools.tables import read_table, table_text
from guiderail.tools.visualization.style import is_demonstrated
from research.thesis import describe_differences

CALIBRATION = "per_run"  # the uncertainty under which a run hides an offset of its own
HELD_OUT_SEED = 1_000_000  # of the first held-out episode
COMPARED = (
    "success_rate", "success_low", "success_high", "mean_return", "mean_steps", "max_commanded_violation",
    "max_measured_violation", "collisions", "collision_steps", "peak_force", "mean_force",
)  # fmt: skip
SERIES = {
    "policy": "the policy", "demonstration": "demonstration alone", "zero": "no action", "uniform_random": "white noise",
    "constant": "one constant action", "scripted": "the rule written by hand",
}  # fmt: skip
"""Who acts in a series of held-out episodes, in words."""


COLLISIONS = ("collisions", "collision_steps")  # of them, those that a task declares a signal for


def evaluate_policy(
    env: gymnasium.Env,
    act: PolicyFn,
    *,
    episodes: int,
    seed: int = HELD_OUT_SEED,
    options: Mapping[str, Any] | None = None,
    words: str = "",
) -> pd.DataFrame:
    """Rows of held-out episodes; episode i has seed + i.

    Args:
        env: the environment; what is hidden in a run stays what it is, unless the reset option `new_run` is given.
        act: the policy.
        episodes: how many.
        seed: of the first.
        options: further ones of the resets.
        words: what its progress is called on standard error; without them there is none.

    Raises:
        InputError: for a number out of range.
    """
    if episodes < 1:
        raise InputError(f"an evaluation needs at least one episode, not {episodes}")
    check_seed(seed)
    rows = []
    with EpisodeProgress(episodes, name=words, window=None) if words else nullcontext() as progress:
        for i in range(episodes):
            rows.append(rollout(env, act, index=i, seed=seed + i, held_out=True, options=options))
            if progress is not None:
                progress.update(rows[-1])
    return pd.DataFrame(rows)


def evaluate_run(
    config: RunConfig,
    policy: Callable[[gymnasium.Env], PolicyFn],
    environment: Mapping[str, Any] | None = None,
    **how: Any,
) -> pd.DataFrame:
    """Rows of held-out episodes of a run's environment, or of one with other arguments.

    What is hidden and constant in the run is what it was in training. `policy` is what acts, for an environment; `how`
    are arguments of `evaluate_policy`.
    """
    env = make_environment(config.task, config.environment if environment is None else environment)
    try:
        env.reset(seed=config.seed)
        return evaluate_policy(env, policy(env), **how)
    finally:
        env.close()


def cached(file: Path, evaluated: Callable[[], pd.DataFrame]) -> pd.DataFrame:
    """The rows in a file; where there is none yet, those that come of evaluating, and then they are in it."""
    if not file.exists():
        rows = evaluated()
        if not len(rows):
            return rows
        write_atomically(file, table_text(rows).encode())
    return read_table(file)


def evaluate(
    run: Path,
    *,
    episodes: int = 100,
    seed: int = HELD_OUT_SEED,
    environment: Mapping[str, Any] | None = None,
    baselines: Mapping[str, Callable[[gymnasium.Env], PolicyFn]] | None = None,
    resample_offsets: bool = False,
) -> dict[str, Any]:
    """Evaluates the policy that a run left, beside policies that learned nothing.

    Args:
        run: the run's folder.
        episodes: how many, each with held-out initial conditions and offsets.
        seed: of the first; the policy and the demonstration meet the same ones.
        environment: arguments of the environment that are other ones than where it learned, such as the station.
        beside: what else acts in the same episodes, by a name: null policies and rules by hand. Their rows and the
            demonstration's are kept in the run's folder and used again; the policy's, where it learned, for a report.
        fresh: what is hidden and constant in the run is drawn anew in every episode.

    Returns:
        `evaluation_scope`, what the policy is then judged as; the statistics `COMPARED`, each also as `demonstration_<name>` (the
        same episodes before anything was learned; None where guidance has no demonstration, and those of collisions
        where the task declares no signal of them) and as `<policy>_<name>`
        for those beside it; `baselines`, the names of those that can act in this environment; `episodes` and `seed`;
        `episodes_to_convergence` and `trained_episodes` of the training; `differs_from_thesis`, in what task, learner and
        environment do, in words.

    Raises:
        InputError: if there is no trained run, a number is out of range, its policy sees or moves other things,
            nothing is hidden that could be drawn anew, or an episode would hide what the run did.
    """
    folder = RunFolder(run)
    config, policy, trained = folder.config(), Policy.load(folder.path), folder.episodes()
    where = changed_environment(config.task, config.environment, environment or {})
    how: dict[str, Any] = {"episodes": episodes, "seed": seed}
    claimed = evaluation_scope(config.task, where, resample_offsets)
    if resample_offsets:
        how["options"] = {"new_run": True}
        if seed <= config.seed < seed + episodes:  # what a run hides is drawn from its own seed
            raise InputError(
                f"episode {config.seed - seed} of these hides what the run itself hid: give another --seed, such as "
                f"{config.seed + 1}"
            )
    alone = {"demonstration": still} if is_demonstrated(where.get("guidance")) else {}
    them: dict[str, Callable[[gymnasium.Env], PolicyFn]] = {**alone, **(baselines or {})}
    series = {
        name: f"series {number} of {1 + len(them)}: {SERIES.get(name, name)}"
        for number, name in enumerate(("policy", *them), start=1)
    }
    rows = evaluate_run(
        config, partial(check_compatible, policy, learned_in=config.environment), where, words=series["policy"], **how
    )
    if where == config.environment and not resample_offsets:
        write_atomically(learned_file(folder.path, len(trained), seed, episodes), table_text(rows).encode())
    kept, judged = folder.path / "baselines", {}
    for name, acts in them.items():
        if kept_file(kept, name, config, where, **how).exists():
            print(f"{series[name]}: kept from before, and not run again", file=sys.stderr, flush=True)
        found = judged_once(kept, name, config, acts, where, words=series[name], **how)
        if found is not None:
            judged[name] = found
    others: dict[str, Any] = {}
    for name, found in ({"demonstration": pd.DataFrame()} | judged).items():
        others |= summary(found, COMPARED, f"{name}_")
    counts = _counts_collisions(config.task)
    statistics = {**summary(rows, COMPARED), **others}
    return {
        "evaluation_scope": claimed,
        **{key: value if counts or not key.endswith(COLLISIONS) else None for key, value in statistics.items()},
        "baselines": [*judged],
        "episodes": episodes,
        "seed": seed,
        "episodes_to_convergence": episodes_to_convergence(trained),
        "trained_episodes": len(trained),
        "differs_from_thesis": describe_differences(replace(config, environment=where)),
    }


def learned_file(run: Path, trained: int, seed: int, episodes: int) -> Path:
    """Where a report finds the held-out episodes of what a run learned in so many episodes."""
    return run / "held_out" / f"learned-{trained}-{seed}-{episodes}.csv"


def evaluation_scope(task: str, environment: Mapping[str, Any], resample_offsets: bool) -> str:
    """What a policy is judged as: one for what a run hides, or one for whatever may be hidden.

    Args:
        task: its name.
        environment: in which it is judged.
        fresh: whether what a run hides is drawn anew in every episode.

    Raises:
        InputError: if a run hides nothing that could be drawn anew.
    """
    if resample_offsets and not _can_hide(task):
        raise InputError(f"a run of {task} hides nothing that could be drawn anew: leave --resample-offsets out")
    if not has_held_out_distribution(task):
        return f"a policy for conditions as in training: {task} declares none that training never draws"
    if not _can_hide(task):
        return "a policy for starts that training never drew"
    if resample_offsets or not hides(task, environment):
        return "a policy for any offset: a new one in every episode"
    return "a policy for the one offset that is hidden in this run, and for no other (--resample-offsets: for any)"


def hides(task: str, environment: Mapping[str, Any]) -> bool:
    """Whether something is hidden that is the same in all episodes of a run, unless `new_run` draws it anew."""
    return _can_hide(task) and environment.get("fixture_offset", CALIBRATION) == CALIBRATION


def _can_hide(task: str) -> bool:
    return task in TASKS.names() and "new_run" in TASKS.get(task).Reset.model_fields


def _counts_collisions(task: str) -> bool:
    """Whether a task declares what a collision is; a `TerminationTerm` that ends an episode as one is not counted."""
    return task not in TASKS.names() or TASKS.get(task).declares_collision()


def has_held_out_distribution(task: str) -> bool:
    """Whether a task declares conditions that training never draws; one that is registered as Gymnasium's can't."""
    return task not in TASKS.names() or TASKS.get(task).has_held_out_distribution


def judged_once(
    kept: Path,
    name: str,
    config: RunConfig,
    acts: Callable[[gymnasium.Env], PolicyFn],
    environment: Mapping[str, Any],
    *,
    about: Any = None,
    **how: Any,
) -> pd.DataFrame | None:
    """Rows of held-out episodes of somebody who acts in a run's environment, kept in a folder and not run again.

    Args:
        kept: the folder.
        name: of who acts, in the file's name and in what is said meanwhile.
        config: the run's, for its task and what is hidden in it.
        acts: who acts, for an environment.
        environment: its arguments.
        about: what else the rows depend on.
        how: arguments of `evaluate_policy`.

    Returns:
        None if what they see or move is not this environment's.
    """
    file = kept_file(kept, name, config, environment, about=about, **how)
    how.setdefault("words", name)
    judged = partial(evaluate_run, config, partial(_suited, acts), environment, **how)
    try:
        return cached(file, judged)
    except _NotSuitedError:
        return None


def kept_file(
    kept: Path, name: str, config: RunConfig, environment: Mapping[str, Any], *, about: Any = None, **how: Any
) -> Path:
    """The file that `judged_once` keeps its rows in, named by all that decides them; the arguments are its own."""
    deciding = {key: value for key, value in how.items() if key != "words"}
    content = task_content(config.task, environment, config.imports)
    about = [*([] if about is None else [about]), *filter(None, [content])]
    told = json.dumps([environment, deciding, config.seed, installed_versions(), *about], sort_keys=True, default=str)
    return kept / f"{name}-{hashlib.blake2b(told.encode(), digest_size=6).hexdigest()}.csv"


class _NotSuitedError(Exception):
    """A policy whose observations or actions are not an environment's."""


def _suited(policy: Callable[[gymnasium.Env], PolicyFn], env: gymnasium.Env) -> PolicyFn:
    """What acts, if its observations and actions are the environment's."""
    if not is_compatible(policy, env):
        raise _NotSuitedError
    return policy(env)
