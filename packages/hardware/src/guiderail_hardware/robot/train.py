"""Training on a robot or a simulated driver: `guiderail train-on-robot TASK`."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from contextlib import closing, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import pandas as pd

from guiderail.diagrams.envs.config import EnvConfig
from guiderail.models.common.errors import InputError
from guiderail.models.common.termination import Termination
from guiderail.tools.evaluation.metrics import summary
from guiderail.tools.evaluation.rollout import EpisodeProgress, rollout
from guiderail.tools.evaluation.step_log import step_log_file, table
from guiderail.tools.files import check_room, write_atomically
from guiderail.tools.learning.configure import configure, resumed_config, warn_of_unfinished_source, with_defaults
from guiderail.tools.learning.learner import LEARNERS, learner_arguments
from guiderail.tools.learning.networks import SpacesOnlyEnv
from guiderail.tools.learning.pipelined import PipelinedLearner
from guiderail.tools.learning.run_folder import RunConfig, RunFolder
from guiderail.tools.learning.train import SUMMARY
from guiderail.tools.learning.trainer import learned_policy, restore_checkpoint, write_checkpoint
from guiderail_hardware.drivers.clock import garbage_collection_disabled
from guiderail_hardware.robot.connection import Log, RobotConnection
from guiderail_hardware.robot.executor import record_size
from guiderail_hardware.robot.robot_env import RobotEnv
from guiderail_hardware.robot.session import robot_session

EXCLUDED_TERMINATIONS = (
    Termination.STOPPED,
    Termination.DID_NOT_HOLD,
    Termination.SIMULATION_FAILURE,
)  # their episodes are not used for training
NICENESS = 5  # niceness of the training process, which must not delay the control loop


def train_on_robot(
    task: str | None,
    out: Path,
    connection: RobotConnection,
    *,
    environment: Mapping[str, Any],
    given: Mapping[str, Any],
    settings: Mapping[str, Any] | None = None,
    resume: bool = False,
    assume_yes: bool = False,
    log: Log = print,
) -> dict[str, Any]:
    """Train a policy on a robot, write a run folder, and return statistics of the training.

    Every episode ends with a checkpoint, so that a killed run can be resumed.

    Args:
        task: Name of an insertion task that defines `observable_success`, success estimated from the measured pose;
            optional with `resume`.
        out: Run folder; with `resume`, the folder of the run to continue.
        connection: Connection to the robot driver.
        environment: Environment options by name, with a hardware station.
        given: Arguments of `configure`: algorithm, preset, episodes, seed, step_log and imports.
        settings: Settings of the learner by name.
        resume: Continue a run from its last checkpoint; the address of the robot may differ.
        assume_yes: Skip the confirmation of the checks; resuming after a stop is always confirmed.
        log: Function that shows a message.

    Raises:
        InputError: If the task cannot be trained on hardware, a setting is invalid or needs demonstrations, the folder
            exists, has no room for the step log or, with `resume`, contradicts an argument or the kind of driver, no
            robot answers, or a check fails or is not confirmed.
    """
    folder = RunFolder(out)
    options = connection.environment_options(str(environment["station"]))
    if resume:
        unchanged = {name: value for name, value in environment.items() if name != "robot_url"}
        choices = {name: value for name, value in given.items() if name != "imports"}
        config = resumed_config(folder, task, unchanged, choices, settings)
        if config.simulated_driver not in (None, connection.sim):
            hint = "a simulated driver: give --sim" if config.simulated_driver else "a robot: leave --sim out"
            raise InputError(f"the run in {out} was trained with {hint}, or train again in another folder")
        config = replace(config, environment={**config.environment, **options})
    elif task is None:
        raise InputError("training needs a task: name a task, such as guiderail train-on-robot BncConnector --out RUN")
    else:
        folder.refuse_existing()
        config = configure(task, {**environment, **options}, **with_defaults(task, {**given, "settings": settings}))
        warn_of_unfinished_source(config)
    if config.learner.demonstration_episodes:
        raise InputError("there are no demonstration episodes on a robot: leave the setting demonstration_episodes out")
    if config.learner.stop_after_successes:
        raise InputError("the operator ends training on a robot: leave the setting stop_after_successes out")
    config = replace(config, simulated_driver=connection.sim)
    if config.step_log:
        num_steps = EnvConfig.resolve(config.task, config.environment).num_steps
        check_room(step_log_file(folder.steps, 0), config.episodes * record_size(num_steps))
    with folder.locked(), robot_session(config, connection, assume_yes=assume_yes, log=log) as (env, timing):
        folder.write_config(config)
        try:
            with (
                garbage_collection_disabled(),
                EpisodeProgress(config.episodes, name=config.task, asks=True) as progress,
            ):
                rows = _train(folder, config, env, waits=connection.synchronous, resume=resume, report=progress.update)
        finally:
            intervals = pd.Series(dict(timing()), dtype=object)
            write_atomically(folder.path / "hardware.json", intervals.to_json(indent=2).encode() + b"\n")
    num_excluded = sum(not row["learned_from"] for row in rows)
    return {"run": str(out), **summary(pd.DataFrame(rows), SUMMARY), "not_learned_from": num_excluded}


def _train(
    folder: RunFolder,
    config: RunConfig,
    env: RobotEnv,
    *,
    waits: bool,
    resume: bool = False,
    report: Callable[[dict[str, Any]], None],
) -> list[dict[str, Any]]:
    """Run all episodes; after any exception, bring the arm to rest, and save recorded episodes and learned weights."""
    arguments = learner_arguments(config, env.diagram)
    acting: Any = LEARNERS.get(config.learner.algorithm)(config.learner, env, **arguments)
    learner = PipelinedLearner(
        acting,
        ((config.learner, SpacesOnlyEnv(env)), arguments),
        waits=waits,
        excluded=EXCLUDED_TERMINATIONS,
        niceness=NICENESS,
        imports=config.imports,
    )
    rows: list[dict[str, Any]] = []
    due: list[Callable[[], None]] = []  # remaining work of the last episode
    learned_before = 0  # number of episodes used for training before the run was resumed

    def wait_until_learned() -> None:
        while not learner.receive_learned():
            env.idle()

    def write_step_log() -> None:
        if config.step_log:
            learner.write(step_log_file(folder.steps, rows[-1]["episode"]), table(env.trace, rows[-1]["episode"]))

    def save_policy() -> None:
        learned_policy(config, acting, env).save(folder.path, write=write_atomically)

    def save_learned() -> None:
        if learner.known:
            save_policy()

    try:
        learner.warm_up()
        gymnasium.Env.reset(env, seed=config.seed)
        if resume:
            rows += restore_checkpoint(folder, config, learner, env)[0]
            learned_before = sum(row["learned_from"] for row in rows[:-1])
        while len(rows) < config.episodes:
            started = time.perf_counter()
            row = rollout(env, learner.act, learner, index=len(rows))
            row |= {"learned_from": int(row["termination"] not in EXCLUDED_TERMINATIONS)}
            row |= {"episodes_known": learned_before + learner.known, "late": learner.late}
            row |= {"fault": env.fault.name, "wall_time": time.perf_counter() - started}
            rows.append(row)
            due = [
                wait_until_learned,
                partial(write_checkpoint, folder, config, rows, learner, env),
                learner.submit_episode,
                write_step_log,
                partial(folder.write_episodes, rows),
            ]
            while due:
                due[0]()
                due.pop(0)
                env.idle()
            report(row)
            env.pause()
        env.rest()
        learner.finish()
    except BaseException:
        with closing(learner):
            try:
                env.rest()
            finally:
                # An error in one step must not skip the others: the disk or the training process may have failed. The
                # current policy is saved before and after the training process finishes. Only `wait_until_learned` is
                # skipped, because it would resume the arm; the checkpoint waits for the weights without the arm.
                remaining = (save for save in due if save is not wait_until_learned)
                for save in (*remaining, save_learned, learner.finish, save_learned):
                    with suppress(Exception):
                        save()
        raise
    save_policy()
    return rows
