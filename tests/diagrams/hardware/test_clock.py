"""Clocks of a hardware station, without assertions on real time."""

import numpy as np
import pytest
from pydrake.lcm import DrakeLcm
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import EventStatus, LeafSystem
from pydrake.systems.primitives import ConstantVectorSource

from guiderail.diagrams.hardware import clock as clock_module
from guiderail.diagrams.hardware.clock import IntervalHistogram, WallClock
from guiderail.diagrams.hardware.driver import STATUS_PERIOD
from guiderail.diagrams.hardware.lcm import HEAD_SIZE, IiwaDriver
from guiderail.diagrams.hardware.lcm_simulated import (
    ACKNOWLEDGED,
    LockstepClock,
    SimulatedIiwa,
    serve_in_lockstep,
    serve_in_real_time,
)
from guiderail.diagrams.tasks.bnc_connector.task import BncWorkcell
from guiderail.models.common.errors import InputError
from guiderail.models.control.joint_status import MAX_MISSED_MESSAGES


class Statuses(IiwaDriver):
    status_channel = "STATUS"


class ClockRecorder:
    def __init__(self):
        self.clocks = []

    def receive(self, context, clock=None):
        self.clocks.append(clock)


def test_wall_clock_steps_per_status_or_after_a_timeout():
    lcm = DrakeLcm("memq://")
    clock, recorder = WallClock(Statuses(lcm)), ClockRecorder()
    simulator = Simulator(ConstantVectorSource([0.0]))
    clock.begin()
    for number in range(3):
        lcm.Publish("STATUS", bytes([number]))
        clock.advance(simulator, recorder, 1)
    clock.advance(simulator, recorder, 2)  # without a status
    assert simulator.get_context().get_time() == 5 * STATUS_PERIOD
    assert (np.diff(recorder.clocks) >= 0.5 * STATUS_PERIOD).all()
    assert (np.diff(recorder.clocks)[-2:] >= 1.5 * STATUS_PERIOD).all()


@pytest.mark.parametrize("milliseconds", [1, 2, 4])
def test_wall_clock_skips_statuses_that_come_too_often(monkeypatch, milliseconds):
    """On a simulated wall clock, which waiting advances."""
    lcm, now, sent = DrakeLcm("memq://"), 0.0, 0

    def send():
        nonlocal sent
        while sent * milliseconds <= 1000 * now:
            lcm.Publish("STATUS", sent.to_bytes(8, "big"))
            sent += 1

    def sleep(seconds):
        nonlocal now
        now += seconds
        send()

    class Bus:
        def Subscribe(self, *arguments):
            return lcm.Subscribe(*arguments)

        def HandleSubscriptions(self, timeout):
            if not lcm.HandleSubscriptions(0) and timeout:
                sleep(1e-3)
                lcm.HandleSubscriptions(0)

    monkeypatch.setattr(clock_module.time, "monotonic", lambda: now)
    monkeypatch.setattr(clock_module.time, "sleep", sleep)
    clock, recorder = WallClock(Statuses(Bus())), ClockRecorder()
    simulator = Simulator(ConstantVectorSource([0.0]))
    clock.begin()
    clock.advance(simulator, recorder, 400)
    assert recorder.clocks[-1] >= 399 * STATUS_PERIOD
    # A delay is not made up for: the clock is at most half a step ahead.
    now += 1.0
    clock.advance(simulator, recorder, 200)
    assert recorder.clocks[-1] >= recorder.clocks[399] + 1.0 + 198.5 * STATUS_PERIOD - 1e-9


def test_events_of_an_instant_have_its_wall_clock_time():
    class Clocked(LeafSystem):
        def __init__(self):
            super().__init__()
            self.clock, self.seen = None, []
            self.DeclarePeriodicUnrestrictedUpdateEvent(STATUS_PERIOD, 0.0, self._see)

        def receive(self, context, clock=None):
            self.clock = context.get_time()

        def _see(self, context, state):
            self.seen.append(self.clock)
            return EventStatus.Succeeded()

    station = Clocked()
    WallClock(Statuses(DrakeLcm("memq://"))).advance(Simulator(station), station, 3)
    assert station.seen == [None, 0.0, STATUS_PERIOD]


def test_wall_clock_scales_time_by_the_rate():
    slow, fast = ClockRecorder(), ClockRecorder()
    for recorder, rate in ((slow, 0.25), (fast, 1.0)):
        clock = WallClock(Statuses(DrakeLcm("memq://")), rate=rate)
        clock.advance(Simulator(ConstantVectorSource([0.0])), recorder, 2)
    assert slow.clocks[1] - slow.clocks[0] >= 1.5 * STATUS_PERIOD
    assert slow.clocks[0] == pytest.approx(0.25 * fast.clocks[0], rel=0.01)
    for rate in (0.0, 1e-9, 1.1, np.nan):
        with pytest.raises(InputError, match=r"from 0\.001 to 1"):
            WallClock(Statuses(DrakeLcm("memq://")), rate=rate)


def test_message_counter_counts_repeats_once():
    lcm = DrakeLcm("memq://")
    messages = Statuses(lcm).statuses
    for message in (b"one", b"one", b"two", b"one"):
        lcm.Publish("STATUS", message)
        lcm.HandleSubscriptions(0)
    assert messages.count == 3


def test_interval_histogram_has_quantiles_and_longest():
    gaps = IntervalHistogram()
    assert np.isnan(gaps.quantile(0.5))
    for seconds in [0.005] * 98 + [0.0312, 1.5]:
        gaps.add(seconds)
    assert gaps.quantile(0.5) == pytest.approx(0.005, abs=1.01e-4)
    assert gaps.quantile(0.99) == pytest.approx(0.0312, abs=1.01e-4)
    assert gaps.longest == 1.5


