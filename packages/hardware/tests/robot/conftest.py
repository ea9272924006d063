"""Executor of a skill with a simulated robot, both in one process."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from injections.stepped_robot import SteppedRobotClock
from pydrake.lcm import DrakeLcm

from guiderail.diagrams.envs.config import EnvConfig
from guiderail.diagrams.envs.make import make_skill
from guiderail_hardware.drivers.driver import safety_limits
from guiderail_hardware.robot.executor import SkillExecutor

OPTIONS = {"station": "hardware", "guidance": "kmp", "fixture_offset": "none"}


@pytest.fixture(autouse=True, scope="module")
def shorten_pauses():
    """Shorten the pauses before and after motions, which are most of the simulated time.

    Collections of garbage between episodes are left out, because they would traverse the objects of all tests.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            "guiderail_hardware.station.safety_limits",
            lambda plant, driver: replace(safety_limits(plant, driver), ramp_time=0.1, damping_time=0.1),
        )
        patch.setattr("guiderail_hardware.drivers.driver.Driver.hold_off", 0.15)
        patch.setattr("guiderail_hardware.robot.preflight.SETTLING_TIME", 0.1)
        patch.setattr("guiderail_hardware.robot.robot_env.gc", SimpleNamespace(collect=lambda: 0))
        yield


@pytest.fixture
def make_executor(monkeypatch):
    """Return a function that builds an executor, with the clock that steps its simulated robot.

    By default, the arm begins at the skill's start. Step 95 of the clock is then in the approach, and step 130 in the
    skill.
    """

    def make_executor(
        start=None,
        policy=lambda observation: np.zeros(2),
        num_steps=10,
        is_stop_requested=lambda: False,
        has_monitor=False,
        **options,
    ):
        lcm = DrakeLcm("memq://")
        with monkeypatch.context() as patch:
            # The skill's station would open another bus in memory by its URL.
            patch.setattr("guiderail_hardware.drivers.lcm.open_bus", lambda url: lcm)
            skill = make_skill("BncConnector", policy, **OPTIONS, **options)
        task = EnvConfig.resolve("BncConnector", OPTIONS | options).declared
        start = task.start_pose(np.random.default_rng(0)) if start is None else start
        clock = SteppedRobotClock(task.workcell(), lcm, start, has_monitor)
        skill = type(skill)(skill.diagram, skill.control_period, num_steps, skill.randomize)
        return SkillExecutor(task, skill, clock, is_stop_requested), clock

    return make_executor
