"""Interface of robot drivers: joint states as input and joint torques as output, independent of message types."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from numbers import Real
from typing import ClassVar

import numpy as np
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant

from guiderail.diagrams.stations.station import CONTROL_PERIOD
from guiderail.models.common.errors import InputError
from guiderail.models.common.registry import Registry, check_class
from guiderail.models.robots.mounting import add_robot
from guiderail.models.robots.robot import Robot, find_robot
from guiderail_hardware.drivers.driver_guard import ERRORS, DriverGuard
from guiderail_hardware.models.joint_status import Fault, Heartbeat, JointStatus, StatusLimits
from guiderail_hardware.models.motion_limits import MotionLimits
from guiderail_hardware.models.robot_impedance import RobotImpedance
from guiderail_hardware.systems.torque_safety_limiter import SafetyLimits

STATUS_PERIOD = CONTROL_PERIOD / 4  # period of Drake's drivers [s], 5 ms; a control period is an exact multiple
POLL_PERIOD = 2e-4  # pause between two reads of a driver that cannot wait [s]

# Limits of the commanded and the external torque as shares of the driver's reflex limits, and limit of the joint
# velocity as a share of its maximum.
TORQUE_SHARE, EXTERNAL_TORQUE_SHARE, VELOCITY_SHARE = 0.9, 0.8, 0.8
TORQUE_TOLERANCE_SHARE = 0.02  # largest error of a joint torque by friction, gravity and sensor, relative to its limit

MAX_DIFFERENCE = 0.02  # largest difference between entries of the flange's pose of two equal robots [m, 1]

CommandCallback = Callable[[np.ndarray, float], None]


@dataclass(frozen=True)
class Check:
    """Result of one pre-flight check."""

    name: str  # name of the check
    description: str  # measured values, or an assumption that the operator has to check
    passed: bool | None = None  # False if the arm must not move; None if nothing is checked


class Driver(ABC):
    """Connection to the program that drives a robot with joint torque control.

    A driver of another robot or transport implements `read` and `write` and is registered with `register_driver`. If
    the robot's program repeats the last torque when commands stop, a `SafetyMonitor` is needed, and the driver also
    implements `add_listener`, `read_heartbeats` and `write_heartbeat`. If the robot can brake or hold its position by
    itself, the driver sets `can_hold` and implements `hold`.

    Attributes:
        url: Address that the connection was opened with; empty for the default.
        num_statuses: Number of different statuses received. A repeated status counts once. A malformed status without a
            time counts whenever it is received, because it shows that the robot answers.
        num_foreign_commands: Number of commands of other programs to the robot, without the commands of a safety
            monitor that stops the arm.
    """

    name: ClassVar[str]  # prefix of the joint ports of a hardware station, as in Drake's own stations
    # Name of the registered robot that the driver moves; the robot of a station must have the same joints and
    # kinematics. Empty for a driver of any robot with as many joints as `torque_reflex_limits`.
    robot: ClassVar[str] = ""
    # External torques at which the robot stops by itself under torque control, (n,) [Nm].
    torque_reflex_limits: ClassVar[tuple[float, ...]]
    has_command_timeout: ClassVar[bool]  # True if the driver brings the arm to rest when commands stop
    # True if `hold` is implemented: the robot then brakes or holds its position without a status or torques.
    can_hold: ClassVar[bool] = False
    # Time after its first status during which the driver must not receive commands [s].
    hold_off: ClassVar[float] = 0.25
    period: ClassVar[float] = STATUS_PERIOD  # period of statuses and commands [s]

    def __init__(self, url: str = ""):
        self.url = url
        self.num_statuses = self.num_foreign_commands = 0
        self._last_time = np.nan

    @cached_property
    def guard(self) -> DriverGuard:
        """Guard by which stations and monitors call this driver."""
        return DriverGuard(self)

    @abstractmethod
    def read(self) -> JointStatus | None:
        """Return the newest status, or None before the first."""

    @abstractmethod
    def write(self, torque: np.ndarray, time: float) -> None:
        """Send joint torques (n,) [Nm]; `time` is the time of the command [s]."""

    def hold(self) -> bool | None:
        """Brake the arm or hold its position, until torques are written again.

        If the robot refuses, return False: the arm is then damped by torques instead.

        Raises:
            InputError: If the driver cannot hold the arm; see `can_hold`.
        """
        raise InputError(f"the driver {self.name} can't hold the arm by itself")

    @property
    def error(self) -> str:
        """Reason why the robot stopped by itself; empty if it did not stop or the reason is unknown."""
        return ""

    def receive(self, timeout: float = 0.0) -> None:
        """Receive the messages that have arrived; if no status is new, wait at most `timeout` [s] for one."""
        end = time.monotonic() + timeout
        while True:
            status = self.read()
            if status is not None and status.time != self._last_time:
                self.num_statuses, self._last_time = self.num_statuses + 1, status.time
                return
            if time.monotonic() >= end:
                return
            time.sleep(POLL_PERIOD)

    def recover(self) -> None:  # noqa: B027 (optional hook)
        """Clear an error of the robot after the user has confirmed; the arm does not move.

        Raises:
            InputError: If the error persists.
        """

    def check_setup(self) -> list[Check]:
        """Return checks of the robot's configuration before the first motion; nothing is sent."""
        return []

    def check_usable(self) -> None:  # noqa: B027 (optional hook)
        """Raise `InputError` if the connection cannot receive in this environment."""

    def add_listener(self, on_command: CommandCallback) -> None:
        """Register a callback for the torques (n,) [Nm] and time [s] of each command that another program sends.

        Raises:
            InputError: If the driver cannot read the commands of other programs.
        """
        raise InputError(f"the driver {self.name} cannot be watched by a safety monitor")

    def read_heartbeats(self) -> tuple[Heartbeat, ...]:
        """Return the newest heartbeat of each safety monitor, at most `MAX_SENDERS`."""
        return ()

    def write_heartbeat(self, heartbeat: Heartbeat) -> None:
        """Send a heartbeat of the safety monitor.

        Raises:
            InputError: If the driver transports no heartbeats.
        """
        raise InputError(f"the driver {self.name} transports no heartbeat of a safety monitor")

    def __str__(self) -> str:
        """Return the address at which the robot is reached, for messages."""
        return self.url or self.name


