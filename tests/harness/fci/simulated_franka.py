"""Checks of a simulated Franka over its own protocol: insertion, lock, stop, unlock, loss of the robot, and reflex.

`make fci` runs the checks in an environment with franky and franky-sim. The robot is a separate process that answers
libfranka's network protocol. Robot and station advance in lockstep, so the speed of the machine does not matter.
"""

from __future__ import annotations

import os
import sys
from unittest.mock import patch

import numpy as np
from pydrake.systems.analysis import Simulator

from guiderail.diagrams.stations.station import Impedance
from guiderail.diagrams.tasks.bnc_connector import BncWorkcell
from guiderail_hardware.drivers.fci import FciDriver
from guiderail_hardware.drivers.fci_lockstep import FciLockstepClock
from guiderail_hardware.models.joint_status import STATUS_FAULTS, Fault
from guiderail_hardware.models.state_estimator import SOURCE_TIME
from guiderail_hardware.robot.connection import LOCKSTEP_TIMEOUT, subprocess_tied_to_parent
from guiderail_hardware.robot.sim_driver import START
from guiderail_hardware.station import HardwareStation
from guiderail_hardware.systems.torque_safety_limiter import ArmState

FORCE_LIMIT = 18.0  # bound of the impedance force [N]
STATUSES_PER_STEP = 4  # number of status periods in a control step
DOWN, TURN = 0.01, 0.25  # speeds of insertion [m/s] and turn [rad/s], below `motion_limits`
PRESSED = -0.006  # commanded height while the plug is turned [m]
LOW_THRESHOLDS = (6.0, 5.0)  # collision thresholds below the loads of the insertion [N, Nm]


class SimulatedRun:
    """Hardware station connected to the simulated robot, with a bound of the impedance force [N]."""

    def __init__(self, driver: type[FciDriver] = FciDriver, force_limit: float = FORCE_LIMIT):
        self.host = f"127.0.{os.getpid() // 250 % 250}.{os.getpid() % 250 + 1}"
        self.station = HardwareStation(
            BncWorkcell(), driver(self.host), Impedance().with_max_force(force_limit), robot="panda", robot_timeout=60.0
        )
        self.simulator = Simulator(self.station)
        self.context = self.simulator.get_mutable_context()
        self.clock = FciLockstepClock(self.host, LOCKSTEP_TIMEOUT, self.station.period)
        self.pose = START.copy()
        self.max_force = 0.0

    def start(self) -> None:
        self.station.get_desired_pose_input_port().FixValue(self.context, self.pose)
        self.station.start(self.simulator)
        self.clock.begin()

    def advance(self, seconds: float, velocity: np.ndarray | None = None) -> None:
        period = STATUSES_PER_STEP * self.station.period
        for _ in range(round(seconds / period)):
            if velocity is not None:
                self.pose = self.pose + period * velocity
            self.station.get_desired_pose_input_port().FixValue(self.context, self.pose)
            self.clock.advance(self.simulator, self.station, STATUSES_PER_STEP)
            self.max_force = max(self.max_force, float(self["impedance_force"][0]))

    def resume(self) -> None:
        """End a stop, and command the present pose until the blend factor is 1.

        After a robot was replaced, statuses are used when they have come from one source for `SOURCE_TIME`.
        """
        self.advance(SOURCE_TIME + 0.1)
        self.pose = self["pose"].copy()
        self.station.resume(self.context)
        self.advance(0.8)

    def __getitem__(self, port: str) -> np.ndarray:
        return self.station.GetOutputPort(port).Eval(self.context)

    def describe(self) -> str:
        state, fault = ArmState(int(self["arm_state"][0])), Fault(int(self["fault"][0]))
        position, turn = 1e3 * self["pose"][:3], np.rad2deg(self["pose"][3])
        return f"{state.name}, {fault.description}; at {np.round(position, 2)} mm, turned {turn:.1f} degrees"


def run_checks() -> list[str]:
    """Run the sequence of motions; return the names of failed checks."""
    failures = []

    def check(name: str, passed: bool, description: str) -> None:
        print(f"{'ok  ' if passed else 'FAIL'} {name:<12} {description}", flush=True)
        if not passed:
            failures.append(name)

    run = SimulatedRun()
    code = (
        "from guiderail_hardware.robot.sim_driver import run_sim_driver\n"
        f"run_sim_driver({run.host!r}, 1e4, 60.0, driver='fci', log=lambda _: None)"
    )
    with subprocess_tied_to_parent(code) as robot:
        run.start()
        for setup in run.station.driver.check_setup():
            check(setup.name, setup.passed in (True, None), setup.description)
        run.advance(1.2)
        check("take over", run["arm_state"][0] == ArmState.RUNNING, run.describe())
        run.advance((START[2] - PRESSED) / DOWN, np.array([0.0, 0.0, -DOWN, 0.0, 0.0, 0.0]))
        run.advance((START[3] + 0.1) / TURN, np.array([0.0, 0.0, 0.0, -TURN, 0.0, 0.0]))
        run.advance(0.3)
        height, turn = run["pose"][2], run["pose"][3]
        check("lock", abs(height) < 0.6e-3 + 0.4e-3 and abs(turn) < np.deg2rad(8.0), run.describe())
        check("force", run.max_force < 20.0, f"impedance force of at most {run.max_force:.1f} N")
        run.station.stop(run.context)
        run.advance(0.6)
        check("stop", run["arm_state"][0] == ArmState.OFF, run.describe())
        run.resume()
        check("resume", run["arm_state"][0] == ArmState.RUNNING, run.describe())
        # Back to the start: a robot that replaces this one is only followed in the last posture.
        run.advance((run.pose[2] - PRESSED) / DOWN, np.array([0.0, 0.0, -DOWN, 0.0, 0.0, 0.0]))
        run.advance((START[3] - run.pose[3]) / TURN, np.array([0.0, 0.0, 0.0, TURN, 0.0, 0.0]))
        run.advance((START[2] - PRESSED) / DOWN, np.array([0.0, 0.0, DOWN, 0.0, 0.0, 0.0]))
        run.advance(0.3)
        height, turn = run["pose"][2] - START[2], run["pose"][3] - START[3]
        check("unlock", abs(height) < 1e-3 and abs(turn) < np.deg2rad(8.0), run.describe())
        robot.kill()
        run.advance(0.6)
        check(
            "loss", Fault(int(run["fault"][0])) in STATUS_FAULTS and run["arm_state"][0] == ArmState.OFF, run.describe()
        )
    with subprocess_tied_to_parent(code):
        with patch("guiderail_hardware.drivers.fci._collision_thresholds", lambda impedance: LOW_THRESHOLDS):
            run.station.driver.recover()
        run.clock.begin()
        run.resume()
        check("recovery", run["arm_state"][0] == ArmState.RUNNING, run.describe())
        run.advance((START[2] - PRESSED) / DOWN, np.array([0.0, 0.0, -DOWN, 0.0, 0.0, 0.0]))
        check("reflex", run["arm_state"][0] == ArmState.OFF, f"{run.station.driver.error}; {run.describe()}")
        run.station.driver.recover()
        run.clock.begin()
        run.pose = run["pose"].copy()
        run.resume()
        check("cleared", run["arm_state"][0] == ArmState.RUNNING, run.describe())
    return failures


if __name__ == "__main__":
    sys.exit(bool(run_checks()))
