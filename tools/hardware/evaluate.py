"""`guiderail run RUN --episodes N`: how often a policy succeeds on a robot, or in a rehearsal."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import pandas as pd

from guiderail.models.common.errors import InputError
from guiderail.models.policy import Policy
from guiderail.tools.evaluation.evaluate import HELD_OUT_SEED
from guiderail.tools.evaluation.metrics import summary
from guiderail.tools.evaluation.progress import EpisodeProgress
from guiderail.tools.evaluation.rollout import PolicyFn, rollout
from guiderail.tools.files import write_atomically
from guiderail.tools.hardware.connection import RobotConnection
from guiderail.tools.hardware.executor import on_a_robot
from guiderail.tools.hardware.session import Say, robot_session
from guiderail.tools.learning.run_folder import RunFolder
from guiderail.tools.tables import table_text
from guiderail.tools.teleop.teleoperator import no_pauses

FOUND = (
    "episodes",
    "success_rate",
    "success_low",
    "success_high",
    "mean_return",
    "max_commanded_violation",
    "peak_force",
)


def evaluate_on_robot(
    run: Path,
    other: RobotConnection,
    episodes: int,
    *,
    station: str = "hardware",
    policy: str = "",
    acting: Callable[[gymnasium.Env], PolicyFn] | None = None,
    yes: bool = False,
    out: Path | None = None,
    say: Say = print,
) -> Mapping[str, Any]:
    """Runs episodes one after the other, and writes a row for each; returns what came of them, in a few numbers.

    In a rehearsal they are those that `guiderail evaluate` has: conditions that training never met, and the run's own
    for what is hidden in it.

    Args:
        run: the folder of a run.
        other: the other end of the bus.
        episodes: how many.
        station: a real one.
        policy: what acts instead of the run's own policy is called so.
        acting: what that is, for an environment.
        yes: what is asked is answered so.
        out: the folder of the rows; `hardware` in the run unless given.
        say: what a person is told.

    Raises:
        InputError: for what can't be run, where no robot answers, a check fails or isn't confirmed, or for rows
            that are there already.
    """
    if episodes < 1:
        raise InputError(f"a number of episodes is at least one, not {episodes}")
    folder = RunFolder(run)
    config = folder.config()
    learned = Policy.load(folder.path) if acting is None else None
    environment = on_a_robot(config.task, config.environment, station) | other.environment(station)
    config = replace(config, environment=environment)
    path = (out or run / "hardware") / f"episodes{'-' * bool(policy)}{policy}.csv"
    rows: list[dict[str, Any]] = []

    def write(rows: list[dict[str, Any]]) -> None:
        if rows:
            write_atomically(path, table_text(pd.DataFrame(rows)).encode())

    with RunFolder(path.parent).locked():
        if path.exists():
            raise InputError(f"{path} already exists: name another folder with --out, or remove it")
        with robot_session(config, other, yes=yes, say=say) as robot:
            env = robot.env
            act = learned if acting is None else acting(env)
            assert act is not None
            with no_pauses(), EpisodeProgress(episodes, name=policy or config.task, window=None) as progress:
                try:
                    for index in range(episodes):
                        rows.append(rollout(env, act, index=index, seed=HELD_OUT_SEED + index, held_out=other.sim))
                        env.idle()
                        write(rows)
                        env.idle()
                        progress.update(rows[-1])
                        env.pause()
                finally:
                    try:
                        env.rest()
                    finally:
                        write(rows)  # of the last episode too, where nobody let the arm go on
    return {"rows": str(path), **summary(pd.DataFrame(rows), FOUND)}