class PoseDriver(Driver):
    """Connection to a robot whose own program runs the impedance controller and follows desired poses.

    A driver implements `read`, `configure`, `write_pose` and `stop`, and `recover` if its robot has errors.
    """

    motion_limits: ClassVar[MotionLimits]  # limits of the desired poses that the robot accepts
    # True if the robot's wrench is K e − D V with the `RobotImpedance`. The station then sends the reference with which
    # this wrench is the station's, so that the approach speed is limited; see `SpringReference`.
    is_spring_and_damper: ClassVar[bool] = False

    @abstractmethod
    def configure(self, impedance: RobotImpedance) -> None:
        """Set the impedance, tool and payload before the first pose."""

    @abstractmethod
    def write_pose(self, X_BaseTool: RigidTransform, time: float) -> None:
        """Send the desired pose of the tool center in the robot's base frame; `time` is the time of the command [s]."""

    @abstractmethod
    def stop(self) -> None:
        """Bring the arm to rest by the robot's own means; repeated calls have no effect."""

    def write(self, torque: np.ndarray, time: float) -> None:
        """Raise an `InputError`, because the robot accepts poses instead of torques."""
        raise InputError(f"the driver {self.name} accepts poses, not torques")


DRIVERS: Registry[type[Driver]] = Registry(
    "driver of a robot",
    plugin="driver",
    check=lambda name, driver: check_class(name, driver, Driver),
)
"""Driver classes by name: name of a robot for its default driver, otherwise name of an interface, such as "fci"."""

register_driver = DRIVERS.register


def describe_stop(fault: Fault, driver: Driver) -> str:
    """Return the reason of a stop in words, with the robot's own error or the driver's exception if there is one."""
    cause = driver.guard.describe(fault)
    return f"{fault.description} ({cause})" if cause else fault.description


def find_driver(robot: Robot | str) -> type[Driver]:
    """Return the default driver class of a robot, or the driver class with a name.

    Raises:
        InputError: If no driver has this name, or the name of the robot.
    """
    return DRIVERS.get(robot if isinstance(robot, str) else robot.name)


def open_driver(driver: Robot | str, url: str) -> Driver:
    """Return a connection at `url` by the default driver of a robot, or by the driver with a name.

    Raises:
        InputError: If there is no such driver, it cannot be opened at `url`, or it is incomplete (`check_driver`).
    """
    name = driver if isinstance(driver, str) else driver.name
    try:
        opened = find_driver(driver)(url)
    except InputError:
        raise
    except ERRORS as error:
        message = " ".join(str(error).split())
        raise InputError(f"the driver {name} can't be opened: {type(error).__name__}: {message}") from error
    if not isinstance(opened, Driver):
        raise InputError(f"the driver {name} is no Driver: register a class that is derived from Driver")
    check_driver(opened)
    return opened


