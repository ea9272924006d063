"""Training loop: from a configuration to the files of a run folder."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, closing, nullcontext
from dataclasses import replace
from numbers import Number
from typing import TYPE_CHECKING, Any, cast

import gymnasium
import numpy as np
import torch
from threadpoolctl import threadpool_limits

from guiderail.models.common.errors import InputError, brief, naming_failures
from guiderail.models.policy import Policy
from guiderail.tools.environments import trained_task
from guiderail.tools.evaluation.episode import Callback, PolicyFn
from guiderail.tools.evaluation.metrics import WORDS
from guiderail.tools.evaluation.policies import is_compatible
from guiderail.tools.evaluation.rollout import rollout
from guiderail.tools.evaluation.step_log import StepLog, remove_step_logs
from guiderail.tools.files import write_atomically
from guiderail.tools.learning.checkpoint import load_checkpoint, save_checkpoint
from guiderail.tools.learning.environment_set import (
    EnvironmentSet,
    make_run_environment,
    select_environment,
    trained_set,
)
from guiderail.tools.learning.learner import (
    LEARNERS,
    Learner,
    LearningLog,
    described_observation,
    divergence_error,
    learner_arguments,
)
from guiderail.tools.learning.run_folder import RunConfig, RunFolder
from guiderail.tools.tables import table_text

if TYPE_CHECKING:
    from guiderail.tools.learning.actors import ParallelLearner
    from guiderail.tools.learning.supervision import Supervise, SupervisedEpisodes

# Largest fraction of the training time for the step log and checkpoints: small checkpoints are written after every
# episode, large ones less often. The first and the last checkpoint are always written.
MAX_SAVING_FRACTION = 0.03

# Errors of `Learner.restore` that mean that the state does not fit the learner.
_UNFIT = (LookupError, TypeError, ValueError, OverflowError, RuntimeError)

Demonstrator = Callable[[gymnasium.Env], PolicyFn]


def run_training(
    folder: RunFolder,
    config: RunConfig,
    *,
    resume: bool = False,
    report: Callable[[dict[str, Any]], None] | None = None,
    demonstrator: Demonstrator | None = None,
    supervise: Supervise | None = None,
    log: Sequence[str] = (),
    sb3_callbacks: Any = None,
) -> list[dict[str, Any]]:
    """Train a run to its last episode and write its folder.

    A run that was killed and resumed gives bit for bit the result of an uninterrupted run: a checkpoint is written at
    the end of an episode and has all state that later episodes depend on, including the random generators. The step log
    is written before the checkpoint; episodes after the last checkpoint are run and logged again.

    Args:
        folder: Folder of the run; with `resume`, the folder of the run to continue.
        config: Configuration; with `resume` it must agree with the folder's.
        resume: Continue the run from its checkpoint.
        report: Called with the row of each episode.
        demonstrator: Function from an environment to the policy that acts in the learner's `demonstration_episodes`.
            Its actions must not depend on earlier episodes. Off-policy learners also learn from these transitions
            (Vecerik et al., 2017).
        supervise: Start of the episodes of a run that is configured `human_in_the_loop`.
        log: Formats of the learning log: tensorboard, wandb, csv, json, log or stdout.
        sb3_callbacks: Callback of Stable-Baselines3, or a list of them; if one returns False, training ends after
            the episode.

    Returns:
        The rows of `episodes.csv`.

    Raises:
        InputError: If the folder of a new run is not empty, another process writes into it, settings are incompatible,
            or a demonstrator, a supervisor or the package of a log format is missing; or if an episode fails, learning
            diverges, or the learner returns no `Policy`. If the first episode fails, a folder that did not exist
            before is removed, unless learning diverged.
    """
    if config.learner.num_envs and (config.learner.pipelined or config.human_in_the_loop):
        raise InputError(
            "num_envs does not work with pipelined=true or --human-in-the-loop: leave num_envs out, or the others"
        )
    if config.human_in_the_loop and config.members:
        raise InputError("a supervisor corrects one environment: leave --human-in-the-loop out, or name one task")
    if config.human_in_the_loop and supervise is None:
        raise InputError("this run has a supervisor: give --human-in-the-loop")
    if config.learner.demonstration_episodes and demonstrator is None:
        raise InputError(
            f"{config.task} has no scripted policy that demonstrates: leave the setting demonstration_episodes out"
        )
    learning_log = LearningLog(folder.logs, log)
    torch.set_num_threads(1)  # faster for two runs at once, and sums do not depend on the number of cores
    with ExitStack() as stack:
        stack.enter_context(threadpool_limits(1))
        env = stack.enter_context(closing(make_run_environment(config)))
        if config.learner.demonstration_episodes and demonstrator is not None and not is_compatible(demonstrator, env):
            raise InputError(
                f"the observations or actions of {config.task}'s scripted policy differ from this environment's: leave "
                "the setting demonstration_episodes out"
            )
        task = trained_set(env, config) if isinstance(env, EnvironmentSet) else trained_task(env, config.task)
        arguments = learner_arguments(config, task)
        kind = LEARNERS.get(config.learner.algorithm)
        with _naming_failures(config, f"constructing the learner {getattr(kind, '__name__', brief(kind))}"):
            try:
                learner: Learner = kind(config.learner, env, **arguments)
            except MemoryError as error:
                raise InputError(
                    f"the replay buffer does not fit into memory ({error}): give a smaller --set buffer_size=..."
                ) from error
        env.reset(seed=config.seed)  # samples the hidden values of the run
        if not resume:
            folder.refuse_existing()
        is_new_folder = not folder.path.exists()
        closed_first = stack.enter_context(ExitStack())
        closed_first.callback(lambda: learner.close())
        closed_first.callback(learning_log.close)
        callbacks = None
        if sb3_callbacks is not None:
            from guiderail.tools.learning.sb3 import Sb3Callbacks

            if config.learner.pipelined or config.learner.num_envs:
                raise InputError("callbacks need model and episodes in this process: leave pipelined and num_envs out")
            callbacks = closed_first.enter_context(closing(Sb3Callbacks(sb3_callbacks, learner)))
        stack.enter_context(folder.locked())
        stack.enter_context(closed_first.pop_all())  # the lock is released last: all of these write into the folder
        if config.learner.pipelined:
            from guiderail.tools.learning.networks import SpacesOnlyEnv
            from guiderail.tools.learning.pipelined import PipelinedLearner

            child_arguments = (config.learner, SpacesOnlyEnv(env)), arguments
            learner = PipelinedLearner(learner, child_arguments, waits=True, imports=config.imports)
        elif config.learner.num_envs:
            from guiderail.tools.learning.actors import ParallelLearner

            number = config.learner.demonstration_episodes
            learner = ParallelLearner(
                learner, env, num_envs=config.learner.num_envs, seed=config.seed, num_episodes=config.episodes,
                demonstrator=(demonstrator, number) if demonstrator is not None and number else None,
                callbacks=(StepLog(env, folder.steps),) if config.step_log else (),
            )  # fmt: skip
        learner.records_metrics = bool(log)
        if not hasattr(env.unwrapped, "trace"):
            config = replace(config, step_log=False)  # only an environment of this package has a trace
        if not resume:
            folder.create(config)
        try:
            return _train(
                folder, config, env, learner, resume, report, demonstrator, supervise, learning_log, callbacks
            )
        except InputError:
            # The next attempt would refuse a folder that has only a configuration. If the learner diverged, the folder
            # stays.
            if not resume and not learner.has_diverged():
                folder.remove_unstarted(remove_folder=is_new_folder)
            raise


def _train(
    folder: RunFolder,
    config: RunConfig,
    env: Any,
    learner: Learner,
    resume: bool,
    report: Callable[[dict[str, Any]], None] | None,
    demonstrator: Demonstrator | None,
    supervise: Supervise | None,
    learning_log: LearningLog,
    sb3_callbacks: Any = None,
) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = []
    if resume:
        rows, num_written = restore_checkpoint(folder, config, learner, env)
        remove_step_logs(folder.steps, config.episodes)
        if num_written < len(rows):
            folder.write_episodes(rows)  # the loop below does not write the table of a complete run
    num_restored, supervised = len(rows), None
    if config.human_in_the_loop and supervise is not None:
        supervised = supervise(config, load_checkpoint(folder.checkpoint)[1] if rows else {})
        supervised.env.unwrapped.np_random.bit_generator.state = env.unwrapped.np_random.bit_generator.state
        env, config = supervised.env, supervised.config
    folder.write_config(config)
    if resume and len(rows) < config.episodes and not _ends_with_successes(rows, config.learner.stop_after_successes):
        folder.remove_policy()  # a run that is killed later must not leave an outdated policy

    step_log = StepLog(env, folder.steps)
    callbacks: list[Callback] = [step_log] if config.step_log else []
    callbacks += [] if sb3_callbacks is None else [sb3_callbacks]
    num_demonstrated = 0 if demonstrator is None else config.learner.demonstration_episodes
    training_time, saving_time, last_saving_time = 0.0, 0.0, 0.0

    def learner_act(observation: np.ndarray) -> np.ndarray:
        with _naming_failures(config, f"{type(learner).__name__}.act"):
            return learner.act(observation)

    for episode in range(len(rows), config.episodes):
        if _ends_with_successes(rows, config.learner.stop_after_successes):
            break
        started = time.perf_counter()
        environment_name = select_environment(env, episode)
        act = demonstrator(env) if demonstrator is not None and episode < num_demonstrated else learner_act
        if config.learner.num_envs:
            row = cast("ParallelLearner", learner).episode(episode)
        elif supervised is None:
            row = rollout(env, act, learner, *callbacks, index=episode)
        else:
            row = supervised.rollout(act, learner, *callbacks, index=episode)
            env = supervised.env
        if _has_diverged(learner):
            raise divergence_error()
        if environment_name is not None:
            row["environment"] = environment_name
        if num_demonstrated:
            row["is_demonstration"] = int(episode < num_demonstrated)
        row["wall_time"] = time.perf_counter() - started
        _check_columns(row, rows, num_restored, folder)
        rows.append(row)
        training_time += time.perf_counter() - started
        if report is not None:
            report(row)
        learning_log.record(rows, learner.metrics)
        saving_time_with_next = step_log.seconds + saving_time + last_saving_time
        is_last = episode + 1 == config.episodes or (sb3_callbacks is not None and sb3_callbacks.is_stopped)
        is_last = is_last or _ends_with_successes(rows, config.learner.stop_after_successes)
        if saving_time_with_next <= MAX_SAVING_FRACTION * training_time or episode == 0 or is_last:
            started = time.perf_counter()
            _save(folder, config, rows, learner, env, supervised)
            last_saving_time = time.perf_counter() - started
            saving_time += last_saving_time
        learner.submit_episode()
        if is_last:
            break
    learner.finish()
    remove_step_logs(folder.steps, len(rows))  # episodes that actors simulated ahead before training ended early
    learning_log.record(rows, learner.metrics, is_finished=True)
    learned_policy(config, learner, env).save(folder.path, write=write_atomically)
    return rows


def learned_policy(config: RunConfig, learner: Learner, env: Any) -> Policy:
    """Return the policy of a learner; raise an `InputError` if `Learner.policy` fails or returns no `Policy`."""
    try:
        with _naming_failures(config, f"{type(learner).__name__}.policy", ValueError):
            policy = learner.policy({"task": config.task, **described_observation(env)})
    except InputError:
        raise
    except ValueError as error:
        raise InputError(f"{type(learner).__name__}.policy failed: {error}") from error
    if not isinstance(policy, Policy):
        raise InputError(f"{type(learner).__name__}.policy must return a Policy, not {brief(policy)}")
    return policy


def _naming_failures(config: RunConfig, action: str, *passed: type[Exception]) -> AbstractContextManager[None]:
    """Return `naming_failures` for a user's learner, and a context without effect for a learner of this package."""
    return nullcontext() if LEARNERS.is_packaged(config.learner.algorithm) else naming_failures(action, *passed)


