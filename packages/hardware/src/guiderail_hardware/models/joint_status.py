"""Joint status of a robot arm: messages, plausibility checks, fault codes and damping torques."""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from guiderail.models.common.errors import InputError

MAX_SENDERS = 8  # largest number of safety monitors whose heartbeats are distinguished
HOLD_TIME = 0.05  # time in which a driver that holds the arm must halve its speed [s]
HELD_SPEED = 0.05  # joint speed below which a driver holds the arm [rad/s]
MAX_MISSED_MESSAGES = 6  # number of periods without a status message after which the arm is stopped


def damping_torque(M: np.ndarray, v: np.ndarray, decay_time: float, *, period: float) -> np.ndarray:
    """Compute the torque that damps all joint velocities with one decay time.

        τ = −M(q) v (1 − exp(−h / T)) / h

    If the torque τ (n,) [Nm] is constant for a period h [s], it multiplies the joint velocities v (n,) [rad/s] by
    exp(−h / T). M (n, n) is the mass matrix, and T the decay time [s].
    """
    return (M @ v) * (np.expm1(-period / decay_time) / period)


def is_hold_ineffective(speed: float, initial_speed: float, elapsed: float) -> bool:
    """Return True if an arm that its driver should hold still moves.

    After `HOLD_TIME`, the speed must be below half of the initial one or `HELD_SPEED`.

    Args:
        speed: Largest reported joint speed [rad/s]; NaN if it is unknown, for which the result is False.
        initial_speed: Largest joint speed when the driver was asked to hold the arm [rad/s].
        elapsed: Time since then [s].
    """
    return elapsed >= HOLD_TIME and speed > max(0.5 * initial_speed, HELD_SPEED)


class Fault(IntEnum):
    """Reason for stopping the arm; the codes are not ordered by priority.

    Attributes:
        description: Description of the fault for messages.
    """

    description: str

    def __new__(cls, code: int, description: str = "") -> "Fault":
        """Return a member with a code and a description."""
        fault = int.__new__(cls, code)
        fault._value_, fault.description = code, description
        return fault

    NONE = 0, "no fault"
    NO_STATUS = 1, "no status message received, or too few"
    STALE = 2, "the newest status message is too old: the robot, the network or this machine is late or has stopped"
    OUT_OF_ORDER = 3, "a status message is much older than its predecessor: the robot's clock was set back"
    FUTURE = 4, "a status message is in the future: the robot's clock has jumped"
    MALFORMED = 5, "the robot reports an error, or a status message cannot be decoded"
    WRONG_SIZE = 6, "a status message has the wrong number of joints"
    NOT_FINITE = 7, "a status message contains NaN or infinity"
    CONFLICT = 8, "status messages contradict each other: a second robot on the channel, or a frozen clock"
    POSITION_JUMP = 9, "a joint position changed faster than the joint can move"
    VELOCITY_JUMP = 10, "a joint velocity changed faster than the joint can accelerate"
    FROZEN = 11, "a joint is moving, but its position or velocity does not change"
    INCONSISTENT = 12, "a joint position does not change as the joint velocity requires"
    NOT_REACTING = 13, "a joint velocity does not change as the joint torques require"
    CLOCK_RATE = 14, "the robot's clock is faster than this machine's"
    VELOCITY_LIMIT = 15, "a joint exceeds its velocity limit"
    WORKSPACE_LIMIT = 16, "the tool or its commanded pose is outside the workspace"
    FORCE_LIMIT = 17, "the force on the tool exceeds its limit"
    EXTERNAL_TORQUE_LIMIT = 18, "an external joint torque exceeds its limit"
    TORQUE_NOT_FINITE = 19, "a commanded torque is NaN or infinite"
    USER_STOP = 20, "stop requested by the user"
    DEADLINE_MISSED = 21, "the controller missed its deadline and sent no command in time"
    MONITOR_STOP = 22, "a safety monitor stopped the arm, or its heartbeat timed out"
    SECOND_COMMANDER = 23, "another program commands the arm as well"
    INITIALIZED = 24, "the simulation was initialized while it controlled the arm"
    COMMAND_FAILED = 25, "a command could not be sent to the robot"
    ROUND_TRIP = 26, "commands or statuses are later than the impedance tolerates: a constant delay on the network"


