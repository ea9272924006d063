"""Detection of a second robot or a second commanding program by the sequence of messages on a bus."""

import numpy as np

from guiderail_hardware.models.joint_status import MAX_MISSED_MESSAGES, JointStatus

REVERSAL = 1.5  # largest change of a joint velocity between statuses, as in a collision [rad/s]
RESOLUTION = 1e-4  # largest error of a position, from noise and resolution [rad]
MAX_RETURN = 200  # largest number of statuses between two jumps of the time stamps that count as a return
RETURN_TIME = 1.0  # largest time between two jumps of the time stamps that count as a return [s]
EQUAL_TIME = 0.1  # largest time between two repetitions of a time stamp that count as a contradiction [s]
LEAK = 1.2  # largest mean number of commands of one program per period
MAX_LEVEL = MAX_MISSED_MESSAGES + 2  # largest number of late commands that may arrive at once


class StatusSequence:
    """Counter of the arriving statuses that contradict their predecessors.

    Four patterns are contradictions; alternating statuses of two robots cause them:

    - *Equal time*: a status has the time stamp of the last status but other values.
    - *Reversal*: a joint reverses faster than it can. The two velocities from three consecutive statuses have opposite
      signs and differ by more than `REVERSAL`, with an error of `RESOLUTION` allowed for each position. If a
      time stamp precedes its predecessor, the signs do not matter: reordered statuses of one robot have one velocity.
    - *Rate*: two intervals between time stamps within two periods are shorter than half a period.
    - *Return*: the time stamps jump by more than `MAX_MISSED_MESSAGES` periods, and twice in succession they return
      within `MAX_RETURN` statuses to where they came from. The clock of a robot that restarts jumps once, a late status
      returns once, and lost statuses are a jump without a return.

    Attributes:
        num_conflicts: Number of contradictions.
    """

    def __init__(self, period: float):
        """Construct the sequence of statuses with the nominal period `period` [s]."""
        self.num_conflicts = 0
        self._period, self._max_interval = period, MAX_MISSED_MESSAGES * period
        self._short_time = -np.inf  # time stamp after the last short interval [s]
        self._last: JointStatus | None = None
        # Velocity from two positions and its margin [rad/s]; True if the second time stamp was the earlier one
        self._motion: tuple[np.ndarray, float, bool] | None = None
        self._time_before_jump, self._num_since_jump = np.nan, 0  # time stamp [s], and number of statuses since then
        self._has_returned = False  # True if the last jump was a return

    def add(self, status: JointStatus) -> None:
        """Add a status that arrived; a status that could not be decoded is not compared."""
        last, motion = self._last, self._motion
        self._last, self._motion = status, None
        if last is None or len(last.positions) != len(status.positions):
            return
        elapsed = status.time - last.time
        self._num_since_jump += 1
        if elapsed == 0.0:
            self.num_conflicts += not np.array_equal(status.values(), last.values())
        if 0.0 < abs(elapsed) < 0.5 * self._period:
            self.num_conflicts += abs(status.time - self._short_time) <= 2.0 * self._period
            self._short_time = status.time
        if abs(elapsed) > self._max_interval:
            since = status.time - self._time_before_jump
            longest = (self._num_since_jump + MAX_MISSED_MESSAGES) * self._period
            is_return = self._num_since_jump <= MAX_RETURN and abs(since) <= longest
            self.num_conflicts += is_return and self._has_returned  # one late status jumps and returns once
            self._time_before_jump, self._num_since_jump, self._has_returned = last.time, 0, is_return
        if 0.0 < abs(elapsed) <= self._max_interval:
            velocity, margin = (status.positions - last.positions) / elapsed, 2.0 * RESOLUTION / abs(elapsed)
            self._motion = velocity, margin, elapsed < 0.0
            if motion is not None:
                is_reversed = (velocity * motion[0] < 0.0) | (elapsed < 0.0) | motion[2]
                change = np.abs(velocity - motion[0]) - margin - motion[1]
                self.num_conflicts += bool((is_reversed & (change > REVERSAL)).any())


class CommandSequence:
    """Counter of commands that cannot be from the program that sent the previous ones.

    The commands of one program have increasing time stamps and arrive once per period. A restart of the program sets
    its clock once, and the network may delay commands by a few periods. Three patterns are contradictions:

    - *Return*: time stamps jump relative to the local clock, and jump back within `RETURN_TIME`.
    - *Equal time*: two commands within `EQUAL_TIME` have the time stamp of their predecessor but other torques.
    - *Rate*: more than `LEAK` commands per period arrive in the long run; up to `MAX_LEVEL` may arrive at once.

    Attributes:
        num_conflicts: Number of contradictions.
    """

    def __init__(self, period: float):
        """Construct the sequence of commands that one program sends every `period` [s]."""
        self.num_conflicts = 0
        self._period, self._max_delay = period, MAX_MISSED_MESSAGES * period
        self._last = (np.nan, -np.inf)  # time stamp of the last command, and local time of its arrival [s]
        self._before_jump = (np.nan, np.nan)  # `_last` before the last jump of the time stamps
        self._torque = np.empty(0)
        self._equal_time = -np.inf  # local time of the last command with its predecessor's time stamp [s]
        self._level = 0.0  # number of commands in excess of the accepted rate

    def add(self, torque: np.ndarray, time: float, now: float) -> None:
        """Add a command: its torques (n,) [Nm], its time stamp [s] and the local time [s]."""
        last_time, received = self._last
        is_equal = time == last_time
        if is_equal and np.array_equal(torque, self._torque):
            return  # the same message again
        self._level = max(self._level - LEAK * (now - received) / self._period, 0.0) + 1.0
        is_contradictory = self._level > MAX_LEVEL
        self._level = min(self._level, MAX_LEVEL)  # so that the level falls when only one program is left
        if is_equal:
            is_contradictory |= now - self._equal_time <= EQUAL_TIME
            self._equal_time = now
        elif abs(time - last_time - (now - received)) > self._max_delay:
            old_time, old_received = self._before_jump
            elapsed = now - old_received
            is_contradictory |= elapsed <= RETURN_TIME and abs(time - old_time - elapsed) <= self._max_delay
            self._before_jump = self._last
        self.num_conflicts += bool(is_contradictory)
        self._last, self._torque = (time, now), torque
