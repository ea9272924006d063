"""Pre-flight checks, printed and confirmed before a robot moves, and slow motions to and from a skill's start."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context

from guiderail.models.common.errors import InputError
from guiderail.models.common.transforms import DEGREE, MM, pose_difference
from guiderail_hardware.drivers.clock import Clock
from guiderail_hardware.drivers.driver import Check, PoseDriver
from guiderail_hardware.models.joint_status import check_content
from guiderail_hardware.robot.operator import confirm
from guiderail_hardware.station import HardwareStation

SPEED, ANGULAR_SPEED = 0.02, 0.1  # speeds of a slow approach [m/s], [rad/s]
# Minimum speeds of the motion back [m/s], [rad/s]. A slower motion is repeated at less than twice these speeds, which
# does not exceed the speeds of a slow approach.
MIN_SPEED, MIN_ANGULAR_SPEED = 0.5 * SPEED, 0.5 * ANGULAR_SPEED
POSITION_TOLERANCE, ANGLE_TOLERANCE = 3.0 * MM, 2.0 * DEGREE  # tolerances of a reached pose [m], [rad]
SETTLING_TIME = 0.5  # time that the target is held at the end of an approach [s]
MAX_DISTANCE, MAX_ANGLE = 0.15, 1.0  # largest distance and angle from the start pose for an approach [m], [rad]
MAX_JOINT_SPEED = 0.05  # largest joint speed of an arm at rest [rad/s]
MAX_FORCE = 5.0  # max. external force at rest with the payload configured [N]
MAX_RESTS = 3  # maximum number of damping times to wait for if commands cannot be sent
NUM_STATUSES = 20  # number of statuses to receive before the checks
MARKS = {True: "ok  ", False: "NOT ", None: "read"}  # line marks; the operator checks lines marked `read`


def pose_distance(a: np.ndarray, b: np.ndarray) -> tuple[float, float]:
    """Return the distance of two poses (6,) [m], and the largest difference of an angle [rad]."""
    change = pose_difference(a, b)
    return float(np.linalg.norm(change[:3])), float(np.abs(change[3:]).max())


def is_near(a: np.ndarray, b: np.ndarray) -> bool:
    """Return True if two poses (6,) are equal within the tolerances of a reached pose."""
    distance, angle = pose_distance(a, b)
    return distance <= POSITION_TOLERANCE and angle <= ANGLE_TOLERANCE


def describe_distance(pose: np.ndarray, start: np.ndarray) -> str:
    """Return a message about an arm at `pose` (6,) that did not reach `start` (6,)."""
    distance, angle = pose_distance(pose, start)
    return f"the arm did not reach the start: {distance / MM:.1f} mm and {np.rad2deg(angle):.1f} degrees are left"


def slow_approach(pose: np.ndarray, target: np.ndarray, period: float) -> np.ndarray:
    """Return commands (n, 6) along a straight line from `pose` (6,) to `target` (6,).

    The speeds are at most `SPEED` and `ANGULAR_SPEED`. At the end, the target is held for `SETTLING_TIME`. The time
    between commands is `period` [s].
    """
    distance, angle = pose_distance(target, pose)
    num_moving = int(np.ceil(max(distance / SPEED, angle / ANGULAR_SPEED) / period)) or 1
    steps = np.arange(1, num_moving + round(SETTLING_TIME / period))
    return pose + np.minimum(steps / num_moving, 1.0)[:, None] * pose_difference(target, pose)


def retrace(path: np.ndarray, period: float) -> list[np.ndarray]:
    """Return commands backwards along poses (n, 6), at the recorded speed or the minimum speeds, if these are higher.

    The time between poses is `period` [s]. A pose is skipped if its distance from the last command is below `MIN_SPEED`
    times the period, and its angle below `MIN_ANGULAR_SPEED` times the period. The first pose of `path` is never
    skipped.
    """
    poses: list[np.ndarray] = []
    for pose in path[::-1]:
        distance, angle = pose_distance(pose, poses[-1]) if poses else (np.inf, np.inf)
        if distance >= MIN_SPEED * period or angle >= MIN_ANGULAR_SPEED * period:
            poses.append(pose.copy())
    if len(path):
        poses.append(path[0].copy())
    return poses


class PreflightChecks:
    """Pre-flight checks of a station that receives statuses and sends nothing.

    Attributes:
        driver: Driver of the robot.
        simulator: Simulator of the station, with the newest status.
    """

    def __init__(
        self,
        station: HardwareStation,
        clock: Clock,
        start: np.ndarray,
        num_steps: int,
        max_wrench: np.ndarray | None = None,
    ):
        """Receive the first statuses.

        Args:
            station: Station that controls the arm after the checks.
            clock: Clock of the station.
            start: Pose at which a skill starts, (6,).
            num_steps: Number of status periods of a control step.
            max_wrench: Largest wrench of the station, (8,), or None.

        Raises:
            InputError: If no robot answers, or its statuses cannot be read.
        """
        self._station, self._clock, self._start, self._num_steps = station, clock, start, num_steps
        self._max_wrench, self.driver = max_wrench, station.driver
        self.simulator = start_simulator(station, clock, max_wrench)
        self._commands_before = self.driver.num_foreign_commands
        self._receive_statuses()

    @property
    def error(self) -> str:
        """Reason of an earlier stop by the robot itself; empty without a stop, or if the reason is unknown."""
        return self.driver.guard.error

    def clear_error(self) -> None:
        """Clear the robot's error and receive new statuses; the arm does not move.

        Raises:
            InputError: If the error persists.
        """
        self.driver.guard.recover()
        self.repeat()

    def run(self) -> list[Check]:
        """Return the checks on the newest status."""
        num_commands = self.driver.num_foreign_commands - self._commands_before
        return check_robot(self._station, self.simulator.get_context(), self._start, num_commands)

    def repeat(self) -> list[Check]:
        """Receive new statuses after a pause in which none were received, and repeat the checks.

        Raises:
            InputError: If no statuses arrive, or they cannot be read.
        """
        self._clock.begin()
        self._clock.advance(self.simulator, self._station, self._num_steps)
        # A new simulator accepts the arm's position at once, even if it was moved by hand in the meantime.
        self.simulator = start_simulator(self._station, self._clock, self._max_wrench)
        self._receive_statuses()
        return self.run()

    def _receive_statuses(self) -> None:
        """Receive `NUM_STATUSES`, enough for a safety monitor's first heartbeat to arrive; no command is sent.

        Raises:
            InputError: If no statuses arrive, reading the driver raises an exception, or the newest status is malformed
                although the robot reports no error.
        """
        driver, before = self.driver, self.driver.num_statuses
        self._clock.advance(self.simulator, self._station, NUM_STATUSES)
        if driver.num_statuses == before:
            raise InputError(f"statuses stopped arriving on {driver}: start its driver again")
        driver.guard.check_readable()
        fault = check_content(driver.guard.read(), self._station.robot.num_joints)
        if fault and not self.error:
            raise InputError(f"the arm stays where it is: {fault.description}: check the driver {driver.name}")


def make_holding_simulator(station: HardwareStation, max_wrench: np.ndarray | None) -> Simulator:
    """Return a simulator of a station that holds the arm where it is; the desired pose is NaN.

    The arguments are those of `start_simulator`.
    """
    simulator = Simulator(station)
    station.get_desired_pose_input_port().FixValue(simulator.get_mutable_context(), np.full(6, np.nan))
    if max_wrench is not None:
        station.GetInputPort("max_wrench").FixValue(simulator.get_mutable_context(), max_wrench)
    return simulator


def start_simulator(station: HardwareStation, clock: Clock, max_wrench: np.ndarray | None) -> Simulator:
    """Return a started simulator of a station that holds the arm where it is.

    `max_wrench` (8,) is the value of the station's input port of this name; None leaves the port unconnected.

    Raises:
        InputError: If no robot answers, or reading the driver raises an exception.
    """
    simulator = make_holding_simulator(station, max_wrench)
    station.start(simulator, clock.check_robot)
    clock.begin()
    return simulator


def advance_to_rest(clock: Clock, simulator: Simulator, station: HardwareStation) -> str:
    """Advance a stopped station until the arm is damped and its torque is zero; repeat if commands cannot be sent.

    Returns:
        A message about commands that could not be sent, or an empty text.
    """
    guard = station.driver.guard
    first = guard.num_failed_commands
    for _ in range(MAX_RESTS):
        before = guard.num_failed_commands
        clock.advance(simulator, station, round((station.limits.damping_time + 0.1) / station.period))
        if guard.num_failed_commands == before:
            break
    failed = guard.num_failed_commands - first
    return f"{failed} commands that bring the arm to rest could not be sent: {guard.command_error}" * (failed > 0)


def check_robot(station: HardwareStation, context: Context, start: np.ndarray, num_commands: int) -> list[Check]:
    """Check the status of a robot in the root context of its station, and list the assumptions about the robot.

    `start` (6,) is the start pose of the skill. `num_commands` is the number of commands that the robot has received
    from other programs since the checks were constructed.
    """
    plant, arm = station.controller_plant.plant, station.controller_plant.arm
    driver, limits = station.driver, station.limits
    pose = station.get_pose_output_port().Eval(context)
    distance, angle = pose_distance(pose, start)
    positions, velocities, external_torque = (
        station.GetOutputPort(f"{driver.name}.{signal}").Eval(context)
        for signal in ("position_measured", "velocity_estimated", "torque_external")
    )
    force = float(np.linalg.norm(station.estimate_force(positions, external_torque)))
    fastest = float(np.abs(velocities).max())
    p_WT = arm.target.CalcPoseInWorld(plant.CreateDefaultContext()).translation()
    lower, upper = plant.GetPositionLowerLimits(), plant.GetPositionUpperLimits()
    payload = sum(body.default_mass() for body in arm.tool)
    torque_shares, axis_limits = station.max_torque_shares(positions), station.impedance.limits[:3]
    if isinstance(driver, PoseDriver):
        # The torques of the robot's own impedance controller are not clipped; limits of external torque stop the arm.
        torque_share = (torque_shares * np.divide(limits.torque, limits.external_torque)).max()
        torques = f"stopped at external torques of {_numbers(limits.external_torque, 1)} Nm"
        hint = "; above 100% a firm push stops the arm: choose a smaller force_limit"
        payload_set_by = "this program configures"
    else:
        torque_share, torques, hint = torque_shares.max(), f"at most {_numbers(limits.torque, 1)} Nm sent", ""
        payload_set_by = "must be configured on the robot"
    has_monitor = station.has_safety_monitor(context)
    round_trip = f"at most {1e3 * station.status_limits.max_round_trip:.1f} ms, "
    if isinstance(driver, PoseDriver):
        round_trip = "not measured: the robot's own program runs the impedance"
    elif has_monitor:
        round_trip += "measured while the controller takes over, before the arm moves"
    else:
        round_trip += "not measured, because no safety monitor reports commands: measure it"
    if driver.has_command_timeout:
        monitor = "not needed: this driver stops the arm when commands stop"
    elif has_monitor:
        monitor = "its heartbeat is received"
    else:
        monitor = "no heartbeat: start guiderail safety-monitor on the driver's machine"
    return [
        Check("robot", f"{station.robot.name}, {len(positions)} joints, {driver}", True),
        Check("monitor", monitor, driver.has_command_timeout or has_monitor),
        Check("round trip", round_trip),
        Check(
            "joints",
            f"{np.rad2deg(positions).round(1).tolist()} degrees",
            bool((lower < positions).all() and (positions < upper).all()),
        ),
        Check(
            "commands",
            "another program commands the robot: end it, or wait until the safety monitor has brought the arm to rest"
            if num_commands
            else "no other program commands the robot",
            not num_commands,
        ),
        Check("standstill", f"fastest joint {fastest:.3f} rad/s", fastest < MAX_JOINT_SPEED),
        Check("payload", f"{payload:.2f} kg on the flange, which {payload_set_by}"),
        Check("load", f"{force:.1f} N of external force at rest", force < MAX_FORCE),
        Check("target", f"at {_numbers(p_WT)} m in the base frame"),
        Check(
            "tool",
            f"at {_numbers(pose[:3] / MM, 1)} mm from the target, turned about z, y, x by "
            f"{_numbers(np.rad2deg(pose[3:]), 1)} degrees",
        ),
        Check(
            "start",
            f"{distance / MM:.0f} mm and {np.rad2deg(angle):.0f} degrees away",
            distance < MAX_DISTANCE and angle < MAX_ANGLE,
        ),
        Check(
            "force",
            f"at most {max(axis_limits):.0f} N commanded along an axis, {np.linalg.norm(axis_limits):.0f} N in all "
            f"three, {limits.force:.0f} N measured",
        ),
        Check(
            "torques",
            f"{torques}; the full force takes {torque_share:.0%} of the nearest limit{hint}",
        ),
        Check("workspace", f"from {_numbers(limits.lower)} to {_numbers(limits.upper)} m around the target"),
        *driver.guard.call_at_rest("check_setup"),
    ]


def confirm_checks(checks: PreflightChecks, log: Callable[[str], None], *, assume_yes: bool) -> list[Check]:
    """Log the checks, ask the operator to confirm them, and repeat them, because the robot may have changed meanwhile.

    If the robot reports an error, such as a reflex, the error is first cleared if the operator agrees. With
    `assume_yes`, no question is asked, and the checks are not repeated.

    Returns:
        The logged checks.

    Raises:
        InputError: If a check fails, before or after the question, the operator does not confirm, or the robot has an
            error and `assume_yes` is set.
    """
    if error := checks.error:
        if assume_yes:
            raise InputError(f"the robot reports {error}: look at it, and start again without --yes")
        confirm(f"The robot reports {error}. Clear the error? The arm does not move.")
        checks.clear_error()
    results = checks.run()
    for check in results:
        log(f"{MARKS[check.passed]}  {check.name:<12}{check.description}")
    _refuse_failed(results)
    if not assume_yes:
        confirm("Are all of these lines right, and is the workspace clear?")
        _refuse_failed(checks.repeat())
    return results


def _numbers(values: Sequence[float] | np.ndarray, digits: int = 3) -> str:
    return f"({', '.join(f'{round(float(value), digits) + 0.0:.{digits}f}' for value in values)})"


def _refuse_failed(checks: Sequence[Check]) -> None:
    failed = [check for check in checks if check.passed is not None and not check.passed]
    if failed:
        raise InputError(f"the arm stays where it is: {failed[0].name}: {failed[0].description}")