def _has_diverged(learner: Learner) -> bool:
    diverged = learner.has_diverged()
    if not isinstance(diverged, bool | np.bool_):
        raise InputError(f"{type(learner).__name__}.has_diverged must return True or False, not {brief(diverged)}")
    return bool(diverged)


def _ends_with_successes(rows: Sequence[Mapping[str, Any]], number: int) -> bool:
    """Return True if the last `number` episodes are successes of the learner itself; False if `number` is 0."""
    last = rows[-number:]
    return len(last) == number > 0 and all(row["success"] and not row.get("is_demonstration") for row in last)


def _check_columns(row: dict[str, Any], rows: list[dict[str, Any]], num_restored: int, folder: RunFolder) -> None:
    """Raise an `InputError` if an episode's columns differ from the first episode's, or a value is not a number."""
    if rows and (changed := sorted(rows[0].keys() ^ row.keys())):
        if len(rows) == num_restored:
            raise InputError(
                f"the run in {folder.path} was begun by another version of guiderail or of its learner, whose episodes "
                "have other columns: resume it with that version, or train again in another folder"
            )
        raise InputError(
            f"the column {changed[0]!r} is missing in some episodes: on_episode_end must always return the same names"
        )
    for name, value in row.items():
        if name not in WORDS and not isinstance(value, Number | None):
            raise InputError(f"the column {name!r} of an episode must be a number, not {brief(value)}")


