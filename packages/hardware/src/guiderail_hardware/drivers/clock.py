"""Clocks of a hardware station, which advance its simulator with the robot's statuses."""

from __future__ import annotations

import gc
import os
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from numbers import Real
from typing import TYPE_CHECKING

import numpy as np
from pydrake.systems.analysis import Simulator

from guiderail.models.common.errors import InputError, brief
from guiderail_hardware.drivers.driver import Driver

if TYPE_CHECKING:
    from guiderail_hardware.station import HardwareStation

REALTIME_PRIORITY = 20  # priority under SCHED_FIFO
MIN_RATE = 1e-3  # smallest rate of a simulated robot's clock: a status period of 5 ms takes 5 s
BIN_WIDTH = 1e-4  # width of a histogram's bin [s]


class Clock(ABC):
    """Clock that advances a hardware station together with its robot.

    A subclass sets `_period`, the status period of the station [s].

    Attributes:
        check_robot: Function that is called before each step; it raises an error if the robot's program has ended.
    """

    _period: float
    check_robot: Callable[[], object] | None = None

    @abstractmethod
    def begin(self) -> None:
        """Prepare to advance a simulator that has just been initialized with the newest status."""

    def advance(self, simulator: Simulator, station: HardwareStation, steps: int) -> None:
        """Advance the simulator by `steps` status periods."""
        context = simulator.get_mutable_context()
        start = context.get_time()
        for step in range(steps):
            time_of_status = self._wait_for_step()
            if self.check_robot is not None:
                self.check_robot()
            # Events of this instant are still pending in Drake, and belong to the previous status.
            simulator.AdvancePendingEvents()
            station.receive(context, time_of_status)
            simulator.AdvanceTo(start + (step + 1) * self._period)

    @abstractmethod
    def _wait_for_step(self) -> float | None:
        """Wait until the next step is due; return its time [s], or None for one period after the previous step."""


def check_rate(rate: float) -> None:
    """Check the rate of the robot's clock relative to the wall clock.

    Raises:
        InputError: If `rate` is not a number, below `MIN_RATE`, or above 1.
    """
    if not isinstance(rate, Real) or not MIN_RATE <= rate <= 1.0:
        raise InputError(f"the rate of a simulated robot's clock is from {MIN_RATE:g} to 1, not {brief(rate)}")


class IntervalHistogram:
    """Histogram of the intervals between events.

    Attributes:
        longest: Longest interval [s].
    """

    def __init__(self) -> None:
        self._counts = np.zeros(1000, np.int64)
        self.longest = 0.0

    def add(self, seconds: float) -> None:
        """Add one interval [s]."""
        self._counts[min(int(seconds / BIN_WIDTH), len(self._counts) - 1)] += 1
        self.longest = max(self.longest, seconds)

    def quantile(self, share: float) -> float:
        """Return the quantile of the intervals [s] at a `share` in [0, 1], to 0.1 ms; NaN without intervals.

        Intervals of more than 0.1 s count as 0.1 s.
        """
        total = self._counts.sum()
        if not total:
            return np.nan
        return (int(np.searchsorted(np.cumsum(self._counts), share * total)) + 1) * BIN_WIDTH


def set_realtime_priority() -> bool:
    """Request a real-time priority for this process (SCHED_FIFO); return True if the operating system grants it."""
    try:
        # Child processes have normal priority.
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(REALTIME_PRIORITY))
    except (AttributeError, OSError):
        return False
    return True


@contextmanager
def garbage_collection_disabled() -> Iterator[None]:
    """Disable garbage collection: a full collection can exceed the robot's command timeout."""
    gc.collect()
    gc.freeze()
    gc.disable()
    try:
        yield
    finally:
        gc.enable()
        gc.unfreeze()


class WallClock(Clock):
    """Clock that advances a hardware station in real time: one step when a status arrives.

    If no status arrives for one and a half periods, a step is made without one; the station's watchdog detects this.
    If this program was delayed, only the newest status is used, and lost time is not made up for. If statuses arrive
    more often than once a period, some are skipped: the station is at most half a period ahead of the wall clock.

    Attributes:
        intervals: Intervals between steps.
    """

    def __init__(self, driver: Driver, period: float | None = None, rate: float = 1.0):
        """Construct the clock.

        Args:
            driver: Driver whose statuses advance the station.
            period: Period of a step [s]; the driver's by default.
            rate: Rate of the robot's clock relative to the wall clock, at most 1; lower for a simulated robot that is
                slower than real time.

        Raises:
            InputError: If the rate is out of range, or the driver cannot receive in this environment.
        """
        driver.check_usable()
        check_rate(rate)
        self.intervals = IntervalHistogram()
        self._driver, self._period, self._rate = driver, period or driver.period, rate
        self._num_used, self._last_step = driver.num_statuses, time.monotonic()
        self._due = self._last_step  # wall clock time of the next step [s]

    def begin(self) -> None:
        """Prepare to advance a simulator that has just been initialized with the newest status."""
        self._driver.guard.receive()
        self._num_used, self._last_step = self._driver.num_statuses, time.monotonic()
        self._due = self._last_step + self._period / self._rate

    def _wait_for_step(self) -> float:
        # Sleep first: without this pause, a driver that sends more often than once a period would speed up the clock.
        period = self._period / self._rate
        time.sleep(max(self._due - 0.5 * period - time.monotonic(), 0.0))
        end = self._last_step + 1.5 * period
        while self._driver.num_statuses == self._num_used and (left := end - time.monotonic()) > 0.0:
            self._driver.guard.receive(left)
        self._driver.guard.receive()
        self._num_used, now = self._driver.num_statuses, time.monotonic()
        self.intervals.add(now - self._last_step)
        self._last_step = now
        self._due = max(self._due, now) + period
        return now * self._rate