STATUS_FAULTS = (*(fault for fault in Fault if Fault.NONE < fault <= Fault.CLOCK_RATE), Fault.ROUND_TRIP)
"""Faults after which the robot's state is uncertain."""


@dataclass(frozen=True)
class JointStatus:
    """Decoded status message of a robot driver; `parse_status` and `check_status` check types, sizes and values."""

    time: float  # time stamp by the robot's clock [s]; NaN if the message could not be decoded
    positions: np.ndarray  # joint positions, (n,) [rad]
    velocities: np.ndarray  # joint velocities, (n,) [rad/s]
    external_torque: np.ndarray  # external joint torques, (n,) [Nm]
    conflicts: int = 0  # number of messages so far that contradict their predecessors, as with two robots on a channel
    foreign_commands: int = 0  # number of commands so far that cannot be from the program that commands the arm
    round_trip: float = np.nan  # time from a command to the report of its arrival [s]; NaN if it is unknown

    def __deepcopy__(self, memo: object) -> "JointStatus":
        """Return the same immutable object, because Drake copies abstract values often."""
        return self

    @property
    def is_readable(self) -> bool:
        """True if the message could be decoded."""
        return bool(np.isfinite(self.time))

    def values(self) -> np.ndarray:
        """Return positions, velocities and external torques as one vector, (3n,)."""
        return np.concatenate([self.positions, self.velocities, self.external_torque])


@dataclass(frozen=True)
class Heartbeat:
    """Heartbeat message of a robot-side safety monitor, sent at each of its checks."""

    sequence: int  # sequence number, larger in each message
    is_stopping: bool  # True while the monitor stops the arm
    sender: int = 0  # random number of the monitor's process
    command: int = -1  # time stamp of the newest command that has arrived [µs]; −1 if unknown

    def __deepcopy__(self, memo: object) -> "Heartbeat":
        """Return the same immutable object."""
        return self


MALFORMED_STATUS = JointStatus(np.nan, np.empty(0), np.empty(0), np.empty(0))
"""Status for a message that could not be decoded."""


def parse_status(value: object) -> JointStatus | None:
    """Return a driver's status with copies of its arrays as floats; None if there is no status.

    A status is malformed (`MALFORMED_STATUS`) if it is of another type, or if one of its values is not a real number,
    such as text, None or a complex number. Neither sizes nor finiteness of positions, velocities and torques are
    checked.
    """
    if value is None:
        return None
    if not isinstance(value, JointStatus):
        return MALFORMED_STATUS
    try:
        scalars = [
            _to_numbers(number) for number in (value.time, value.conflicts, value.foreign_commands, value.round_trip)
        ]
        if any(scalar.ndim for scalar in scalars):
            return MALFORMED_STATUS
        return JointStatus(
            float(scalars[0]),
            _to_numbers(value.positions),
            _to_numbers(value.velocities),
            _to_numbers(value.external_torque),
            int(scalars[1]),
            int(scalars[2]),
            float(scalars[3]),
        )
    except Exception:  # objects of a driver can raise any error
        return MALFORMED_STATUS


def _to_numbers(value: object) -> np.ndarray:
    """Return a new array of floats; raise a TypeError if a value is not a real number."""
    array = np.array(value)
    if array.dtype.kind not in "iuf":
        raise TypeError(f"{array.dtype} is not a type of real numbers")
    return array.astype(float)