def check_driver(driver: Driver) -> None:
    """Check that a driver has the attributes that a station needs.

    Raises:
        InputError: If an attribute is missing, has another type, or a limit or time is out of range.
    """
    limits = getattr(driver, "torque_reflex_limits", None)
    has_limits = isinstance(limits, Sequence) and bool(limits) and all(map(_is_positive, limits))
    for attribute, is_valid, description in (
        ("name", isinstance(getattr(driver, "name", None), str) and bool(driver.name), "a text"),
        ("torque_reflex_limits", has_limits, "a positive number of each joint [Nm]"),
        ("has_command_timeout", isinstance(getattr(driver, "has_command_timeout", None), bool), "True or False"),
        ("period", _is_positive(driver.period), "a positive time [s]"),
        ("hold_off", driver.hold_off == 0.0 or _is_positive(driver.hold_off), "a time that is not negative [s]"),
    ):
        if not is_valid:
            raise InputError(f"the driver {type(driver).__name__} needs {description} as its {attribute}")
    if not hasattr(driver, "num_statuses"):
        raise InputError(f"the driver {type(driver).__name__} must call super().__init__(url) in its constructor")


def _is_positive(value: object) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool) and 0.0 < float(value) < np.inf


def check_robot(driver: Driver, robot: Robot) -> None:
    """Check that a robot has the joints and the kinematics of the robot that a driver moves.

    Joints are compared by the motion of the flange in the base frame when a single joint is turned. A `PoseDriver`
    commands poses relative to flange and base, so the flange's pose in the world is then compared as well.

    Raises:
        InputError: If they differ, or there is no registered robot `Driver.robot`.
    """
    num_joints = len(driver.torque_reflex_limits)
    if robot.num_joints != num_joints:
        raise InputError(
            f"robot={robot.name!r} has {robot.num_joints} joints, and {type(driver).__name__} moves an arm of "
            f"{num_joints}: name the arm that is connected, and its driver"
        )
    if not driver.robot or robot is (own := find_robot(driver.robot)):
        return
    (flange, motions), (own_flange, own_motions) = (_calc_motions(one) for one in (robot, own))
    pairs = list(zip(motions, own_motions, strict=True))
    if isinstance(driver, PoseDriver):
        pairs.append((flange, own_flange))
    if not all(one.IsNearlyEqualTo(other, MAX_DIFFERENCE) for one, other in pairs):
        raise InputError(
            f"robot={robot.name!r} has other joints, or another flange or base, than {own.name!r}, the arm of "
            f"{type(driver).__name__}: name the arm that is connected, and its driver"
        )


def _calc_motions(robot: Robot) -> tuple[RigidTransform, list[RigidTransform]]:
    """Return the flange's pose in the world at zero positions, and its motion in the base frame by 1 rad per joint."""
    plant = MultibodyPlant(0.0)
    mounted = add_robot(plant, robot)
    plant.Finalize()
    context = plant.CreateDefaultContext()

    def pose(positions: np.ndarray) -> RigidTransform:
        plant.SetPositions(context, positions)
        return mounted.flange.CalcPose(context, mounted.base)

    n = plant.num_positions()
    at_zero = pose(np.zeros(n))
    in_world = mounted.flange.CalcPoseInWorld(context)
    return in_world, [pose(positions) @ at_zero.inverse() for positions in np.eye(n)]


def safety_limits(plant: MultibodyPlant, driver: Driver | type[Driver]) -> SafetyLimits:
    """Return limits of the arm below the driver's reflex limits and within the limits of the controller plant."""
    reflex_limits = np.array(driver.torque_reflex_limits)
    return SafetyLimits(
        velocity=tuple((VELOCITY_SHARE * plant.GetVelocityUpperLimits()).tolist()),
        torque=tuple(np.minimum(TORQUE_SHARE * reflex_limits, plant.GetEffortUpperLimits()).tolist()),
        external_torque=tuple((EXTERNAL_TORQUE_SHARE * reflex_limits).tolist()),
    )


def status_limits(plant: MultibodyPlant, driver: Driver | type[Driver], period: float | None = None) -> StatusLimits:
    """Return the limits of a driver's statuses; the period of the checks [s] is the driver's by default."""
    velocity = plant.GetVelocityUpperLimits().tolist()
    return StatusLimits.at_rate(velocity, period or driver.period, settling_time=driver.hold_off)


def torque_tolerance(limits: SafetyLimits) -> tuple[float, ...]:
    """Return the largest error of each joint torque that is tolerated in a status, (n,) [Nm]."""
    return tuple(TORQUE_TOLERANCE_SHARE * torque for torque in limits.torque)
