"""Evaluation of a policy on held-out episodes, together with baseline policies."""

import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, nullcontext
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Required, TypedDict, Unpack, cast

import gymnasium
import numpy as np
import pandas as pd

from guiderail.diagrams.guidance.registry import is_demonstrated
from guiderail.models.common.arrays import as_whole
from guiderail.models.common.errors import InputError, naming_failures
from guiderail.models.common.transforms import POSE_NAMES, POSE_SIZE
from guiderail.models.policy import Policy
from guiderail.models.primitives import Demonstrations
from guiderail.tools.environments import make_environment
from guiderail.tools.evaluation.baselines import MakePolicy, digest_of, zero_policy
from guiderail.tools.evaluation.episode import HELD_OUT_SEED, Callback, PolicyFn, check_seed, has_image
from guiderail.tools.evaluation.evaluation import (
    BASELINES_FOLDER,
    COLLISIONS,
    LABELS,
    POLICY,
    POLICY_FOLDER,
    Evaluation,
    compare,
    episodes_file,
    load_or_compute,
    policy_digest,
    read_complete,
    statistics,
)
from guiderail.tools.evaluation.forks import check_processes, forked_map
from guiderail.tools.evaluation.metrics import episodes_to_convergence
from guiderail.tools.evaluation.policies import as_policy, is_compatible
from guiderail.tools.evaluation.rollout import rollout
from guiderail.tools.evaluation.step_log import StepLog
from guiderail.tools.evaluation.subject import (
    Subject,
    counts_collisions,
    evaluation_scope,
    find_environment,
    find_subject,
    make_baselines,
)
from guiderail.tools.files import ENDINGS, check_new, write_atomically
from guiderail.tools.learning.environment_set import member_configs
from guiderail.tools.learning.run_folder import RunConfig, RunFolder
from guiderail.tools.progress import EpisodeProgress
from guiderail.tools.tables import table_text

STATED = ("guidance", "difficulty", "observation", "action_repeat")  # options that a result states without a run
SIGNALS = ("commanded", "measured")  # poses that can be saved as demonstrations

# Function from an environment and an episode's row to further data of the episode.
Collect = Callable[[gymnasium.Env, Mapping[str, Any]], Any]


class EpisodeChoices(TypedDict, total=False):
    """Held-out episodes that are evaluated; a choice that is missing has its default."""

    episodes: Required[int]  # number of episodes of each policy
    seed: int  # seed of the first episode; episode i has seed + i; default: `HELD_OUT_SEED`
    options: Mapping[str, Any] | None  # further options of the resets
    processes: int | None  # largest number of processes; default: 1; None: the number of cores
    # Number for `start_episode` in the first episode, incremented in each further one and taken modulo 2^32; default:
    # `seed` - `HELD_OUT_SEED`.
    first_number: int | None


