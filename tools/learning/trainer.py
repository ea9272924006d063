"""Training: one page, from a configuration to a run folder. Everything else that `guiderail train` does is a call."""

import time
from collections.abc import Callable
from typing import Any, cast

import gymnasium
import torch

from guiderail.models.common.errors import InputError
from guiderail.tools.environments import make_environment
from guiderail.tools.evaluation.rollout import Callback, PolicyFn, is_compatible, rollout
from guiderail.tools.evaluation.step_log import StepLog
from guiderail.tools.files import write_atomically
from guiderail.tools.learning.checkpoint import load_checkpoint, save_checkpoint
from guiderail.tools.learning.interventions import SupervisedTraining, Supervisor
from guiderail.tools.learning.learner import LEARNERS, Learner, arguments_of, diverged
from guiderail.tools.learning.pipelined import PipelinedLearner, SpacesOnlyEnv
from guiderail.tools.learning.run_folder import RunConfig, RunFolder
from guiderail.tools.tables import table_text

# Step log and checkpoints cost at most this part of the time: a small checkpoint is written after every episode, a large
# one now and then. (The first and the last are written in any case.)
SAVING_SHARE = 0.03


def train(
    folder: RunFolder,
    config: RunConfig,
    *,
    resume: bool = False,
    report: Callable[[dict[str, Any]], None] | None = None,
    demonstrator: Callable[[gymnasium.Env], PolicyFn] | None = None,
    person: Supervisor | None = None,
) -> list[dict[str, Any]]:
    """Trains a run to its last episode and writes its folder.

    A run that was killed and resumed gives bit for bit what it would have given undisturbed: a checkpoint is taken at
    an episode's end and holds every number and every random generator that the rest depends on. The step log is written
    before it, and what is beyond it is written again.

    Args:
        folder: where it is written; with `resume`, where it goes on.
        config: the run. The folder's own configuration must agree with it when it goes on.
        report: called with each episode's row.
        demonstrator: who acts, in an environment, in the learner's `demonstration_episodes`: a policy without a memory
            of earlier episodes. Off-policy learners are taught by what others did (Vecerik et al., 2017).
        person: who watches a run that is configured so, pushes, and says what was a success.

    Returns:
        The rows of `episodes.csv`.

    Raises:
        InputError: if the folder holds another run, another process writes into it, or nobody demonstrates or watches;
            or of whatever was wrong in an episode: if that was the first one, no folder is left that wasn't there.
    """
    if config.with_person and person is None:
        raise InputError("a person watches this run: give --with-person")
    if config.learner.demonstration_episodes and demonstrator is None:
        raise InputError(
            f"nobody demonstrates {config.task}: it has no rule, so leave the setting demonstration_episodes out"
        )
    torch.set_num_threads(1)  # two runs side by side are faster so, and sums do not depend on the machine's cores
    env = make_environment(config.task, config.environment)
    if config.learner.demonstration_episodes and demonstrator is not None and not is_compatible(demonstrator, env):
        env.close()
        raise InputError(
            f"who demonstrates {config.task} sees or moves other things than this environment: leave the setting "
            "demonstration_episodes out"
        )
    task = cast(Any, env.unwrapped).task
    make_learner = LEARNERS.get(config.learner.algorithm)
    named = arguments_of(config, task)
    try:
        learner: Learner = make_learner(config.learner, env, **named)
    except MemoryError as error:
        env.close()
        raise InputError(
            f"so many decisions are more than fits into memory ({error}): give a smaller --set buffer_size=..."
        ) from error
    env.reset(seed=config.seed)  # what is hidden and constant in a run is sampled here
    if not resume:
        folder.refuse_existing()
    made = not folder.path.exists()
    try:
        with folder.locked():
            if config.learner.pipelined:
                given = (config.learner, SpacesOnlyEnv(env)), named
                learner = PipelinedLearner(learner, given, waits=True, imports=config.imports)
            if not resume:
                folder.create(config)
            try:
                return _train(folder, config, env, learner, resume, report, demonstrator, person)
            except InputError:
                # What was wrong is to be put right and tried again, and a configuration alone is in the way of that.
                # What a learner diverged with is kept.
                if not resume and not learner.has_diverged():
                    folder.remove_unbegun(made=made)
                raise
    finally:
        learner.close()
        env.close()


