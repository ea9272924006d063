"""Session at a robot: connection, environment and confirmed pre-flight checks, ready for episodes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from typing import Any

import torch
from threadpoolctl import threadpool_limits

from guiderail.diagrams.envs.assemble import build_task_diagram
from guiderail.diagrams.envs.config import EnvConfig
from guiderail.diagrams.envs.make import make_guidance, make_station
from guiderail.diagrams.tasks.insertion import InsertionTask
from guiderail.models.common.errors import InputError
from guiderail.tools.learning.run_folder import RunConfig
from guiderail_hardware.drivers.clock import set_realtime_priority
from guiderail_hardware.drivers.fci_lockstep import FciLockstepClock
from guiderail_hardware.drivers.lcm import LcmDriver
from guiderail_hardware.robot.connection import NO_REALTIME_PRIORITY, Log, RobotConnection, watch_process
from guiderail_hardware.robot.operator import confirm, operator_keys
from guiderail_hardware.robot.preflight import confirm_checks
from guiderail_hardware.robot.robot_env import RobotEnv
from guiderail_hardware.robot.sim_driver import PartRandomizer, publish_part_offsets
from guiderail_hardware.station import HardwareStation


@contextmanager
def robot_session(
    config: RunConfig, connection: RobotConnection, *, assume_yes: bool, log: Log
) -> Iterator[tuple[RobotEnv, Callable[[], Mapping[str, Any]]]]:
    """Wait for the robot, ask for confirmation of the pre-flight checks, and yield the environment.

    With a simulated driver, a reset samples the offsets of the parts as in simulation, and the fixture is removed in
    place of an operator who releases the workpiece. With `assume_yes`, the checks need no confirmation; resuming after
    a stop always needs one.

    Yields:
        The environment, and a function that returns statistics of the intervals between statuses so far, which are
        empty in lockstep.

    Raises:
        InputError: If the task has no observable success, its reward needs simulation state, no robot answers, a check
            fails or is not confirmed, or a signal arrives before the arm may move.
    """
    resolved = EnvConfig.resolve(config.task, config.environment)
    task = resolved.declared
    if not isinstance(task, InsertionTask) or task.observable_success() is None:
        raise InputError(f"{config.task} has no success that a robot can observe: train it in simulation")
    if task.reward in task.simulated_rewards:
        raise InputError(f"the reward {task.reward!r} needs simulation state: choose another")
    threadpool_limits(1)
    torch.set_num_threads(1)
    station = make_station(resolved)
    assert isinstance(station, HardwareStation)
    diagram = build_task_diagram(resolved, station, make_guidance(resolved, station))
    with (
        connection.simulated_driver(config.task, station.driver.url, config.imports) as process,
        operator_keys() as keys,
    ):
        clock, wall_clock = connection.clocks(station)
        watch_process(clock, process)
        log(f"waiting for {connection.robot} on {station.driver}")

        randomize_parts = None
        if isinstance(clock, FciLockstepClock):
            randomize_parts = PartRandomizer(task, clock.move_parts, config.seed)
        elif connection.sim and isinstance(station.driver, LcmDriver):
            randomize_parts = PartRandomizer(task, partial(publish_part_offsets, station.driver), config.seed)

        def ask(reason: str, question: str) -> None:
            log(f"the motion is stopped: {reason}")
            if keys.must_end:
                raise InputError("stopped by a signal: the arm does not move again")
            confirm(question, has_yes=False)

        def free_workpiece(reason: str) -> None:
            if randomize_parts is None or keys.is_stop_requested():
                ask(reason, "Release the workpiece by hand, put the parts back, and keep clear. May the arm move?")
            if randomize_parts is not None:
                randomize_parts.remove_fixture()

        env = RobotEnv(
            diagram,
            station,
            clock,
            action_repeat=config.action_repeat,
            keys=keys,
            confirm_resume=lambda reason: ask(reason, "Resume from the arm's present pose?"),
            free_workpiece=free_workpiece,
            log=log,
            randomize_parts=randomize_parts,
        )
        confirm_checks(env.preflight, log, assume_yes=assume_yes)
        if not connection.synchronous and not set_realtime_priority():
            log(NO_REALTIME_PRIORITY)
        log(keys.describe(has_pauses=True))
        keys.is_moving = True
        yield env, lambda: connection.timing(station, wall_clock)
