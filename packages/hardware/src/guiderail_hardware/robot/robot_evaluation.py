"""Evaluation of a policy on a robot or a simulated driver: `guiderail deploy RUN --episodes N`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pandas as pd

from guiderail.models.common.arrays import as_whole
from guiderail.models.common.errors import InputError
from guiderail.models.common.termination import Termination
from guiderail.models.policy import Policy
from guiderail.tools.evaluation.baselines import make_baseline
from guiderail.tools.evaluation.episode import HELD_OUT_SEED
from guiderail.tools.evaluation.metrics import summary
from guiderail.tools.evaluation.rollout import rollout
from guiderail.tools.files import write_atomically
from guiderail.tools.learning.run_folder import RunFolder
from guiderail.tools.pretrained import find_run
from guiderail.tools.progress import EpisodeProgress
from guiderail.tools.tables import table_text
from guiderail_hardware.drivers.clock import garbage_collection_disabled
from guiderail_hardware.robot.connection import Log, RobotConnection
from guiderail_hardware.robot.executor import configuration, hardware_environment, recordings_folder
from guiderail_hardware.robot.records import write_record
from guiderail_hardware.robot.session import robot_session

STATISTICS = (
    "episodes", "success_rate", "success_low", "success_high", "mean_return", "max_commanded_violation", "peak_force",
)  # fmt: skip


def evaluate_on_robot(
    run: Path,
    connection: RobotConnection,
    episodes: int,
    *,
    task: str | None = None,
    station: str = "hardware",
    policy: str | None = None,
    assume_yes: bool = False,
    out: Path | None = None,
    log: Log = print,
) -> Mapping[str, Any]:
    """Run episodes of a policy on a robot or a simulated driver, and write a row for each.

    With a simulated driver, the episodes are those of `guiderail evaluate` in simulation, with held-out conditions and
    the run's own hidden offset.

    Args:
        run: Run folder, or `pretrained:NAME`.
        connection: Connection to the robot driver.
        episodes: Number of episodes, at least 1.
        task: Task or task folder in which a policy without a run acts; None for a run.
        station: Name of a hardware station.
        policy: Name of a baseline or scripted policy that replaces the run's own; None for the run's own.
        assume_yes: Do not ask for confirmation.
        out: Folder of the rows; `recordings_folder` by default.
        log: Function that shows a message.

    Returns:
        `rows`, the path of the rows; the statistics of the episodes, in which a stopped episode counts as a failure;
        and `stopped`, the number of stopped episodes.

    Raises:
        InputError: If `episodes` is less than 1, the policy cannot be executed, no robot answers, a check fails or is
            not confirmed, the arm does not reach the start or does not resume, or the rows exist already.
    """
    as_whole(episodes, "the number of episodes", 1)
    config = configuration(run, task)
    make_policy = None if policy is None else make_baseline(config.task, policy, config.seed)
    own_policy = Policy.load(find_run(run)) if policy is None else None
    environment = hardware_environment(config.task, config.environment, station)
    if environment.get("reward") != config.environment.get("reward"):
        log(f"mean_return is of the reward {environment['reward']!r}, because the run's reward needs simulation state")
    config = replace(config, environment=environment | connection.environment_options(station))
    path = (out or recordings_folder(run)) / ("episodes.csv" if policy is None else f"episodes-{policy}.csv")
    rows: list[dict[str, Any]] = []

    def write(file: Path) -> None:
        write_atomically(file, table_text(pd.DataFrame(rows)).encode())

    with RunFolder(path.parent).locked():
        if path.exists():
            raise InputError(f"{path} already exists: name another folder with --out, or remove it")
        with robot_session(config, connection, assume_yes=assume_yes, log=log) as (env, _):
            act = own_policy if make_policy is None else make_policy(env)
            assert act is not None
            with (
                garbage_collection_disabled(),
                EpisodeProgress(episodes, name=policy or config.task, window=None, asks=True) as progress,
            ):
                try:
                    for index in range(episodes):
                        seed = HELD_OUT_SEED + index
                        rows.append(rollout(env, act, index=index, seed=seed, held_out=connection.sim))
                        env.idle()
                        write(path)
                        env.idle()
                        progress.update(rows[-1])
                        env.pause()
                finally:
                    try:
                        env.rest()
                    finally:
                        if rows:  # includes the last episode, even if resuming after it was not confirmed
                            path, failure = write_record(path, write)
                            if failure:
                                log(f"the motion was executed, but {failure}")
    stopped = sum(row["termination"] == Termination.STOPPED for row in rows)
    return {"rows": str(path), **summary(pd.DataFrame(rows), STATISTICS), "stopped": stopped}
