"""Training on a robot or a simulated driver: `guiderail train-on-robot TASK`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import closing, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pandas as pd

from guiderail.diagrams.envs.config import EnvConfig
from guiderail.models.common.errors import InputError
from guiderail.models.common.termination import Termination
from guiderail.tools.evaluation.episode import Callback
from guiderail.tools.evaluation.metrics import summary
from guiderail.tools.evaluation.step_log import step_log_file, table
from guiderail.tools.files import write_atomically
from guiderail.tools.learning.episodes import Episodes
from guiderail.tools.learning.learner import LEARNERS, Learner, learner_arguments
from guiderail.tools.learning.networks import SpacesOnlyEnv
from guiderail.tools.learning.run_folder import (
    RunConfig,
    RunFolder,
    configure,
    resumed_config,
    warn_of_unfinished_source,
)
from guiderail.tools.learning.train import SUMMARY
from guiderail.tools.learning.trainer import TrainingLoop
from guiderail.tools.progress import EpisodeProgress
from guiderail_hardware.drivers.clock import garbage_collection_disabled
from guiderail_hardware.robot.connection import Log, RobotConnection
from guiderail_hardware.robot.executor import record_size
from guiderail_hardware.robot.pipelined_learner import PipelinedLearner
from guiderail_hardware.robot.records import check_room
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
        given: Arguments of `configure`: the choices of a run, and imports.
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
        choices: Any = {name: value for name, value in given.items() if name != "imports"}
        config = resumed_config(folder, task, unchanged, choices)
        if config.simulated_driver not in (None, connection.sim):
            hint = "a simulated driver: give --sim" if config.simulated_driver else "a robot: leave --sim out"
            raise InputError(f"the run in {out} was trained with {hint}, or train again in another folder")
        config = replace(config, environment={**config.environment, **options})
    elif task is None:
        raise InputError("training needs a task: name a task, such as guiderail train-on-robot BncConnector --out RUN")
    else:
        folder.refuse_existing()
        config = configure(task, {**environment, **options}, **given)
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


class RobotEpisodes(Episodes):
    """Episodes on a robot, whose arm must not wait longer than the command timeout while they are saved."""

    is_real_time = True

    def __init__(self, config: RunConfig, env: RobotEnv, folder: RunFolder, learner: PipelinedLearner):
        """Construct the episodes; the training process of `learner` writes their step log into `folder`."""
        super().__init__(config, env)
        self._robot, self._folder, self._pipelined = env, folder, learner
        self._learned_before = 0  # number of episodes used for training before the run was resumed
        self._index = 0

    def restore(self, rows: list[dict[str, Any]], arrays: Mapping[str, np.ndarray], values: Mapping[str, Any]) -> None:
        """Count the episodes before the run was resumed."""
        self._learned_before = sum(row["learned_from"] for row in rows[:-1])

    def run(self, learner: Learner, *callbacks: Callback, index: int) -> dict[str, Any]:
        """Run one episode and return its row, with the columns of a robot."""
        self._index, pipelined = index, self._pipelined
        row = super().run(learner, *callbacks, index=index)
        row |= {"learned_from": int(row["termination"] not in EXCLUDED_TERMINATIONS)}
        row |= {"episodes_known": self._learned_before + pipelined.known, "late": pipelined.late}
        return row | {"fault": self._robot.fault.name}

    def saving_steps(
        self, checkpoint: Callable[[], None], table: Callable[[], None], submit: Callable[[], None]
    ) -> list[Callable[[], None]]:
        """Return the steps of saving; the checkpoint does not wait for the training process."""
        return [self.wait_until_learned, checkpoint, submit, self._write_step_log, table]

    def wait_until_learned(self) -> None:
        """Hold the arm until all submitted episodes are learned."""
        while not self._pipelined.receive_learned():
            self.idle()

    def _write_step_log(self) -> None:
        if self.config.step_log:
            self._pipelined.write(step_log_file(self._folder.steps, self._index), table(self._robot.trace, self._index))

    def idle(self) -> None:
        """Hold the arm for a control step."""
        self._robot.idle()

    def end_episode(self) -> None:
        """Bring the arm to rest if the operator requested a pause."""
        self._robot.pause()

    def end(self) -> None:
        """Bring the arm to rest."""
        self._robot.rest()


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
    episodes = RobotEpisodes(config, env, folder, learner)
    loop = TrainingLoop(folder, learner, episodes, report)

    def save_learned() -> None:
        if learner.known:
            loop.save_policy()

    try:
        if not resume:
            TrainingLoop(folder, acting, episodes).check_learner()
        learner.warm_up()
        gymnasium.Env.reset(env, seed=config.seed)
        return loop.run(resume=resume)
    except BaseException:
        with closing(learner):
            try:
                env.rest()
            finally:
                # An error in one step must not skip the others: the disk or the training process may have failed. The
                # current policy is saved before and after the training process finishes. Only `wait_until_learned` is
                # skipped, because it would resume the arm; the checkpoint waits for the weights without the arm.
                remaining = [save for save in loop.remaining if save != episodes.wait_until_learned]
                for save in (*remaining, save_learned, learner.finish, save_learned):
                    with suppress(Exception):
                        save()
        raise
