"""How time passes between a station on a bus and its robot: by the wall's clock, or in step."""

from __future__ import annotations

import os
import struct
import time
from collections.abc import Callable
from functools import partial
from typing import Protocol

import numpy as np
from pydrake.lcm import DrakeLcm, DrakeLcmInterface
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context

from guiderail.diagrams.hardware.driver import MICROSECOND, STATUS_PERIOD, Driver
from guiderail.diagrams.hardware.monitor import word_channel
from guiderail.models.common.errors import InputError
from guiderail.models.control.joint_status import MAX_MISSED_MESSAGES

TAKEN = "_TAKEN"  # what the channel is called on which a status's receiver answers a simulated robot
REPEAT = 0.05  # [s] of wall clock, after which a simulated robot repeats a status that wasn't answered
URGENCY = 20  # of a process that a robot waits for, among those that the system serves first
HEAD_FORMAT = ">8sq"  # of a message: its type, and the time [µs] that a status or a command begins with
HEAD = struct.calcsize(HEAD_FORMAT)
BIN = 1e-4  # [s] of a histogram


class Clocked(Protocol):
    """A station that can be told the time."""

    def tell_time(self, context: Context, clock: float) -> None:
        """The time on the wall [s]; `context` is the root's."""


class Clock(Protocol):
    """How time passes."""

    def begin(self) -> None:
        """Called when a simulator was initialized."""

    def advance(self, simulator: Simulator, station: Clocked, steps: int) -> None:
        """Advances by so many statuses."""


def handlers_are_safe() -> bool:
    """Whether Drake takes the interpreter's lock before it calls a handler of Python's.

    A Drake whose bindings are nanobind's (1.58 was tried) makes the handler's argument without it where a simulator
    reads the bus, and the process ends there.
    """
    return not type(DrakeLcmInterface.__dict__["Subscribe"]).__module__.startswith("nanobind")


def check_handlers() -> None:
    """Asked before anything of a robot's bus is heard.

    Raises:
        InputError: if handlers are not safe.
    """
    if not handlers_are_safe():
        raise InputError(
            "this version of Drake calls Python's handlers of LCM messages without the interpreter's lock, which ends "
            "the process: for a robot or a rehearsal use drake 1.51 (constraints.txt)"
        )


def check_rate(rate: float) -> None:
    """Of a robot's clock to the wall's.

    Raises:
        InputError: if it is not positive, or above 1.
    """
    if not 0.0 < rate <= 1.0:
        raise InputError(f"a simulated robot's clock goes at a rate up to 1 of the wall's, not {rate:g}")


class MessageCounter:
    """Counts the messages of a channel; one that is sent again counts once, whatever torques it says by then.

    Attributes:
        count: of different messages.
        repeats: of those that were sent again.
        last: the head of the last one, by which they are told apart.
    """

    def __init__(self, lcm: DrakeLcmInterface, channel: str):
        """
        Args:
            lcm: the bus.
            channel: its channel.

        Raises:
            InputError: if handlers are not safe.
        """
        check_handlers()
        self.count = self.repeats = 0
        self.last = b""
        lcm.Subscribe(channel, self._hear)

    def _hear(self, message: bytes) -> None:
        if message[:HEAD] != self.last:
            self.last, self.count = message[:HEAD], self.count + 1
        else:
            self.repeats += 1


class IntervalHistogram:
    """How regularly something happened: seconds between one time and the next, in a histogram."""

    def __init__(self) -> None:
        self._counts = np.zeros(1000, np.int64)
        self.longest = 0.0

    def add(self, seconds: float) -> None:
        """One more."""
        self._counts[min(int(seconds / BIN), len(self._counts) - 1)] += 1
        self.longest = max(self.longest, seconds)

    def quantile(self, share: float) -> float:
        """Which gap this share of them does not exceed [s], to a tenth of a millisecond; NaN of none."""
        total = self._counts.sum()
        if not total:
            return np.nan
        return (int(np.searchsorted(np.cumsum(self._counts), share * total)) + 1) * BIN


def set_realtime_priority() -> bool:
    """Asks the system to serve this process before others, as a robot waits for it; whether it will."""
    try:
        # Processes that this one starts are as any other.
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(URGENCY))
    except (AttributeError, OSError):
        return False
    return True