def _train(
    folder: RunFolder,
    config: RunConfig,
    env: Any,
    learner: Learner,
    resume: bool,
    report: Callable[[dict[str, Any]], None] | None,
    demonstrator: Callable[[gymnasium.Env], PolicyFn] | None,
    person: Supervisor | None,
) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = []
    if resume:
        rows, written = _resume(folder, learner, env)
        if written < len(rows):
            folder.write_episodes(rows)  # a run that is complete writes no table any more
        if len(rows) < config.episodes:
            folder.remove_policy()  # killed from here on, it has one of fewer episodes than its table
    watched = None
    if config.with_person and person is not None:
        watched = SupervisedTraining(config, person, load_checkpoint(folder.checkpoint)[1] if rows else {})
        watched.env.unwrapped.np_random.bit_generator.state = env.unwrapped.np_random.bit_generator.state
        env, config = watched.env, watched.config
    folder.write_config(config)

    step_log = StepLog(env, folder.steps)
    watching: list[Callback] = [step_log] if config.step_log else []
    shown = 0 if demonstrator is None else config.learner.demonstration_episodes
    spent_training, spent_saving, last_saving = 0.0, 0.0, 0.0
    for episode in range(len(rows), config.episodes):
        started = time.perf_counter()
        act = demonstrator(env) if demonstrator is not None and episode < shown else learner.act
        if watched is None:
            row = rollout(env, act, learner, *watching, index=episode)
        else:
            row = watched.rollout(act, learner, *watching, index=episode)
            env = watched.env
        if learner.has_diverged():
            raise diverged()
        if shown:
            row["is_demonstration"] = int(episode < shown)
        row["wall_time"] = time.perf_counter() - started
        if rows and rows[0].keys() != row.keys():
            raise InputError(
                f"the run in {folder.path} was begun by another version of guiderail, whose episodes have other "
                "numbers: go on with that one, or train anew"
            )
        rows.append(row)
        spent_training += time.perf_counter() - started
        if report is not None:
            report(rows[-1])
        with_another = step_log.seconds + spent_saving + last_saving
        if with_another <= SAVING_SHARE * spent_training or episode + 1 in (1, config.episodes):
            started = time.perf_counter()
            _save(folder, rows, learner, env, watched)
            last_saving = time.perf_counter() - started
            spent_saving += last_saving
        learner.submit_episode()
    learner.finish()
    policy = learner.policy({"task": config.task, "observation_shape": list(env.observation_space.shape or ())})
    policy.save(folder.path, write=write_atomically)
    return rows


def _save(
    folder: RunFolder, rows: list[dict[str, Any]], learner: Learner, env: Any, watched: SupervisedTraining | None
) -> None:
    """The checkpoint first: it holds the table too, and whoever is killed between the two loses nothing."""
    arrays, values = learner.state()
    generator = env.unwrapped.np_random.bit_generator.state
    held = {"rows": rows, "learner": values, "environment": generator}
    save_checkpoint(folder.checkpoint, arrays, held | ({} if watched is None else watched.state()))
    if watched is not None:
        folder.write_config(watched.config)
    folder.write_episodes(rows)


def _resume(folder: RunFolder, learner: Learner, env: Any) -> tuple[list[dict[str, Any]], int]:
    """Puts learner and environment back to the last checkpoint; returns the rows up to it, and how many of them the
    table has: fewer where the run was killed between the two.
    """
    table = folder.path / "episodes.csv"
    if not folder.checkpoint.exists() and not table.exists():
        return [], 0  # it was killed in its first episode
    arrays, values = load_checkpoint(folder.checkpoint)
    try:
        rows = values["rows"]
        written = folder.episodes() if table.exists() else []
        if table_text(written) != table_text(rows[: len(written)]):
            raise InputError(
                f"{table} is not the table of its checkpoint: restore it, or remove it to have it rewritten"
            )
        learner.restore(arrays, values["learner"])
        env.unwrapped.np_random.bit_generator.state = values["environment"]
    except InputError:
        raise
    except Exception as error:  # its digest says that it was written so, and not what was written
        raise InputError(
            f"the checkpoint {folder.checkpoint} belongs to other settings: give those of {folder.path / 'config.yaml'}"
        ) from error
    return rows, len(written)