def evaluate_policies(
    env: gymnasium.Env,
    policies: Mapping[str, PolicyFn],
    *,
    labels: Mapping[str, str] | None = None,
    collect: Collect | None = None,
    steps: Path | None = None,
    **choices: Unpack[EpisodeChoices],
) -> Iterator[tuple[str, pd.DataFrame, list[Any]]]:
    """Evaluate several policies on the same held-out episodes of one environment.

    Episodes are distributed over forks of this process. The conditions of an episode depend only on its seed, so the
    results do not depend on the number of processes. A policy with internal state must reset it in
    `Callback.on_episode_start`. A policy that samples random numbers must seed its generator in a method
    `start_episode(number)`, which is called before each episode with a number that depends on the episode's seed.

    Args:
        env: Environment. Its values that are constant in a run do not change without the reset option `new_run`.
        policies: Policies by name.
        labels: Labels of the progress bars on standard error, by policy name; no bar by default.
        collect: Function from the environment and an episode's row to further data of the episode.
        steps: Folder for the step log of the policy named `POLICY`; None for no step log.
        **choices: Episodes.

    Yields:
        Name of a policy, its rows, and the data that `collect` returned for each of its episodes (None without it).
    """
    episodes, seed = check_num_episodes(choices["episodes"]), check_seed(choices.get("seed", HELD_OUT_SEED))
    processes, options = check_processes(choices.get("processes", 1)), choices.get("options")
    first_number = choices.get("first_number")
    if has_image(env.observation_space):
        processes = 1  # the renderer has threads, which a fork does not inherit
    policies = {name: act if callable(act) else as_policy(act) for name, act in policies.items()}
    names = list(policies)
    first = seed - HELD_OUT_SEED if first_number is None else first_number

    def run(number: int) -> tuple[dict[str, Any], Any]:
        name, index = names[number // episodes], number % episodes
        act, title = policies[name], "the policy" if name == POLICY else f"the baseline policy {name!r}"
        if (start := getattr(act, "start_episode", None)) is not None:
            start((first + index) % 2**32)

        def named_act(observation: np.ndarray) -> np.ndarray:
            with naming_failures(title):
                return act(observation)

        callbacks: tuple[Callback, ...] = (act,) if isinstance(act, Callback) else ()
        if steps is not None and name == POLICY:
            callbacks = (*callbacks, StepLog(env, steps, act))
        row = rollout(env, named_act, *callbacks, index=index, seed=seed + index, held_out=True, options=options)
        return row, None if collect is None else collect(env, row)

    results = forked_map(run, len(names) * episodes, processes)
    for name in names:
        rows, data = [], []
        label = (labels or {}).get(name, "")
        with EpisodeProgress(episodes, name=label, window=None) if label else nullcontext() as progress:
            for _ in range(episodes):
                row, collected = next(results)
                rows.append(row)
                data.append(collected)
                if progress is not None:
                    progress.update(row)
        table = pd.DataFrame(rows)
        text = [column for column, kind in table.dtypes.items() if isinstance(kind, pd.StringDtype)]
        yield name, table.astype(dict.fromkeys(text, object)), data  # as `read_table` returns stored rows


def evaluate_policy(env: gymnasium.Env, act: PolicyFn, *, label: str = "", **kwargs: Any) -> pd.DataFrame:
    """Return the rows of held-out episodes of one policy; see `evaluate_policies` for the other arguments.

    `label` is the label of the progress bar on standard error; without a label there is no bar.
    """
    ((_, rows, _),) = evaluate_policies(env, {POLICY: act}, labels={POLICY: label}, **kwargs)
    return rows


def evaluate_run(
    config: RunConfig,
    make_policy: MakePolicy,
    environment: Mapping[str, Any] | None = None,
    *,
    skips_incompatible: bool = False,
    **kwargs: Any,
) -> pd.DataFrame:
    """Evaluate a policy in a run's environment, or with other environment options; return the episodes' rows.

    Hidden values that are constant in a run are the same as in its training. With `skips_incompatible`, a policy whose
    observation or action shape does not match the environment has no rows. Further arguments are those of
    `evaluate_policy`.
    """
    with closing(make_environment(config.task, config.environment if environment is None else environment)) as env:
        env.reset(seed=config.seed)
        with naming_failures(f"making the policy {kwargs.get('label', '')}".rstrip()):
            if skips_incompatible and not is_compatible(make_policy, env):
                return pd.DataFrame()
            policy = make_policy(env)
        return evaluate_policy(env, policy, **kwargs)


def evaluate_once(
    folder: Path | None,
    name: str,
    config: RunConfig,
    make_policy: MakePolicy,
    environment: Mapping[str, Any],
    *,
    about: Any = None,
    **kwargs: Any,
) -> pd.DataFrame | None:
    """Return the stored rows of held-out episodes; if there are none, evaluate the policy and store its rows.

    The task, and the seed of the hidden values, are those of `config`. See `episodes_file` for `about`. With `folder`
    None, the rows are not stored. Further arguments are those of `evaluate_policy`; the default label is `name`.

    Returns:
        Rows of the episodes, or None if the policy's observation or action shape does not match the environment.
    """
    compute = partial(
        evaluate_run, config, make_policy, environment, **{"label": name, "skips_incompatible": True, **kwargs}
    )
    if folder is None:
        rows = compute()
    else:
        file = episodes_file(folder, name, config, environment, about=about, **kwargs)
        rows = load_or_compute(file, compute, kwargs.get("episodes"))
    return rows if len(rows) else None


def evaluate_trained(folder: RunFolder, config: RunConfig, episodes: int) -> pd.DataFrame:
    """Return held-out episodes of a run's policy, one row each, in its own environment or in each one of its set.

    The episodes are stored in the run's folder, and read from there if they are stored already. They are simulated in
    as many processes as there are cores.
    """
    policy = Policy.load(folder.path)
    tables = []
    for name, member in (member_configs(config) or {"": config}).items():
        rows = evaluate_once(
            folder.path / POLICY_FOLDER,
            POLICY,
            member,
            lambda env: policy,
            member.environment,
            about=policy_digest(folder.path),
            episodes=episodes,
            seed=HELD_OUT_SEED,
            processes=None,
        )
        if rows is not None:
            tables.append(rows.assign(environment=name) if name else rows)
    return pd.concat(tables, ignore_index=True) if tables else pd.DataFrame()


def evaluate(
    policy: Path | str | PolicyFn | Any,
    env: str | gymnasium.Env | Sequence[str | gymnasium.Env] | None = None,
    episodes: int = 100,
    *,
    baselines: Mapping[str, MakePolicy] | Sequence[str] | None = None,
    environment: Mapping[str, Any] | None = None,
    seed: int = HELD_OUT_SEED,
    processes: int | None = None,
    trust_policy: bool = False,
    resample_offsets: bool = False,
    save: Path | str | None = None,
    signal: str = "commanded",
    steps: Path | str | None = None,
) -> Evaluation:
    """Evaluate a policy on held-out episodes, together with baseline policies on the same episodes.

    The rows of baseline policies are stored in the run's folder, under the policies' names, and used again. For a
    baseline policy that is given as a function, this needs `partial(BaselinePolicy, FACTORY)`. The rows of the run's
    policy in its own environment are stored for a report.

    Args:
        policy: A run, its folder, or `pretrained:NAME`. With `env`: any policy that `load_policy` reads, the name of a
            baseline policy, a function from an observation to an action, or an object with a `predict` method, such as
            a model of Stable-Baselines3. Before the first episode, an object that does not declare
            `observation_space` and `action_space` is called with constant observations; a deep copy of the object is
            called if it can be copied.
        env: Environment of a policy without a run: name of a task, an environment, or an id that is registered with
            Gymnasium. An environment of another package is reset with the seed of the episode. The episode succeeds if
            `info["is_success"]` or `info["success"]` is true at any step. If `info` has neither, the statistics of
            success are None. The environment needs a limit of steps, such as `gymnasium.wrappers.TimeLimit`. A list of
            these is a set of environments, as is None for a run that was trained over a set.
        episodes: Number of held-out episodes; in a set, of each environment.
        baselines: Baseline policies: a list of their names, or functions that make them for an environment, by name.
            None is the default set of the task, and an empty set evaluates the policy alone. If the guidance of a task
            has a demonstration, every other set includes the demonstration alone; in an environment that is given as an
            object, it is the baseline policy "zero".
        environment: Options of the environment that differ from the run's options or the task's defaults.
        seed: Seed of the first episode; episode i has seed + i, on which the actions of random baselines depend too.
        processes: Largest number of processes; None for the number of cores. The results do not depend on it: a policy
            with internal state resets it in `Callback.on_episode_start`. A policy that samples random numbers seeds its
            generator in a method `start_episode(number)`, whose number depends on the episode's seed.
        trust_policy: True to read a policy file that can execute code: a zip of Stable-Baselines3 or TorchScript.
        resample_offsets: True to sample the hidden values, which are constant in a run, again in every episode.
        save: File of demonstrations to write from the successful episodes, .npz or .csv; it must not exist.
        signal: Poses that are saved, "commanded" or "measured". Under impedance control a primitive should learn the
            commanded poses, because their difference from the measured poses causes the contact force.
        steps: Folder to write the policy's step log into, with one row for each control step, in a set one folder for
            each environment; it must not exist. The log of an ensemble has the column `disagreement`.

    Returns:
        Mapping of statistics, with a table, a comparison and a sentence. Its entries: `evaluation_scope`, the
        conditions that the result is valid for; the statistics `COMPARED`, each also as `demonstration_<name>` (None
        without a demonstration) and `<baseline>_<name>`; `baselines`, the names of the evaluated baseline policies, and
        `skipped_baselines`, those that do not fit the environment's observation or action; `best_baseline` and `p`, the
        largest of the one-sided p-values against each baseline policy, if there is a `Comparison`; `episodes` and
        `seed`; `episodes_to_convergence` and `trained_episodes` of the training, None without a run; `saved`, the
        number of saved demonstrations, if `save` is given. In a set, the statistics are those of all episodes, whose
        rows have the column `environment`, and `environments` has the success rate of each policy in each environment.
        `collisions` and `collision_steps` are None if the task declares no collision signal.

    Raises:
        InputError: If there is no trained policy, an argument is out of range, the policy's observation, action or
            guidance does not match the environment, a baseline policy cannot have its name, `save` cannot be written,
            or the environment records no poses to save. With `resample_offsets`, also if the task has no hidden offset,
            or an episode has the seed, and so the offset, of the run.
    """
    options = _Options(
        check_num_episodes(episodes), check_seed(seed), check_processes(processes), baselines, environment or {},
        resample_offsets, None if save is None else Path(save), signal, None if steps is None else Path(steps),
    )  # fmt: skip
    options.check_files()
    envs: list[Any] = list(env) if isinstance(env, list | tuple) else [env]
    if not envs:
        raise InputError("a policy is evaluated in at least one environment: name a task")
    places: dict[str, tuple[Subject, Any, bool]] = {}  # by name: subject, environment, and True if the caller closes it
    for number, given in enumerate(envs):
        found = find_environment(given)
        subject = find_subject(policy, found, environment or {}, trust_policy=trust_policy)
        name = f"environment {number}" if subject.config is None else subject.config.task
        if name in places:
            raise InputError(f"{name} is given twice: give each environment once")
        places[name] = subject, found, found is given
    subject, found, is_given = next(iter(places.values()))
    if len(envs) > 1:
        return _evaluate_set(places, options)
    if subject.config is None or not subject.config.members:
        return _evaluate_subject(subject, found, is_given, options)
    configs = member_configs(subject.config)
    return _evaluate_set(
        {name: (replace(subject, config=config), None, False) for name, config in configs.items()}, options
    )


@dataclass(frozen=True)
class _Options:
    """Arguments of `evaluate`."""

    episodes: int
    seed: int
    processes: int
    baselines: Mapping[str, MakePolicy] | Sequence[str] | None
    environment: Mapping[str, Any]
    resample_offsets: bool
    save: Path | None
    signal: str
    steps: Path | None

    def check_files(self) -> None:
        """Raise an InputError if the step log or demonstrations cannot be written."""
        if self.signal not in SIGNALS:
            raise InputError(f"there is no signal {self.signal!r} to save: choose one of {', '.join(SIGNALS)}")
        if self.save is not None:
            if self.save.suffix not in ENDINGS:
                raise InputError(f"{self.save} has the ending {self.save.suffix!r}: demonstrations are .npz or .csv")
            check_new(self.save, "file")
        if self.steps is not None:
            check_new(self.steps, "folder")


def _evaluate_set(places: Mapping[str, tuple[Subject, Any, bool]], options: _Options) -> Evaluation:
    """Evaluate a policy in each of several environments, and combine the results; see `evaluate`."""
    if options.save is not None:
        raise InputError("demonstrations are saved from one environment: evaluate in one, or leave save out")
    results = {}
    for name, place in places.items():
        steps = None if options.steps is None else options.steps / name
        results[name] = _evaluate_subject(*place, replace(options, steps=steps), name)
    first = next(iter(results.values()))
    policies = [policy for policy in first.rows if all(policy in result.rows for result in results.values())]
    rows = {
        policy: pd.concat(
            [result.rows[policy].assign(environment=name) for name, result in results.items()], ignore_index=True
        )
        for policy in policies
    }
    scopes = list(dict.fromkeys(result["evaluation_scope"] for result in results.values()))
    counts = any(result["collisions"] is not None for result in results.values())
    result: dict[str, Any] = {"evaluation_scope": "; ".join(scopes), **_statistics(rows, counts)}
    tried = {name for each in results.values() for name in (*each["skipped_baselines"], *each.rows)}
    result |= {"baselines": policies[1:], "skipped_baselines": sorted(tried - {*rows}), "seed": first["seed"]}
    result |= {"episodes": sum(each["episodes"] for each in results.values())}
    result |= {name: first[name] for name in ("episodes_to_convergence", "trained_episodes")}
    if (comparison := compare(rows)) is not None:
        result |= {"best_baseline": comparison.baseline, "p": comparison.p}
    result["environments"] = {
        name: {policy: statistics(each.rows[policy])["success_rate"] for policy in policies}
        for name, each in results.items()
    }
    return Evaluation(result, rows, is_held_out=all(each.is_held_out for each in results.values()))


def _evaluate_subject(subject: Subject, env: Any, is_given: bool, options: _Options, label: str = "") -> Evaluation:
    """Evaluate a policy in one environment; see `evaluate`.

    `env` is the environment or the name of the task, None for a run. `is_given` is True if the caller closes it.
    `label` precedes the labels of the progress bars.
    """
    config, folder, environment = subject.config, subject.folder, options.environment
    episodes, seed, save, steps = options.episodes, options.seed, options.save, options.steps
    resample_offsets, baselines = options.resample_offsets, options.baselines
    kwargs: dict[str, Any] = {"episodes": episodes, "seed": seed}
    if config is None:
        if environment or resample_offsets or save is not None:
            raise InputError(
                "an environment that is given as an object takes no options, resample_offsets or save: give the name "
                "of a task"
            )
        environment, scope = {}, "seeds of the environment as it was given"
    else:
        environment = subject.changed_environment(environment)
        scope = evaluation_scope(config.task, environment, resample_offsets)
        if subject.folder is None:  # a run states its environment
            chosen = [f"{name}={environment[name]}" for name in STATED if name in environment]
            scope = ", ".join([scope, *chosen])
    if resample_offsets and config is not None:
        kwargs["options"] = {"new_run": True}
        if seed <= config.seed < seed + episodes:  # the offset of a run is sampled with its seed
            raise InputError(
                f"episode {config.seed - seed} of these has the offset of the run itself: give another --seed, such as "
                f"{config.seed + 1}"
            )
    is_alone = baselines is not None and not baselines  # an empty set: the policy alone
    makers = {"demonstration": zero_policy} if is_demonstrated(environment.get("guidance")) and not is_alone else {}
    makers |= make_baselines(config, environment, baselines)
    if POLICY in makers:
        raise InputError(f"a baseline policy cannot be called {POLICY!r}, which is the evaluated policy")
    evaluation_env = cast(gymnasium.Env, env) if config is None else make_environment(config.task, environment)
    with nullcontext() if is_given else closing(evaluation_env):
        if config is not None:
            if (save is not None or steps is not None) and not hasattr(evaluation_env.unwrapped, "trace"):
                raise InputError(
                    f"{config.task} is no task of this package and records no poses: leave --save and --steps out"
                )
            evaluation_env.reset(seed=config.seed)  # samples the hidden values of the run
        functions = baselines if isinstance(baselines, Mapping) else {}
        files = {
            name: _episodes_file(subject, name, environment, kwargs, functions.get(name)) for name in (POLICY, *makers)
        }
        stored = {
            name: rows
            for name in makers
            if (file := files[name]) is not None and (rows := read_complete(file, episodes)) is not None
        }
        missing = {name: make for name, make in makers.items() if name not in stored}
        policies = {POLICY: subject.make_policy(evaluation_env)}
        for name, make in missing.items():
            with naming_failures(f"the baseline policy {name!r}"):
                if is_compatible(make, evaluation_env):
                    policies[name] = make(evaluation_env)
        skipped = [name for name in missing if name not in policies]
        labels = {
            name: f"{label} series {number} of {1 + len(makers)}: {LABELS.get(name, name)}".lstrip()
            for number, name in enumerate((POLICY, *makers), start=1)
        }
        for name in stored:
            print(f"{labels[name]}: evaluated before, and used again", file=sys.stderr, flush=True)
        evaluated, motions, started = dict(stored), [], time.monotonic()
        collect = None if save is None else partial(_successful_motion, options.signal)
        for name, rows, data in evaluate_policies(
            evaluation_env, policies, labels=labels, processes=options.processes, collect=collect, steps=steps, **kwargs
        ):
            evaluated[name] = rows
            if name == POLICY:
                motions = data
                _print_first(rows, [*policies][1:], time.monotonic() - started, is_held_out=config is not None)
            if (file := files[name]) is not None:
                write_atomically(file, table_text(rows).encode())
    rows_of = {name: evaluated[name] for name in (POLICY, *makers) if name in evaluated}
    counts = config is None or counts_collisions(config.task)
    result = {"evaluation_scope": scope, **_statistics(rows_of, counts), "baselines": [*rows_of][1:]}
    result |= {"skipped_baselines": skipped, "episodes": episodes, "seed": seed} | _training(folder)
    if (comparison := compare(rows_of)) is not None:
        result |= {"best_baseline": comparison.baseline, "p": comparison.p}
    if save is not None:
        result["saved"] = _save_demonstrations(motions, save)
    return Evaluation(result, rows_of, is_held_out=config is not None)


def _print_first(rows: pd.DataFrame, baselines: Sequence[str], seconds: float, *, is_held_out: bool) -> None:
    """Print the policy's result on standard error before baseline policies are evaluated, with their expected time."""
    if baselines:
        first = Evaluation(statistics(rows, ""), {POLICY: rows}, is_held_out=is_held_out)
        duration = f"about {max(1, round(len(baselines) * seconds))} s"
        names = ", ".join(LABELS.get(name, name) for name in baselines)
        print(f"{first.sentence}\nbaselines on the same episodes ({duration}): {names}", file=sys.stderr, flush=True)


def check_num_episodes(episodes: object) -> int:
    """Return the number of an evaluation's episodes as an int; raise an InputError unless it is at least 1."""
    return as_whole(episodes, "the number of episodes", 1)


def _episodes_file(
    subject: Subject,
    name: str,
    environment: Mapping[str, Any],
    kwargs: Mapping[str, Any],
    function: MakePolicy | None,
) -> Path | None:
    """Return the file in the run's folder that stores a policy's episodes; None if they are not stored.

    `function` is the caller's function for a baseline policy, or None for one that is given by name. Episodes of a
    function are stored only if `digest_of` identifies it. Episodes of the run's own policy are stored only in the run's
    own environment, and without resampled offsets.
    """
    folder, config = subject.folder, subject.config
    if folder is None or config is None or not subject.is_stored:
        return None
    if name != POLICY:
        about = None if function is None else digest_of(function)
        if function is not None and about is None:
            return None
        return episodes_file(folder.path / BASELINES_FOLDER, name, config, environment, about=about, **kwargs)
    if environment != config.environment or "options" in kwargs:
        return None
    return episodes_file(folder.path / POLICY_FOLDER, POLICY, config, environment, about=subject.digest, **kwargs)


def _statistics(rows: Mapping[str, pd.DataFrame], counts: bool) -> dict[str, Any]:
    """Return the statistics of the policy, of the demonstration and of each baseline policy, by prefixed name.

    Statistics of collisions are None unless `counts` is True.
    """
    result: dict[str, Any] = {}
    for name, table in ({POLICY: pd.DataFrame(), "demonstration": pd.DataFrame()} | dict(rows)).items():
        result |= statistics(table, "" if name == POLICY else f"{name}_")
    return {key: value if counts or not key.endswith(COLLISIONS) else None for key, value in result.items()}


def _training(folder: RunFolder | None) -> dict[str, Any]:
    """Return the episodes to convergence and the number of training episodes; None without a table of episodes."""
    if folder is None or not (folder.path / "episodes.csv").is_file():
        return {"episodes_to_convergence": None, "trained_episodes": None}
    rows = folder.episodes()
    return {"episodes_to_convergence": episodes_to_convergence(rows), "trained_episodes": len(rows)}


def _successful_motion(signal: str, env: gymnasium.Env, row: Mapping[str, Any]) -> tuple[np.ndarray, np.ndarray] | None:
    """Return times (N,) [s] and poses (N, O) of an episode; None if it failed."""
    if not row["success"]:
        return None
    trace = cast(Any, env.unwrapped).trace
    return trace.period * np.arange(1, len(trace) + 1), getattr(trace, signal).copy()


def _save_demonstrations(motions: Sequence[tuple[np.ndarray, np.ndarray] | None], file: Path) -> int:
    """Write the motions of successful episodes, if there are any; return their number."""
    successful = [motion for motion in motions if motion is not None]
    if successful:
        names = POSE_NAMES if successful[0][1].shape[1] == POSE_SIZE else None
        Demonstrations([times for times, _ in successful], [poses for _, poses in successful], names).save(file)
    return len(successful)