def _save(
    folder: RunFolder,
    config: RunConfig,
    rows: list[dict[str, Any]],
    learner: Learner,
    env: Any,
    supervised: SupervisedEpisodes | None,
) -> None:
    """Write the checkpoint, which includes the table, and then the table: a kill in between loses nothing."""
    write_checkpoint(folder, config, rows, learner, env, {} if supervised is None else supervised.state())
    if supervised is not None:
        folder.write_config(supervised.config)
    folder.write_episodes(rows)


def write_checkpoint(
    folder: RunFolder,
    config: RunConfig,
    rows: list[dict[str, Any]],
    learner: Learner,
    env: Any,
    more: Mapping[str, Any] | None = None,
) -> None:
    """Write the checkpoint: the run's identity, the episodes' rows, the states of learner and environment, and `more`.

    Raises:
        InputError: If `Learner.state` does not return arrays of numbers by name and values that JSON stores unchanged,
            or if `Learner.state` of a user's learner fails.
    """
    with _naming_failures(config, f"{type(learner).__name__}.state"):
        state = learner.state()
    if not (isinstance(state, tuple) and len(state) == 2 and all(isinstance(part, Mapping) for part in state)):
        raise InputError(f"{type(learner).__name__}.state must return two dictionaries, not {brief(state)}")
    arrays, values = state
    for name, array in arrays.items():
        if np.asarray(array).dtype.kind not in "fiub":
            raise InputError(f"the array {name!r} of {type(learner).__name__}.state has no numbers: {brief(array)}")
    try:
        json.dumps(values)
    except (TypeError, ValueError) as error:
        raise InputError(f"the values of {type(learner).__name__}.state must be values of JSON: {error}") from error
    if changed := next(_changed_by_json(values), None):
        raise InputError(
            f"the values of {type(learner).__name__}.state must not contain {changed}, because JSON changes it: use "
            "lists, and text as keys"
        )
    stored = {
        "run": config.identity,
        "rows": rows,
        "learner": values,
        "environment": env.unwrapped.np_random.bit_generator.state,
    }
    save_checkpoint(folder.checkpoint, arrays, stored | dict(more or {}))