@dataclass(frozen=True)
class StatusLimits:
    """Plausibility limits of status messages, finite and positive; settling time and clock drift may be zero.

    Raises:
        InputError: If a limit is out of range, or there is no joint.
    """

    velocity: tuple[float, ...]  # velocity limit of each joint, which bounds the change of its position (n,) [rad/s]
    max_age: float = 0.03  # age above which a status is stale [s]; until then messages may be lost or reordered
    max_lead: float = 0.03  # largest time by which a status may be ahead of the local clock [s]
    position_jump: float = 0.02  # largest position change beyond `velocity` times the time between two messages [rad]
    velocity_jump: float = 1.5  # largest velocity change between two messages [rad/s]; a collision causes up to 1 rad/s
    position_tolerance: float = 1e-3  # largest difference between positions and integrated velocities [rad]
    velocity_noise: float = 0.02  # largest error of a velocity [rad/s]
    # Time for which messages must have been valid before they are used [s]. A driver that has just started accepts no
    # commands during this time.
    settling_time: float = 0.25
    clock_drift: float = 1e-3  # largest drift between the two clocks [s/s]; a slower drift is no fault
    max_check_interval: float = 0.03  # largest wall-clock time between two checks before a deadline is missed [s]
    max_round_trip: float = np.inf  # longest round trip that the impedance tolerates (`max_round_trip`) [s]

    def __post_init__(self) -> None:
        positive = (*self.velocity, self.max_age, self.max_lead, self.position_jump, self.velocity_jump)
        positive += (self.max_check_interval, self.position_tolerance, self.velocity_noise)
        if not self.velocity or not all(0.0 < value < np.inf for value in positive):
            raise InputError("the limits of a robot's status must be positive")
        if not self.max_round_trip > 0.0:
            raise InputError(f"the longest round trip of a robot must be positive, not {self.max_round_trip} s")
        if not all(0.0 <= value < np.inf for value in (self.settling_time, self.clock_drift)):
            raise InputError("a robot's settling time and its clock's drift must be finite and not negative")

    @classmethod
    def at_rate(cls, velocity: Sequence[float], period: float, **others: float) -> "StatusLimits":
        """Return limits for a driver that sends a status every `period` [s].

        `max_age`, `max_lead` and `max_check_interval` are `MAX_MISSED_MESSAGES` periods. `velocity` are the velocity
        limits of the joints, (n,) [rad/s]. `others` are further limits by name.

        Raises:
            InputError: If a limit is out of range, or there is no joint.
        """
        timeout = MAX_MISSED_MESSAGES * period
        return cls(tuple(velocity), max_age=timeout, max_lead=timeout, max_check_interval=timeout, **others)


@dataclass(frozen=True)
class LastStatus:
    """Last readable status, with which the next one is compared."""

    time: float  # time stamp by the robot's clock [s]; NaN before the first status
    offset: float  # offset from the robot's clock to the local clock [s]
    values: np.ndarray  # `JointStatus.values`, (3n,)


def check_content(status: JointStatus | None, num_joints: int) -> Fault:
    """Check sizes and finiteness of a result of `parse_status`; None before the first message.

    Returns:
        The first fault, or `Fault.NONE`.
    """
    if status is None:
        return Fault.NO_STATUS
    if not status.is_readable:
        return Fault.MALFORMED
    if {part.shape for part in (status.positions, status.velocities, status.external_torque)} != {(num_joints,)}:
        return Fault.WRONG_SIZE
    return Fault.NONE if np.isfinite(status.values()).all() else Fault.NOT_FINITE


def check_status(status: JointStatus | None, last: LastStatus, now: float, limits: StatusLimits) -> Fault:
    """Check a result of `parse_status` (None before the first message) against the last one at the time `now` [s].

    Returns:
        The first fault, or `Fault.NONE`; the faults of `check_content` come first.
    """
    num_joints = len(limits.velocity)
    fault = check_content(status, num_joints)
    if status is None or fault:
        return fault
    values = status.values()
    if not np.isfinite(last.time):
        return Fault.NONE
    if last.time - status.time > limits.max_age:
        return Fault.OUT_OF_ORDER
    age = now - (status.time + last.offset)
    if age < -limits.max_lead:
        return Fault.FUTURE
    if age > limits.max_age:
        return Fault.STALE
    if status.time <= last.time:
        return Fault.NONE  # a repeated or reordered message, which is dropped
    elapsed = status.time - last.time
    change = np.abs(values - last.values)
    reachable = limits.position_jump + np.array(limits.velocity) * elapsed
    if (change[:num_joints] > reachable).any():
        return Fault.POSITION_JUMP
    if (change[num_joints : 2 * num_joints] > limits.velocity_jump).any():
        return Fault.VELOCITY_JUMP
    return Fault.NONE