class WallClock:
    """Advances a hardware station by the wall's clock: a step for each status, as it arrives.

    Where none comes for one and a half periods a step goes without, and the station's watchdog notices. Of statuses
    that came while this program was held up only the newest counts: it never hurries after the time that it lost. Nor
    does a robot that speaks more often than every period set_realtime_priority it: a station's time is never more than half a period
    ahead of the wall's.

    Attributes:
        gaps: between steps.
    """

    def __init__(self, lcm: DrakeLcmInterface, channel: str, period: float = STATUS_PERIOD, rate: float = 1.0):
        """
        Args:
            lcm: the bus.
            channel: of the statuses.
            period: in which they come [s].
            rate: of the robot's clock to the wall's, positive, up to 1: less where a simulated robot is slow.

        Raises:
            InputError: if the rate is not positive, or above 1.
        """
        check_rate(rate)
        self.gaps = IntervalHistogram()
        self._lcm, self._period, self._rate = lcm, period, rate
        self._statuses = MessageCounter(lcm, channel)
        self._taken, self._last = 0, time.monotonic()
        self._due = self._last  # the next step's time

    def begin(self) -> None:
        """Called when a simulator was initialized, with the newest status."""
        self._lcm.HandleSubscriptions(0)
        self._taken, self._last = self._statuses.count, time.monotonic()
        self._due = self._last + self._period / self._rate

    def advance(self, simulator: Simulator, station: Clocked, steps: int) -> None:
        """Advances by so many statuses."""
        context = simulator.get_mutable_context()
        start = context.get_time()
        for step in range(steps):
            self._wait()
            self._taken, now = self._statuses.count, time.monotonic()
            self.gaps.add(now - self._last)
            self._last = now
            period = self._period / self._rate
            self._due = max(self._due, now) + period
            # What happens at an instant belongs to the clock of that instant, and Drake has left it for the next step.
            simulator.AdvancePendingEvents()
            station.tell_time(context, now * self._rate)
            simulator.AdvanceTo(start + (step + 1) * self._period)

    def _wait(self) -> None:
        # Whoever floods the bus doesn't set the pace.
        period = self._period / self._rate
        time.sleep(max(self._due - 0.5 * period - time.monotonic(), 0.0))
        end = self._last + 1.5 * period
        while self._statuses.count == self._taken and (left := end - time.monotonic()) > 0.0:
            self._lcm.HandleSubscriptions(max(1, int(1000 * left)))
        self._lcm.HandleSubscriptions(0)


class LockstepClock:
    """Advances a hardware station at the pace of a simulated robot: a step for each new status that arrives.

    Before each it says which status it had last, for `serve`, which waits for this word and for no other: one that
    comes twice, because a status was sent again before it was answered, moves nobody. So a robot stands still while
    whoever drives it does anything else, and what comes of a run does not depend on how long that takes.
    """

    def __init__(self, lcm: DrakeLcmInterface, command_timeout: float, channel: str, period: float = STATUS_PERIOD):
        """
        Args:
            lcm: the bus.
            patience: how long to wait for a status [s]; then steps go without, and the station's watchdog notices.
            channel: of the statuses.
            period: in which they come [s].
        """
        self._lcm, self._patience, self._answers, self._period = lcm, command_timeout, channel + TAKEN, period
        self._statuses = MessageCounter(lcm, channel)
        self._taken = b""
        self._is_silent = False

    def begin(self) -> None:
        """Called when a simulator was initialized, with the newest status."""
        self._lcm.HandleSubscriptions(0)
        self._taken = self._statuses.last

    def advance(self, simulator: Simulator, station: Clocked, steps: int) -> None:
        """Advances by so many statuses; nobody needs the time on the wall."""
        start = simulator.get_context().get_time()
        for step in range(steps):
            # A robot that has fallen silent is not waited for again and again.
            command_timeout = self._period if self._is_silent else self._patience
            self._ask()
            end = time.monotonic() + command_timeout
            while self._statuses.last == self._taken and (left := end - time.monotonic()) > 0.0:
                repeats = self._statuses.repeats
                self._lcm.HandleSubscriptions(max(1, int(1000 * left)))
                if self._statuses.last == self._taken and self._statuses.repeats > repeats:
                    self._ask()  # a robot that asks again may wait for a word that was lost
            self._is_silent = self._statuses.last == self._taken
            self._taken = self._statuses.last
            simulator.AdvanceTo(start + (step + 1) * self._period)

    def _ask(self) -> None:
        """For the status after the one that was taken last."""
        self._lcm.Publish(self._answers, self._taken)


