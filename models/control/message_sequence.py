"""Sequences of messages on a bus: statuses that are not of one robot, commands that are not of one program."""

import numpy as np

from guiderail.models.control.joint_status import MAX_MISSED_MESSAGES, JointStatus

REVERSAL = 1.5  # largest change of a velocity between statuses [rad/s], as in a collision
RESOLUTION = 1e-4  # largest error of a position, from noise and resolution [rad]
RETURN_TIME = 1.0  # time in which a second program's commands are attributed to it [s]
EQUAL_TIME = 0.1  # time in which two commands with the time stamp of their predecessors are a contradiction [s]
LEAK = 1.2  # commands of one program per period, at most
MAX_LEVEL = MAX_MISSED_MESSAGES + 2  # commands that may arrive late, at once


class StatusSequence:
    """Counts the statuses that contradict their predecessors, whichever of them are read.

    A status contradicts its predecessors if it has the time stamp of one and other values, or if a position goes to and
    fro faster than a joint can: the velocities from three consecutive statuses have opposite signs and differ by more
    than `REVERSAL`, with `RESOLUTION` allowed for each position. Or if within two periods two of the intervals between
    time stamps are shorter than half a period. The statuses of two robots alternate like this.

    Attributes:
        num_conflicts: Number of contradictions.
    """

    def __init__(self, period: float):
        """Construct the sequence; `period` is the nominal one [s]."""
        self.num_conflicts = 0
        self._period, self._max_interval = period, MAX_MISSED_MESSAGES * period
        self._short_time = -np.inf  # time stamp after the last short interval [s]
        self._last: JointStatus | None = None
        self._motion: tuple[np.ndarray, float] | None = None  # velocity from the last two positions, its margin [rad/s]

    def add(self, status: JointStatus) -> None:
        """Add the next status as it arrives; one that cannot be decoded is compared with no other."""
        last, motion = self._last, self._motion
        self._last, self._motion = status, None
        if last is None or len(last.positions) != len(status.positions):
            return
        elapsed = status.time - last.time
        if elapsed == 0.0:
            self.num_conflicts += not np.array_equal(status.values(), last.values())
        if 0.0 < elapsed < 0.5 * self._period:
            self.num_conflicts += status.time - self._short_time <= 2.0 * self._period
            self._short_time = status.time
        if 0.0 < elapsed <= self._max_interval:
            velocity, margin = (status.positions - last.positions) / elapsed, 2.0 * RESOLUTION / elapsed
            self._motion = velocity, margin
            if motion is not None:
                is_reversed = velocity * motion[0] < 0.0
                change = np.abs(velocity - motion[0]) - margin - motion[1]
                self.num_conflicts += bool((is_reversed & (change > REVERSAL)).any())


class CommandSequence:
    """Counts the commands that cannot be of the program that sent the previous ones.

    The commands of one program have increasing time stamps and arrive once per period; a restart sets its clock once,
    and the network may delay commands by a few periods. These contradict that:

    - *Return*: time stamps that jump relative to the local clock, and then back to where the first clock has to be.
    - *Equal time*: within `EQUAL_TIME`, two commands with the time stamp of their predecessor and other torques.
    - *Rate*: more than `LEAK` commands per period, with `MAX_LEVEL` at once.

    Attributes:
        num_conflicts: Number of contradictions.
    """

    def __init__(self, period: float):
        """Construct the sequence; `period` is that of one program's commands [s]."""
        self.num_conflicts = 0
        self._period, self._reach = period, MAX_MISSED_MESSAGES * period
        self._last = (np.nan, -np.inf)  # time stamp of the last command, and local time of its arrival [s]
        self._left = (np.nan, np.nan)  # the same before the last jump
        self._torque = np.empty(0)
        self._equal_time = -np.inf  # local time of the last command with its predecessor's time stamp [s]
        self._level = 0.0

    def add(self, torque: np.ndarray, time: float, now: float) -> None:
        """Add a command: its torques (n,) [Nm], its time stamp [s] and the local time [s]."""
        last, received = self._last
        is_equal = time == last
        if is_equal and np.array_equal(torque, self._torque):
            return  # the same message again
        self._level = max(self._level - LEAK * (now - received) / self._period, 0.0) + 1.0
        is_contradictory = self._level > MAX_LEVEL
        self._level = min(self._level, MAX_LEVEL)  # so that it falls when one program is left
        if is_equal:
            is_contradictory |= now - self._equal_time <= EQUAL_TIME
            self._equal_time = now
        elif abs(time - last - (now - received)) > self._reach:
            left, left_at = self._left
            elapsed = now - left_at
            is_contradictory |= elapsed <= RETURN_TIME and abs(time - left - elapsed) <= self._reach
            self._left = self._last
        self.num_conflicts += bool(is_contradictory)
        self._last, self._torque = (time, now), torque