def test_message_counter_compares_type_and_time():
    lcm = DrakeLcm("memq://")
    messages = Statuses(lcm).statuses
    head = bytes(range(16))
    for message in (head + b"a", head + b"b", head[:-1] + b"\x00" + b"b"):
        lcm.Publish("STATUS", message)
        lcm.HandleSubscriptions(0)
    assert messages.count == 2


def test_lockstep_clock_acknowledges_repeats_without_a_step():
    lcm, acknowledgements = DrakeLcm("memq://"), []
    clock, simulator = LockstepClock(Statuses(lcm), 0.01), Simulator(ConstantVectorSource([0.0]))
    lcm.Subscribe("STATUS" + ACKNOWLEDGED, acknowledgements.append)
    clock.begin()
    for number in range(3):
        for _ in range(3):
            lcm.Publish("STATUS", bytes([number]) * 40)
        clock.advance(simulator, ClockRecorder(), 1)
        lcm.HandleSubscriptions(0)
    assert simulator.get_context().get_time() == 3 * STATUS_PERIOD
    # A status is acknowledged when the next one is needed.
    assert acknowledgements == [b"", *(bytes([number]) * HEAD_SIZE for number in range(2))]
    acknowledgements.clear()
    lcm.Publish("STATUS", bytes([2]) * 40)
    clock.advance(simulator, ClockRecorder(), 1)  # only repeats arrive: the step is made without a status
    while lcm.HandleSubscriptions(0):
        pass
    assert len(acknowledgements) > 1
    assert set(acknowledgements) == {bytes([2]) * HEAD_SIZE}


def test_serve_waits_for_the_acknowledgement_of_its_status():
    """A repeated acknowledgement of the previous status has no effect."""
    within, lcm, heard = DrakeLcm("memq://"), DrakeLcm("memq://"), []
    simulator = Simulator(SimulatedIiwa(BncWorkcell(), within))

    def answer(message):
        heard.append(message[:HEAD_SIZE])
        earlier = dict.fromkeys(heard)
        lcm.Publish(IiwaDriver.status_channel + ACKNOWLEDGED, list(earlier)[-2 if heard.count(heard[-1]) < 3 else -1])

    heard.append(b"\x7f" * HEAD_SIZE)
    lcm.Subscribe(IiwaDriver.status_channel, answer)
    simulator.Initialize()
    assert serve_in_lockstep(simulator, within, lcm, 4 * STATUS_PERIOD, 5.0) == 4 * STATUS_PERIOD
    heard = heard[1:]
    assert [heard.count(head) for head in dict.fromkeys(heard)][:4] == [3] * 4


def test_lockstep_is_independent_of_timing():
    """An answer to a status or to its repetition counts for the same step."""
    moved = []
    for wait in (1, 2):
        within, lcm, heard = DrakeLcm("memq://"), DrakeLcm("memq://"), []
        simulator = Simulator(SimulatedIiwa(BncWorkcell(), within))

        def answer(message, lcm=lcm, heard=heard, wait=wait):
            heard.append(message)
            if heard.count(message) == wait:
                step = len(set(heard))
                lcm.Publish(IiwaDriver.command_channel, IiwaDriver.encode(np.full(7, (-1.0) ** step * step), step))
                lcm.Publish(IiwaDriver.status_channel + ACKNOWLEDGED, message[:HEAD_SIZE])

        lcm.Subscribe(IiwaDriver.status_channel, answer)
        simulator.Initialize()
        serve_in_lockstep(simulator, within, lcm, 6 * STATUS_PERIOD, 5.0)
        plant = simulator.get_system().plant
        moved.append(plant.GetPositions(plant.GetMyContextFromRoot(simulator.get_context())))
    np.testing.assert_array_equal(*moved)
    assert np.abs(moved[0] - moved[0].round(1)).max() > 1e-4


def test_serve_ignores_a_malformed_acknowledgement():
    within, lcm = DrakeLcm("memq://"), DrakeLcm("memq://")
    simulator = Simulator(SimulatedIiwa(BncWorkcell(), within))
    lcm.Subscribe(
        IiwaDriver.status_channel, lambda message: lcm.Publish(IiwaDriver.status_channel + ACKNOWLEDGED, b"yes")
    )
    simulator.Initialize()
    assert serve_in_lockstep(simulator, within, lcm, 2 * STATUS_PERIOD, 0.01) == 0.0


@pytest.mark.parametrize(
    ("periods", "is_reported"), [(MAX_MISSED_MESSAGES - 1, False), (MAX_MISSED_MESSAGES + 1, True)]
)
def test_serve_in_real_time_reports_a_delay_once(monkeypatch, periods, is_reported):
    sent, wall = [], [0.0]
    monkeypatch.setattr("guiderail.diagrams.hardware.lcm_simulated.time.monotonic", lambda: wall[0])

    def attend():
        attended.append(True)
        wall[0] = (periods + len(attended)) * STATUS_PERIOD

    attended = []
    simulator = Simulator(ConstantVectorSource([0.0]))
    serve_in_real_time(simulator, 3 * STATUS_PERIOD, attend, 1.0, sent.append)
    assert len(attended) == 3
    assert bool(sent) == is_reported
    assert len(sent) <= 1
    assert all("give a smaller --rate" in acknowledgements for acknowledgements in sent)
