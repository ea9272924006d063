"""What a robot's driver says of its joints, whether it may be believed, and what may stop an arm."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from guiderail.models.common.errors import InputError


def damping_torque(
    M: np.ndarray, v: np.ndarray, decay_time: float, *, period: float, damped: float = 0.0
) -> np.ndarray:
    """τ = −M(q) v exp(−t / T) (1 − exp(−h / T)) / h, which takes away all joints' speed with the decay time T.

    Held for each period h, these torques add up to exactly the momentum that the arm had: where its speed is not seen
    any more, nothing is driven backwards by one that is long gone.

    Args:
        M: mass matrix, (n, n).
        v: joint velocities as they were, (n,) [rad/s].
        decay_time: T [s].
        period: h, for which a torque is held [s].
        damped: t, for how long the arm has been damped since it had these velocities [s].
    """
    return -(M @ v) * (np.exp(-damped / decay_time) * -np.expm1(-period / decay_time) / period)


MISSED = 6  # messages in a row without which nobody goes on


class Fault(IntEnum):
    """Why an arm stops. The first that holds counts."""

    NONE = 0
    NO_STATUS = 1
    STALE = 2
    OUT_OF_ORDER = 3
    FUTURE = 4
    MALFORMED = 5
    WRONG_SIZE = 6
    NOT_FINITE = 7
    POSITION_JUMP = 8
    VELOCITY_JUMP = 9
    VELOCITY = 10
    WORKSPACE = 11
    FORCE = 12
    EXTERNAL_TORQUE = 13
    TORQUE = 14
    USER_STOP = 15
    DEADLINE_MISSED = 16
    MONITOR_STOP = 17


FAULTS = {
    Fault.NONE: "none",
    Fault.NO_STATUS: "no status has come, or not for long enough",
    Fault.STALE: "the status is old: it stopped, or comes late",
    Fault.OUT_OF_ORDER: "a status is much older than the one before it: the robot's clock was set back",
    Fault.FUTURE: "a status is from the future: the robot's clock has jumped",
    Fault.MALFORMED: "a status can't be read",
    Fault.WRONG_SIZE: "a status is of another number of joints",
    Fault.NOT_FINITE: "a status holds numbers that are none",
    Fault.POSITION_JUMP: "a joint's position has jumped",
    Fault.VELOCITY_JUMP: "a joint's velocity has jumped",
    Fault.VELOCITY: "a joint is too fast",
    Fault.WORKSPACE: "the tool, or where it is told to go, is outside of the workspace",
    Fault.FORCE: "the force on the tool is too great",
    Fault.EXTERNAL_TORQUE: "the surroundings load a joint too much",
    Fault.TORQUE: "the wanted torques are no numbers",
    Fault.USER_STOP: "somebody asked for it",
    Fault.DEADLINE_MISSED: "this program was held up, and sent nothing for too long",
    Fault.MONITOR_STOP: "the deputy at the robot has stopped it, or is gone",
}
"""Each fault in words."""


@dataclass(frozen=True)
class JointStatus:
    """A status as it came.

    Attributes:
        time: of the robot's clock [s]; NaN where the message could not be read.
        positions, velocities, external_torque: (n,) [rad, rad/s, Nm], of whatever size and values came.
    """

    time: float
    positions: np.ndarray
    velocities: np.ndarray
    external_torque: np.ndarray

    def __deepcopy__(self, memo: object) -> JointStatus:
        """Itself: Drake copies values all the time, and nobody writes into this one."""
        return self

    @property
    def is_readable(self) -> bool:
        """Whether the message could be read."""
        return bool(np.isfinite(self.time))

    def values(self) -> np.ndarray:
        """Positions, velocities and external torques in one vector."""
        return np.concatenate([self.positions, self.velocities, self.external_torque])


@dataclass(frozen=True)
class Heartbeat:
    """What a robot's deputy says with every status.

    Attributes:
        number: another one each time.
        is_acting: whether it is stopping the arm.
    """

    number: int
    is_acting: bool

    def __deepcopy__(self, memo: object) -> Heartbeat:
        """Itself: nobody writes into this one."""
        return self


UNREADABLE = JointStatus(np.nan, np.empty(0), np.empty(0), np.empty(0))
"""What stands for a message that could not be read."""


@dataclass(frozen=True)
class StatusLimits:
    """What a status must keep to.

    Args:
        velocity: of each joint, beyond which nothing moves (n,) [rad/s], positive: what positions may change by.
        max_age: beyond which a status is stale [s], positive. Some of them may be lost on the way, or overtaken.
        max_lead: by which a status may be ahead of this clock [s], positive.
        position_jump: beyond what the velocity explains [rad], positive.
        velocity_jump: from one status to the next, and beyond what the positions' change explains [rad/s], positive; a
            collision is not slower than 1.
        settling: for how long statuses must have been sound before they are believed [s], not negative: the time for
            which a driver that has just been started wants no commands.
        clock_drift: of the two clocks against each other [s/s], not negative: slower changes are no fault.
        max_gap: between two checks, by the clock on the wall, beyond which this program itself was held up for too
            long [s], positive.
    """

    velocity: tuple[float, ...]
    max_age: float = 0.03
    max_lead: float = 0.03
    position_jump: float = 0.02
    velocity_jump: float = 1.5
    settling: float = 0.25
    clock_drift: float = 1e-3
    max_gap: float = 0.03

    def __post_init__(self) -> None:
        positive = (*self.velocity, self.max_age, self.max_lead, self.position_jump, self.velocity_jump)
        positive += (self.max_gap,)
        if not self.velocity or not all(0.0 < value < np.inf for value in positive):
            raise InputError("the limits of a robot's status must be positive")
        if not all(0.0 <= value < np.inf for value in (self.settling, self.clock_drift)):
            raise InputError("a robot's settling time and its clock's drift must be finite and not negative")

    @classmethod
    def at_rate(cls, velocity: Sequence[float], period: float) -> StatusLimits:
        """The limits for a driver that speaks once in `period` [s]: some messages in a row may be lost or late."""
        silence = MISSED * period
        return cls(tuple(velocity), max_age=silence, max_lead=silence, max_gap=silence)


@dataclass(frozen=True)
class Heard:
    """What is remembered of the last readable status.

    Attributes:
        time: of the robot's clock [s]; NaN where there was none yet.
        offset: from the robot's clock to this one [s].
        values: as `JointStatus.values`, (3n,).
    """

    time: float
    offset: float
    values: np.ndarray


def judge_status(status: JointStatus | None, last: Heard, now: float, limits: StatusLimits) -> Fault:
    """What is wrong with a status that comes after another.

    Args:
        status: the newest; None where none has come.
        last: what is remembered.
        now: of this clock [s].
        limits: what it must keep to.
    """
    if status is None:
        return Fault.NO_STATUS
    if not status.is_readable:
        return Fault.MALFORMED
    num_joints = len(limits.velocity)
    if {len(part) for part in (status.positions, status.velocities, status.external_torque)} != {num_joints}:
        return Fault.WRONG_SIZE
    values = status.values()
    if not np.isfinite(values).all():
        return Fault.NOT_FINITE
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
        return Fault.NONE  # it comes again, or was overtaken on its way: nothing is made of it
    change = np.abs(values - last.values)
    reachable = limits.position_jump + np.array(limits.velocity) * (status.time - last.time)
    if (change[:num_joints] > reachable).any():
        return Fault.POSITION_JUMP
    if (change[num_joints : 2 * num_joints] > limits.velocity_jump).any():
        return Fault.VELOCITY_JUMP
    # A speed with which nothing moves would be damped all the same, and so drive the arm.
    elapsed = status.time - last.time
    if 0.0 < elapsed <= limits.max_age:
        moving = (status.positions - last.values[:num_joints]) / elapsed
        if (np.abs(moving - status.velocities) > limits.velocity_jump).any():
            return Fault.VELOCITY_JUMP
    return Fault.NONE
