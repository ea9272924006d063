"""Training loop: from a configuration to the files of a run folder."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, closing, nullcontext
from dataclasses import dataclass, replace
from numbers import Number
from typing import Any

import numpy as np
import torch
from threadpoolctl import threadpool_limits

from guiderail.models.common.errors import InputError, brief, naming_failures
from guiderail.models.policy import Policy
from guiderail.tools.environments import trained_task
from guiderail.tools.evaluation.episode import Callback
from guiderail.tools.evaluation.metrics import WORDS
from guiderail.tools.evaluation.policies import is_compatible
from guiderail.tools.evaluation.step_log import StepLog, remove_step_logs
from guiderail.tools.files import write_atomically
from guiderail.tools.learning.checkpoint import entries_of, load_checkpoint, save_checkpoint
from guiderail.tools.learning.environment_set import (
    EnvironmentSet,
    make_run_environment,
    select_environment,
    trained_set,
)
from guiderail.tools.learning.episodes import ActorEpisodes, Demonstrator, Episodes, Sb3Callbacks, Supervise
from guiderail.tools.learning.learner import (
    LEARNERS,
    Learner,
    LearningLog,
    describe_policy,
    divergence_error,
    learner_arguments,
)
from guiderail.tools.learning.run_folder import RunConfig, RunFolder
from guiderail.tools.tables import table_text

# Largest fraction of the training time for the step log and checkpoints: small checkpoints are written after every
# episode, large ones less often. The first and the last checkpoint are always written.
MAX_SAVING_FRACTION = 0.03

# Errors of `Learner.restore` that mean that the state does not fit the learner.
_UNFIT = (LookupError, TypeError, ValueError, OverflowError, RuntimeError)

Row = dict[str, Any]


@dataclass(frozen=True)
class Observers:
    """Observers of a run: progress, learning log, and callbacks of Stable-Baselines3."""

    report: Callable[[Row], None] | None = None  # called with the row of each episode
    log: Sequence[str] = ()  # formats of the learning log: tensorboard, wandb, csv, json, log or stdout
    sb3_callbacks: Any = None  # callback of Stable-Baselines3, or a list; if one returns False, training ends


def run_training(
    folder: RunFolder,
    config: RunConfig,
    *,
    resume: bool = False,
    demonstrator: Demonstrator | None = None,
    supervise: Supervise | None = None,
    observers: Observers | None = None,
) -> list[Row]:
    """Train a run to its last episode and write its folder; return the rows of `episodes.csv`.

    A run that was killed and resumed gives bit for bit the result of an uninterrupted run: a checkpoint is written at
    the end of an episode and has all state that later episodes depend on, including the random generators. The step log
    is written before the checkpoint; episodes after the last checkpoint are run and logged again.

    Args:
        folder: Folder of the run; with `resume`, the folder of the run to continue.
        config: Configuration; with `resume` it must agree with the folder's.
        resume: Continue the run from its checkpoint.
        demonstrator: Function from an environment to the policy that acts in the learner's `demonstration_episodes`.
            Its actions must not depend on earlier episodes. Off-policy learners also learn from these transitions
            (Vecerik et al., 2017).
        supervise: Start of the episodes of a run that is configured `human_in_the_loop`.
        observers: Progress, learning log and callbacks.
    """
    _check_combination(config, has_demonstrator=demonstrator is not None, is_supervised=supervise is not None)
    observers = observers or Observers()
    learning_log = LearningLog(folder.logs, observers.log)
    torch.set_num_threads(1)  # faster for two runs at once, and sums do not depend on the number of cores
    with ExitStack() as stack:
        stack.enter_context(threadpool_limits(1))
        if config.human_in_the_loop and supervise is not None:
            episodes = supervise(config)
            episodes.demonstrator = demonstrator
        else:
            episodes = Episodes(config, make_run_environment(config), demonstrator)
        stack.callback(lambda: episodes.close())
        env = episodes.env
        number = config.learner.demonstration_episodes
        if demonstrator is not None and config.learner.demonstrator:
            demonstrator(env)  # raises an InputError that names the difference
        elif demonstrator is not None and number and not is_compatible(demonstrator, env):
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
        if observers.sb3_callbacks is not None:
            if config.learner.num_envs:
                raise InputError("callbacks need the episodes in this process: leave num_envs out")
            callbacks = closed_first.enter_context(closing(Sb3Callbacks(observers.sb3_callbacks, learner)))
        if not resume:
            TrainingLoop(folder, learner, episodes).check_learner()
        stack.enter_context(folder.locked())
        if config.learner.num_envs:
            episodes = ActorEpisodes(episodes, learner)
            closed_first.callback(episodes.end)
        stack.enter_context(closed_first.pop_all())  # the lock is released last: all of these write into the folder
        learner.records_metrics = bool(observers.log)
        if not hasattr(env.unwrapped, "trace"):
            episodes.config = config = replace(config, step_log=False)  # only an environment of guiderail has a trace
        if not resume:
            folder.create(config)
        loop = TrainingLoop(folder, learner, episodes, observers.report, learning_log, callbacks)
        try:
            return loop.run(resume=resume)
        except InputError:
            # The next attempt would refuse a folder that has only a configuration. If the learner diverged, the folder
            # stays.
            if not resume and not learner.has_diverged():
                folder.remove_unstarted(remove_folder=is_new_folder)
            raise


def _check_combination(config: RunConfig, *, has_demonstrator: bool, is_supervised: bool) -> None:
    """Raise an InputError if settings are incompatible, or a demonstrator or a supervisor is missing."""
    if config.learner.num_envs and config.human_in_the_loop:
        raise InputError("num_envs does not work with --human-in-the-loop: leave one of them out")
    if config.human_in_the_loop and config.members:
        raise InputError("a supervisor corrects one environment: leave --human-in-the-loop out, or name one task")
    if config.human_in_the_loop and not is_supervised:
        raise InputError("this run has a supervisor: give --human-in-the-loop")
    if config.learner.demonstration_episodes and not has_demonstrator:
        raise InputError(
            f"{config.task} has no scripted policy that demonstrates: leave the setting demonstration_episodes out"
        )


class TrainingLoop:
    """Loop of episodes and training, in simulation and on a robot, which writes the files of a run.

    Attributes:
        rows: Rows of the finished episodes.
        remaining: Steps of saving the last episode that are not done.
    """

    def __init__(
        self,
        folder: RunFolder,
        learner: Learner,
        episodes: Episodes,
        report: Callable[[Row], None] | None = None,
        log: LearningLog | None = None,
        sb3_callbacks: Sb3Callbacks | None = None,
    ):
        """Construct the loop; `report` is called with the row of each episode."""
        self._folder, self._learner, self._episodes, self._report = folder, learner, episodes, report
        self._log = LearningLog(folder.logs) if log is None else log
        self._sb3_callbacks = sb3_callbacks
        self.rows: list[Row] = []
        self.remaining: list[Callable[[], None]] = []
        self._num_restored = 0
        self._last_saving_time = 0.0

    def check_learner(self) -> None:
        """Call the methods of another package's learner that are not needed until later, so that no run is lost."""
        if not LEARNERS.is_packaged(self._episodes.config.learner.algorithm):
            self.learner_state()
            self.learner_policy()

    def run(self, *, resume: bool = False) -> list[Row]:
        """Run all episodes and save the policy; return the rows. With `resume`, continue from the checkpoint."""
        folder, learner, episodes = self._folder, self._learner, self._episodes
        if resume:
            self.restore()
        folder.write_config(episodes.config)
        if resume and not self._is_complete() and not episodes.is_real_time:
            folder.remove_policy()  # a run that is killed later must not leave an outdated policy
        step_log = StepLog(episodes.env, folder.steps)
        callbacks: list[Callback] = [step_log] if episodes.config.step_log and not episodes.is_real_time else []
        callbacks += [] if self._sb3_callbacks is None else [self._sb3_callbacks]
        training_time = saving_time = 0.0
        while not self._is_complete():
            started = time.perf_counter()
            row = self._run_episode(callbacks)
            training_time += time.perf_counter() - started
            if self._report is not None:
                self._report(row)
            self._log.record(self.rows, learner.metrics)
            time_with_next = step_log.seconds + saving_time + self._last_saving_time
            is_due = time_with_next <= MAX_SAVING_FRACTION * training_time or len(self.rows) == 1
            if is_due or self._is_complete() or episodes.is_real_time:
                self._last_saving_time = 0.0
                self.remaining = episodes.saving_steps(self.write_checkpoint, self._write_table, learner.submit_episode)
                while self.remaining:
                    self.remaining[0]()
                    self.remaining.pop(0)
                    episodes.idle()
                saving_time += self._last_saving_time
            else:
                learner.submit_episode()
            episodes.end_episode()
        episodes.end()
        learner.finish()
        remove_step_logs(folder.steps, len(self.rows))  # episodes that actors simulated before training ended early
        self._log.record(self.rows, learner.metrics, is_finished=True)
        self.save_policy()
        return self.rows

    def _is_complete(self) -> bool:
        """Return True if all episodes are done, a callback ended training, or enough last episodes are successes."""
        if len(self.rows) >= self._episodes.config.episodes:
            return True
        number = self._episodes.config.learner.stop_after_successes
        last = self.rows[-number:]
        if len(last) == number > 0 and all(row["success"] and not row.get("is_demonstration") for row in last):
            return True
        return self._sb3_callbacks is not None and self._sb3_callbacks.is_stopped

    def _run_episode(self, callbacks: Sequence[Callback]) -> Row:
        started, index, config = time.perf_counter(), len(self.rows), self._episodes.config
        environment_name = select_environment(self._episodes.env, index)
        row = self._episodes.run(self._learner, *callbacks, index=index)
        if self._learner.has_diverged():
            raise divergence_error()
        if environment_name is not None:
            row["environment"] = environment_name
        if self._episodes.demonstrator is not None and config.learner.demonstration_episodes:
            row["is_demonstration"] = int(index < config.learner.demonstration_episodes)
        row["wall_time"] = time.perf_counter() - started
        self._check_columns(row)
        self.rows.append(row)
        return row

    def _check_columns(self, row: Row) -> None:
        """Raise an `InputError` if a row has other columns than the first one, or a value is not a number."""
        if self.rows and (changed := sorted(self.rows[0].keys() ^ row.keys())):
            if len(self.rows) == self._num_restored:
                raise InputError(
                    f"the run in {self._folder.path} was begun by another version of guiderail or of its learner, "
                    "whose episodes have other columns: resume it with that version, or train again in another folder"
                )
            raise InputError(
                f"the column {changed[0]!r} is missing in some episodes: on_episode_end must always return the same "
                "names"
            )
        for name, value in row.items():
            if name not in WORDS and not isinstance(value, Number | None):
                raise InputError(f"the column {name!r} of an episode must be a number, not {brief(value)}")

    def _write_table(self) -> None:
        """Write the table after the checkpoint, which includes it: a kill in between loses nothing."""
        started = time.perf_counter()
        if self._episodes.config.human_in_the_loop:
            self._folder.write_config(self._episodes.config)
        self._folder.write_episodes(self.rows)
        self._last_saving_time += time.perf_counter() - started

    def write_checkpoint(self) -> None:
        """Write the checkpoint: the run's identity, the episodes' rows, and the states of learner and environment."""
        started = time.perf_counter()
        arrays, values = self.learner_state()
        own_arrays, own_values = self._episodes.state()
        stored = {
            "run": self._episodes.config.identity,
            "rows": self.rows,
            "learner": values,
            "environment": self._episodes.env.unwrapped.np_random.bit_generator.state,
            "episodes": own_values,
        }
        arrays = {**arrays, **{f"episodes/{key}": array for key, array in own_arrays.items()}}
        save_checkpoint(self._folder.checkpoint, arrays, stored)
        self._last_saving_time += time.perf_counter() - started

    def learner_state(self) -> tuple[Mapping[str, np.ndarray], Mapping[str, Any]]:
        """Return the learner's arrays and values; raise an `InputError` if `Learner.state` fails or returns others."""
        name = f"{type(self._learner).__name__}.state"
        with _naming_failures(self._episodes.config, name):
            state = self._learner.state()
        return _checked_state(name, state)

    def restore(self) -> None:
        """Restore rows, learner and episodes from the checkpoint; without checkpoint and table, there are no rows."""
        folder, config, table = self._folder, self._episodes.config, self._folder.path / "episodes.csv"
        remove_step_logs(folder.steps, config.episodes)
        if not folder.checkpoint.exists() and not table.exists():
            return  # the run was killed in its first episode
        arrays, values = load_checkpoint(folder.checkpoint)
        try:
            if values["run"] != config.identity:
                raise InputError(
                    f"{folder.path / 'config.yaml'} has another task, seed, environment or learner than its "
                    "checkpoint: restore it, or train again in another folder"
                )
            rows = values["rows"]
            written: Any = folder.episodes() if table.exists() else []
            if table_text(written) != table_text(rows[: len(written)]):
                raise InputError(
                    f"{table} differs from the table in its checkpoint: restore it, or remove it to have it written "
                    "again"
                )
            own = entries_of(arrays, "episodes")
            learned = {name: array for name, array in arrays.items() if not name.startswith("episodes/")}
            with _naming_failures(config, f"{type(self._learner).__name__}.restore", *_UNFIT):
                self._learner.restore(learned, values["learner"])
            self._episodes.restore(rows, own, values["episodes"])
            self._episodes.env.unwrapped.np_random.bit_generator.state = values["environment"]
        except InputError:
            raise
        except _UNFIT as error:  # the digest matches, so the content is complete, but of another learner
            raise InputError(
                f"the checkpoint {folder.checkpoint} belongs to other settings: give those of "
                f"{folder.path / 'config.yaml'}"
            ) from error
        self.rows, self._num_restored = rows, len(rows)
        if len(written) < len(rows):  # the run was killed between writing the two files
            folder.write_episodes(rows)

    def learner_policy(self) -> Policy:
        """Return the learned policy; raise an `InputError` if `Learner.policy` fails or returns no `Policy`."""
        config, name = self._episodes.config, f"{type(self._learner).__name__}.policy"
        try:
            with _naming_failures(config, name, ValueError):
                policy = self._learner.policy(describe_policy(config, self._episodes.env))
        except InputError:
            raise
        except ValueError as error:
            raise InputError(f"{name} failed: {error}") from error
        if not isinstance(policy, Policy):
            raise InputError(f"{name} must return a Policy, not {brief(policy)}")
        return policy

    def save_policy(self) -> None:
        """Write the learned policy."""
        self.learner_policy().save(self._folder.path, write=write_atomically)


def _naming_failures(config: RunConfig, action: str, *passed: type[Exception]) -> AbstractContextManager[None]:
    """Return `naming_failures` for a user's learner, and a context without effect for a learner of this package."""
    return nullcontext() if LEARNERS.is_packaged(config.learner.algorithm) else naming_failures(action, *passed)


def _checked_state(name: str, state: Any) -> tuple[Mapping[str, np.ndarray], Mapping[str, Any]]:
    """Return a learner's arrays and values; raise an InputError if a checkpoint would change them."""
    arrays, values = state
    for key, array in arrays.items():
        if np.asarray(array).dtype.kind not in "fiub":
            raise InputError(f"the array {key!r} of {name} has no numbers: {brief(array)}")
    try:
        json.dumps(values)
    except (TypeError, ValueError) as error:
        raise InputError(f"the values of {name} must be values of JSON: {error}") from error
    if changed := next(_changed_by_json(values), None):
        raise InputError(
            f"the values of {name} must not contain {changed}, because JSON changes it: use lists, and text as keys"
        )
    return arrays, values


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