def _changed_by_json(value: Any) -> Iterator[str]:
    """Yield a description of each tuple and each key that is not text, in JSON-serializable values."""
    if isinstance(value, tuple):
        yield f"the tuple {brief(value)}"
    elif isinstance(value, Mapping):
        yield from (f"the key {brief(key)}" for key in value if not isinstance(key, str))
        for entry in value.values():
            yield from _changed_by_json(entry)
    elif isinstance(value, list):
        for entry in value:
            yield from _changed_by_json(entry)


def restore_checkpoint(
    folder: RunFolder, config: RunConfig, learner: Learner, env: Any
) -> tuple[list[dict[str, Any]], int]:
    """Restore learner and environment from the checkpoint.

    Returns:
        The rows up to the checkpoint, and the number of rows in `episodes.csv`, which is smaller if the run was killed
        between writing the two files. Without both files, there are no rows.

    Raises:
        InputError: If the checkpoint is missing or damaged, belongs to another task, seed, environment or learner than
            `config`, or contains rows that differ from `episodes.csv`.
    """
    table = folder.path / "episodes.csv"
    if not folder.checkpoint.exists() and not table.exists():
        return [], 0  # the run was killed in its first episode
    arrays, values = load_checkpoint(folder.checkpoint)
    try:
        if values["run"] != config.identity:
            raise InputError(
                f"{folder.path / 'config.yaml'} has another task, seed, environment or learner than its checkpoint: "
                "restore it, or train again in another folder"
            )
        rows = values["rows"]
        written: Sequence[Mapping[str, Any]] | Any = folder.episodes() if table.exists() else []
        if table_text(written) != table_text(rows[: len(written)]):
            raise InputError(
                f"{table} differs from the table in its checkpoint: restore it, or remove it to have it written again"
            )
        with _naming_failures(config, f"{type(learner).__name__}.restore", *_UNFIT):
            learner.restore(arrays, values["learner"])
        env.unwrapped.np_random.bit_generator.state = values["environment"]
    except InputError:
        raise
    except _UNFIT as error:  # the digest matches, so the content is complete, but of another learner
        raise InputError(
            f"the checkpoint {folder.checkpoint} belongs to other settings: give those of {folder.path / 'config.yaml'}"
        ) from error
    return rows, len(written)
