"""Clocks of a hardware station, and the loops that serve a simulated robot; no test depends on real time."""

import numpy as np
import pytest
from hardware_doubles import ClockRecorder
from pydrake.lcm import DrakeLcm
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import EventStatus, LeafSystem
from pydrake.systems.primitives import ConstantVectorSource

from guiderail.diagrams.tasks.bnc_connector import BncWorkcell
from guiderail.models.common.errors import InputError
from guiderail_hardware.drivers import clock as clock_module
from guiderail_hardware.drivers.clock import IntervalHistogram, WallClock
from guiderail_hardware.drivers.driver import STATUS_PERIOD
from guiderail_hardware.drivers.lcm import HEAD_SIZE, IiwaDriver
from guiderail_hardware.drivers.lcm_simulated import (
    ACKNOWLEDGED,
    LockstepClock,
    SimulatedIiwa,
    serve_in_lockstep,
    serve_in_real_time,
)
from guiderail_hardware.models.joint_status import MAX_MISSED_MESSAGES


class StatusDriver(IiwaDriver):
    """Driver whose statuses may be any bytes."""

    status_channel = "STATUS"


def test_wall_clock_steps_per_status_or_after_a_timeout():
    lcm = DrakeLcm("memq://")
    clock, recorder = WallClock(StatusDriver(lcm)), ClockRecorder()
    simulator = Simulator(ConstantVectorSource([0.0]))
    clock.begin()
    for number in range(3):
        lcm.Publish("STATUS", bytes([number]))
        clock.advance(simulator, recorder, 1)
    clock.advance(simulator, recorder, 2)  # steps without a status after a timeout
    assert simulator.get_context().get_time() == 5 * STATUS_PERIOD
    assert (np.diff(recorder.clocks) >= 0.5 * STATUS_PERIOD).all()
    assert (np.diff(recorder.clocks)[-2:] >= 1.5 * STATUS_PERIOD).all()


@pytest.mark.parametrize("milliseconds", [1, 2, 4])
def test_wall_clock_skips_statuses_of_a_shorter_period(monkeypatch, milliseconds):
    """Waiting advances a simulated wall clock."""
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
    clock, recorder = WallClock(StatusDriver(Bus())), ClockRecorder()
    simulator = Simulator(ConstantVectorSource([0.0]))
    clock.begin()
    clock.advance(simulator, recorder, 400)
    assert recorder.clocks[-1] >= 399 * STATUS_PERIOD
    # After a delay of 1 s, no lost time is made up for: the clock is at most half a step ahead.
    now += 1.0
    clock.advance(simulator, recorder, 200)
    assert recorder.clocks[-1] >= recorder.clocks[399] + 1.0 + 198.5 * STATUS_PERIOD - 1e-9


def test_pending_events_have_the_clock_of_the_last_status():
    class StationWithEvents(LeafSystem):
        def __init__(self):
            super().__init__()
            self.clock, self.clocks_of_events = None, []
            self.DeclarePeriodicUnrestrictedUpdateEvent(STATUS_PERIOD, 0.0, self._record)

        def receive(self, context, clock=None):
            self.clock = context.get_time()

        def _record(self, context, state):
            self.clocks_of_events.append(self.clock)
            return EventStatus.Succeeded()

    station = StationWithEvents()
    WallClock(StatusDriver(DrakeLcm("memq://"))).advance(Simulator(station), station, 3)
    assert station.clocks_of_events == [None, 0.0, STATUS_PERIOD]


def test_wall_clock_scales_time_by_the_rate():
    slow, fast = ClockRecorder(), ClockRecorder()
    for recorder, rate in ((slow, 0.25), (fast, 1.0)):
        clock = WallClock(StatusDriver(DrakeLcm("memq://")), rate=rate)
        clock.advance(Simulator(ConstantVectorSource([0.0])), recorder, 2)
    assert slow.clocks[1] - slow.clocks[0] >= 1.5 * STATUS_PERIOD
    assert slow.clocks[0] == pytest.approx(0.25 * fast.clocks[0], rel=0.01)
    for rate in (0.0, 1e-9, 1.1, np.nan):
        with pytest.raises(InputError, match=r"from 0\.001 to 1"):
            WallClock(StatusDriver(DrakeLcm("memq://")), rate=rate)


def test_interval_histogram_has_quantiles_and_a_maximum():
    intervals = IntervalHistogram()
    assert np.isnan(intervals.quantile(0.5))
    for seconds in [0.005] * 98 + [0.0312, 1.5]:
        intervals.add(seconds)
    assert intervals.quantile(0.5) == pytest.approx(0.005, abs=1.01e-4)
    assert intervals.quantile(0.99) == pytest.approx(0.0312, abs=1.01e-4)
    assert intervals.longest == 1.5


@pytest.mark.parametrize(
    ("sent", "count"),
    [
        ((b"one", b"one", b"two", b"one"), 3),  # a repeated message counts once
        # The first 16 bytes are type and time of a message; the others are not compared.
        ((bytes(range(16)) + b"a", bytes(range(16)) + b"b", bytes(range(15)) + b"\x00b"), 2),
    ],
)
def test_message_counter_compares_type_and_time(sent, count):
    lcm = DrakeLcm("memq://")
    messages = StatusDriver(lcm).statuses
    for message in sent:
        lcm.Publish("STATUS", message)
        lcm.HandleSubscriptions(0)
    assert messages.count == count


