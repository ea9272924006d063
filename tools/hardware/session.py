"""A robot, or a simulated one that stands in for it, with everything checked: ready for episodes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from threadpoolctl import threadpool_limits

from guiderail.diagrams.envs.assemble import build_task_diagram
from guiderail.diagrams.envs.config import EnvConfig
from guiderail.diagrams.envs.make import make_guidance, make_station
from guiderail.diagrams.hardware.clock import set_realtime_priority
from guiderail.diagrams.hardware.station import HardwareStation
from guiderail.diagrams.tasks.insertion import InsertionTask
from guiderail.models.common.errors import InputError
from guiderail.tools.hardware.connection import RobotConnection
from guiderail.tools.hardware.part_randomization import PartRandomizer
from guiderail.tools.hardware.preflight import confirm, confirm_checks
from guiderail.tools.hardware.robot_env import RobotEnv
from guiderail.tools.learning.run_folder import RunConfig
from guiderail.tools.teleop.teleoperator import listening

Say = Callable[[str], None]


@dataclass(frozen=True)
class RobotSession:
    """What episodes need: the environment, and how regularly the robot was heard until now."""

    env: RobotEnv
    timing: Callable[[], Mapping[str, Any]]


@contextmanager
def robot_session(config: RunConfig, other: RobotConnection, *, yes: bool, say: Say) -> Iterator[RobotSession]:
    """Waits for the robot, reads out what is assumed of it, and has that confirmed.

    In a rehearsal a reset draws what it does in a simulation, and the simulated robot's parts are put there.

    Args:
        config: of a run: its task, and an environment whose station is a robot.
        other: the other end of the bus.
        yes: what is asked is answered so: of a rehearsal, that the arm goes on after a stop, too.
        say: what a person is told.

    Raises:
        InputError: for a task that no robot can do so, or where a check fails or isn't confirmed.
    """
    task = EnvConfig.resolve(config.task, config.environment).make_task()
    if not isinstance(task, InsertionTask) or task.observable_success() is None:
        raise InputError(f"nobody wrote down how a robot tells that {config.task} is done: learn it in a simulation")
    if task.config.reward in task.simulated_rewards:
        raise InputError(f"the reward {task.config.reward!r} is of what a simulation alone knows: choose another")
    threadpool_limits(1)
    torch.set_num_threads(1)
    station = make_station(task)
    assert isinstance(station, HardwareStation)
    diagram = build_task_diagram(task, station, make_guidance(task, station))
    start = task.start_pose(np.random.default_rng(0))
    with other.standing_in(config.task, station.lcm_url, config.imports), listening() as keys:
        pace, clock = other.paces(station)
        say(f"waiting for {other.robot} on {station.lcm_url or 'LCM'}, channel {station.driver.status_channel}")

        def go_on(words: str) -> None:
            say(f"the arm is at rest: {words}")
            if not (yes and other.sim):
                confirm("Shall it go on from where it is?")

        env = RobotEnv(
            diagram,
            station,
            station.clone(task.workcell()),
            start,
            pace,
            action_repeat=config.action_repeat,
            keys=keys,
            go_on=go_on,
            say=say,
            places=PartRandomizer(task, station.lcm, station.driver, config.seed) if other.sim else None,
        )
        confirm_checks(env.checks(), say, again=env.checks_again, is_confirmed=yes)
        if not other.synchronous and not set_realtime_priority():
            say("the system serves this process as any other: on a busy machine the arm will be stopped as late")
        say(keys.words(pauses=True))
        yield RobotSession(env, lambda: other.timing(station, clock))
