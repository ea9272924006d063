"""`guiderail train TASK --station hardware`: learning on a robot, or on a simulated one at the other end of the bus."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from contextlib import closing, suppress
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import pandas as pd

from guiderail.models.common.errors import InputError
from guiderail.tools.evaluation.metrics import summary
from guiderail.tools.evaluation.progress import EpisodeProgress
from guiderail.tools.evaluation.rollout import rollout
from guiderail.tools.evaluation.step_log import step_log_file, table
from guiderail.tools.files import write_atomically
from guiderail.tools.hardware.connection import RobotConnection
from guiderail.tools.hardware.robot_env import RobotEnv
from guiderail.tools.hardware.session import Say, robot_session
from guiderail.tools.learning.learner import LEARNERS, learner_arguments
from guiderail.tools.learning.pipelined import PipelinedLearner, SpacesOnlyEnv
from guiderail.tools.learning.run_folder import RunConfig, RunFolder
from guiderail.tools.learning.train import SUMMARY, configure, with_defaults
from guiderail.tools.teleop.teleoperator import no_pauses

UNSOUND = ("stopped", "did_not_hold", "simulation_failure")  # terminations of episodes that nobody should learn from
NICENESS = 5  # of the gradient steps, beside whoever has to be in time


def train_on_robot(
    task: str,
    out: Path,
    other: RobotConnection,
    *,
    environment: Mapping[str, Any],
    given: Mapping[str, Any],
    settings: Mapping[str, Any] | None = None,
    yes: bool = False,
    say: Say = print,
) -> dict[str, Any]:
    """Learns on a robot and leaves a run folder; returns what happened, in a few numbers.

    Args:
        task: an insertion that says how a robot tells its success.
        out: the run's folder.
        other: the other end of the bus.
        environment: options by name, `station` a real one.
        given: of `configure`: algorithm, preset, episodes, seed.
        settings: of the learner.
        yes: what is asked is answered so: of a rehearsal, that the arm goes on after a stop, too.
        say: what a person is told.

    Raises:
        InputError: for what can't be learned so, or where a check fails or isn't confirmed.
    """
    folder = RunFolder(out)
    folder.refuse_existing()
    environment = {**environment, **other.environment(str(environment["station"]))}
    config = configure(task, environment, **with_defaults(task, {**given, "settings": settings}))
    if config.learner.demonstration_episodes:
        raise InputError("nobody demonstrates on a robot: leave the setting demonstration_episodes out")
    with folder.locked(), robot_session(config, other, yes=yes, say=say) as robot:
        folder.write_config(config)
        try:
            with no_pauses(), EpisodeProgress(config.episodes, name=config.task) as progress:
                rows = _learn(folder, config, robot.env, waits=other.synchronous, report=progress.update)
        finally:
            timing = pd.Series(dict(robot.timing()), dtype=object)
            write_atomically(folder.path / "hardware.json", timing.to_json(indent=2).encode() + b"\n")
    return {"run": str(out), **summary(pd.DataFrame(rows), SUMMARY), "not_learned_from": _unsound(rows)}


def _unsound(rows: list[dict[str, Any]]) -> int:
    return sum(not row["learned_from"] for row in rows)


def _learn(
    folder: RunFolder,
    config: RunConfig,
    env: RobotEnv,
    *,
    waits: bool,
    report: Callable[[dict[str, Any]], None],
) -> list[dict[str, Any]]:
    """All episodes; whatever is raised, the arm is brought to rest, and what was recorded and learned is kept."""
    named = learner_arguments(config, env.task)
    acting: Any = LEARNERS.get(config.learner.algorithm)(config.learner, env, **named)
    student = PipelinedLearner(
        acting,
        ((config.learner, SpacesOnlyEnv(env)), named),
        waits=waits,
        excluded=UNSOUND,
        niceness=NICENESS,
        imports=config.imports,
    )
    rows: list[dict[str, Any]] = []
    due: list[Callable[[], None]] = []  # what the last episode still leaves

    def write_step_log() -> None:
        if config.step_log:
            student.write(step_log_file(folder.steps, rows[-1]["episode"]), table(env.trace, rows[-1]["episode"]))

    def save_policy() -> None:
        shape = list(env.observation_space.shape or ())
        acting.policy({"task": config.task, "observation_shape": shape}).save(folder.path, write=write_atomically)

    def save_learned() -> None:
        if student.known:
            save_policy()

    try:
        student.warm_up()
        gymnasium.Env.reset(env, seed=config.seed)
        while len(rows) < config.episodes:
            started = time.perf_counter()
            row = rollout(env, student.act, student, index=len(rows))
            row |= {"learned_from": int(row["termination"] not in UNSOUND)}
            row |= {"episodes_known": student.known, "late": student.late}
            row |= {"fault": env.fault.name, "wall_time": time.perf_counter() - started}
            rows.append(row)
            due = [student.submit_episode, write_step_log, partial(folder.write_episodes, rows)]
            while due:
                due[0]()
                due.pop(0)
                env.idle()
            report(row)
            env.pause()
        env.rest()
        student.finish()
    except BaseException:
        with closing(student):
            try:
                env.rest()
            finally:
                # Each for itself: what ended it may have been the disk, or the process that learns. What is known is
                # saved before anything is waited for, and again when all that was handed over is learned.
                for leave in (*due, save_learned, student.finish, save_learned):
                    with suppress(Exception):
                        leave()
        raise
    save_policy()
    return rows