def test_lockstep_clock_acknowledges_repeats_without_a_step():
    lcm, acknowledgements = DrakeLcm("memq://"), []
    clock, simulator = LockstepClock(StatusDriver(lcm), 0.01), Simulator(ConstantVectorSource([0.0]))
    lcm.Subscribe("STATUS" + ACKNOWLEDGED, acknowledgements.append)
    clock.begin()
    for number in range(3):
        for _ in range(3):
            lcm.Publish("STATUS", bytes([number]) * 40)
        clock.advance(simulator, ClockRecorder(), 1)
        lcm.HandleSubscriptions(0)
    assert simulator.get_context().get_time() == 3 * STATUS_PERIOD
    # A status is acknowledged when the next status is needed.
    assert acknowledgements == [b"", *(bytes([number]) * HEAD_SIZE for number in range(2))]
    acknowledgements.clear()
    lcm.Publish("STATUS", bytes([2]) * 40)
    clock.advance(simulator, ClockRecorder(), 1)  # only a repeated status arrives: this step has no new status
    while lcm.HandleSubscriptions(0):
        pass
    assert len(acknowledgements) > 1
    assert set(acknowledgements) == {bytes([2]) * HEAD_SIZE}


def test_lockstep_server_waits_for_the_newest_acknowledgement():
    """Acknowledgements of the previous status have no effect: each status is sent three times."""
    robot_lcm, lcm, heads = DrakeLcm("memq://"), DrakeLcm("memq://"), [b"\x7f" * HEAD_SIZE]
    simulator = Simulator(SimulatedIiwa(BncWorkcell(), robot_lcm))

    def answer(message):
        heads.append(message[:HEAD_SIZE])
        distinct = list(dict.fromkeys(heads))
        is_third = heads.count(heads[-1]) >= 3
        lcm.Publish(IiwaDriver.status_channel + ACKNOWLEDGED, distinct[-1 if is_third else -2])

    lcm.Subscribe(IiwaDriver.status_channel, answer)
    simulator.Initialize()
    assert serve_in_lockstep(simulator, robot_lcm, lcm, 4 * STATUS_PERIOD, 5.0) == 4 * STATUS_PERIOD
    assert [heads[1:].count(head) for head in dict.fromkeys(heads[1:])][:4] == [3] * 4


def test_lockstep_is_independent_of_timing():
    """An answer to a status and an answer to the repeated status count for the same step."""
    positions = []
    for repetition in (1, 2):
        robot_lcm, lcm, statuses = DrakeLcm("memq://"), DrakeLcm("memq://"), []
        simulator = Simulator(SimulatedIiwa(BncWorkcell(), robot_lcm))

        def answer(message, lcm=lcm, statuses=statuses, repetition=repetition):
            statuses.append(message)
            if statuses.count(message) == repetition:
                step = len(set(statuses))
                lcm.Publish(IiwaDriver.command_channel, IiwaDriver.encode(np.full(7, (-1.0) ** step * step), step))
                lcm.Publish(IiwaDriver.status_channel + ACKNOWLEDGED, message[:HEAD_SIZE])

        lcm.Subscribe(IiwaDriver.status_channel, answer)
        simulator.Initialize()
        serve_in_lockstep(simulator, robot_lcm, lcm, 6 * STATUS_PERIOD, 5.0)
        plant = simulator.get_system().plant
        positions.append(plant.GetPositions(plant.GetMyContextFromRoot(simulator.get_context())))
    np.testing.assert_array_equal(*positions)
    assert np.abs(positions[0] - positions[0].round(1)).max() > 1e-4  # the arm has moved


def test_lockstep_server_ignores_a_malformed_acknowledgement():
    robot_lcm, lcm = DrakeLcm("memq://"), DrakeLcm("memq://")
    simulator = Simulator(SimulatedIiwa(BncWorkcell(), robot_lcm))
    lcm.Subscribe(
        IiwaDriver.status_channel, lambda message: lcm.Publish(IiwaDriver.status_channel + ACKNOWLEDGED, b"yes")
    )
    simulator.Initialize()
    assert serve_in_lockstep(simulator, robot_lcm, lcm, 2 * STATUS_PERIOD, 0.01) == 0.0


@pytest.mark.parametrize(
    ("periods", "is_reported"), [(MAX_MISSED_MESSAGES - 1, False), (MAX_MISSED_MESSAGES + 1, True)]
)
def test_real_time_server_reports_a_delay_at_most_once(monkeypatch, periods, is_reported):
    reports, num_steps = [], 0
    wall_time = 0.0
    monkeypatch.setattr("guiderail_hardware.drivers.lcm_simulated.time.monotonic", lambda: wall_time)

    def delay():
        nonlocal num_steps, wall_time
        num_steps += 1
        wall_time = (periods + num_steps) * STATUS_PERIOD

    simulator = Simulator(ConstantVectorSource([0.0]))
    serve_in_real_time(simulator, 3 * STATUS_PERIOD, delay, 1.0, reports.append)
    assert num_steps == 3
    assert len(reports) == is_reported
    assert all("give a smaller --rate" in report for report in reports)