def serve(
    simulator: Simulator, within: DrakeLcm, lcm: DrakeLcm, driver: Driver, seconds: float, command_timeout: float
) -> float:
    """Runs a simulated arm for another process: one step, then it waits until its status was answered.

    So neither side ever outruns the other, however slow a machine is. The answer is the word of a `LockstepClock` that it
    has taken this very status in; where no word ever came, it is a command. The arm has a bus of its own, so that
    nothing reaches it in the midst of a step: what was sent by then counts for the next one, whoever was faster.

    Args:
        simulator: of the arm, initialized.
        within: the arm's own bus, and its deputy's, in memory.
        lcm: the bus that it has with the other process.
        driver: that it has.
        seconds: of simulated time to run.
        patience: how long to wait for each answer, and ten times as long for the first [s of wall clock].

    Returns:
        The simulated time at which it ended: less than `seconds` if answers stopped.
    """
    words, commands = MessageCounter(lcm, driver.status_channel + TAKEN), list[bytes]()
    lcm.Subscribe(driver.command_channel, commands.append)
    # What the deputy says of a status goes out before it, so that who waits for the status has both.
    said = dict.fromkeys((word_channel(driver.command_channel), driver.status_channel), b"")
    for channel in said:
        within.Subscribe(channel, partial(said.__setitem__, channel))
    steps, repeats = 0, max(1, round(command_timeout / REPEAT))

    def is_answered() -> bool:
        if not words.count:
            return bool(commands)
        if len(words.last) != HEAD:
            return False
        taken = struct.unpack(HEAD_FORMAT, words.last)[1]
        return abs(taken * MICROSECOND - steps * driver.period) < 0.5 * driver.period

    def settle() -> None:
        while within.HandleSubscriptions(0):
            pass

    def say() -> None:
        for channel, message in said.items():
            if message:
                lcm.Publish(channel, message)

    simulator.get_system().ForcedPublish(simulator.get_context())
    settle()
    say()
    while steps * driver.period < seconds:
        for _ in range(repeats if steps else 10 * repeats):
            # A command comes before the word that belongs to it.
            while lcm.HandleSubscriptions(round(1000 * REPEAT)) and not is_answered():
                pass
            if is_answered():
                break
            # A datagram may be lost, and before its first answer the other side may not have been listening.
            say()
        else:
            break
        for message in commands:
            within.Publish(driver.command_channel, message)
        commands.clear()
        settle()
        steps += 1
        simulator.AdvanceTo(steps * driver.period)
        settle()
        say()
    return steps * driver.period


def serve_in_real_time(
    simulator: Simulator,
    driver: Driver,
    seconds: float,
    attend: Callable[[], None],
    rate: float = 1.0,
    say: Callable[[str], None] = print,
) -> None:
    """Runs a simulated arm by the wall's clock, as a robot does, which waits for nobody.

    An arm in contact takes a machine longer than one in the air. Where it falls so far behind its own clock that
    whoever drives it must take its statuses for old ones, it says so: that is no fault of theirs.

    Args:
        simulator: of the arm, initialized.
        driver: that it has.
        seconds: to run.
        attend: called after every status: for a deputy.
        rate: of its clock to the wall's.
        say: what a person is told, once.

    Raises:
        InputError: if handlers are not safe.
    """
    check_handlers()
    simulator.set_target_realtime_rate(rate)
    started, has_said = time.monotonic(), False
    for step in range(1, round(seconds / driver.period) + 1):
        simulator.AdvanceTo(step * driver.period)
        attend()
        behind = (time.monotonic() - started) * rate - step * driver.period
        if behind > MAX_MISSED_MESSAGES * driver.period and not has_said:
            say(
                f"this machine is too slow, or too busy, for a simulated robot whose clock goes at {rate:g} of the "
                f"wall's: it is {behind:.2f} s behind; give a smaller --rate, or --lockstep"
            )
            has_said = True
