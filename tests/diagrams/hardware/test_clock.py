"""Who waits for whom; the wall's clock is never judged, only what is made of it."""

import numpy as np
import pytest
from pydrake.lcm import DrakeLcm
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import EventStatus, LeafSystem
from pydrake.systems.primitives import ConstantVectorSource

from guiderail.diagrams.hardware import clock as pace_module
from guiderail.diagrams.hardware.clock import IntervalHistogram, WallClock
from guiderail.diagrams.hardware.driver import STATUS_PERIOD
from guiderail.diagrams.hardware.lcm.driver import HEAD_SIZE, IiwaDriver
from guiderail.diagrams.hardware.lcm.simulated import (
    ACKNOWLEDGED,
    LockstepClock,
    SimulatedIiwa,
    serve_in_lockstep,
    serve_in_real_time,
)
from guiderail.diagrams.tasks.bnc_connector.workcell import BncWorkcell
from guiderail.models.common.errors import InputError
from guiderail.models.control.joint_status import MAX_MISSED_MESSAGES


class Statuses(IiwaDriver):
    status_channel = "STATUS"


class Told:
    def __init__(self):
        self.clocks = []

    def receive(self, context, clock=None):
        self.clocks.append(clock)


def test_a_step_for_each_status_and_without_one_after_a_while():
    lcm = DrakeLcm("memq://")
    pace, told = WallClock(Statuses(lcm)), Told()
    simulator = Simulator(ConstantVectorSource([0.0]))
    pace.begin()
    for number in range(3):
        lcm.Publish("STATUS", bytes([number]))
        pace.advance(simulator, told, 1)
    pace.advance(simulator, told, 2)  # nobody speaks: it goes on all the same
    assert simulator.get_context().get_time() == 5 * STATUS_PERIOD
    assert (np.diff(told.clocks) >= 0.5 * STATUS_PERIOD).all()
    assert (np.diff(told.clocks)[-2:] >= 1.5 * STATUS_PERIOD).all()


@pytest.mark.parametrize("milliseconds", [1, 2, 4])
def test_a_robot_that_speaks_too_often_does_not_hurry_it(monkeypatch, milliseconds):
    """On a clock of its own, on which waiting passes time and every so often a status arrives."""
    lcm, now, said = DrakeLcm("memq://"), 0.0, 0

    def speak():
        nonlocal said
        while said * milliseconds <= 1000 * now:
            lcm.Publish("STATUS", said.to_bytes(8, "big"))
            said += 1

    def sleep(seconds):
        nonlocal now
        now += seconds
        speak()

    class Bus:
        def Subscribe(self, *arguments):
            return lcm.Subscribe(*arguments)

        def HandleSubscriptions(self, timeout):
            if not lcm.HandleSubscriptions(0) and timeout:
                sleep(1e-3)
                lcm.HandleSubscriptions(0)

    monkeypatch.setattr(pace_module.time, "monotonic", lambda: now)
    monkeypatch.setattr(pace_module.time, "sleep", sleep)
    pace, told = WallClock(Statuses(Bus())), Told()
    simulator = Simulator(ConstantVectorSource([0.0]))
    pace.begin()
    pace.advance(simulator, told, 400)
    assert told.clocks[-1] >= 399 * STATUS_PERIOD
    # Held up once, it makes up for nothing: it is half a step ahead at most.
    now += 1.0
    pace.advance(simulator, told, 200)
    assert told.clocks[-1] >= told.clocks[399] + 1.0 + 198.5 * STATUS_PERIOD - 1e-9


def test_what_happens_at_an_instant_knows_the_clock_of_that_instant():
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


def test_a_slower_clock_is_told_as_such():
    slow, fast = Told(), Told()
    for told, rate in ((slow, 0.25), (fast, 1.0)):
        pace = WallClock(Statuses(DrakeLcm("memq://")), rate=rate)
        pace.advance(Simulator(ConstantVectorSource([0.0])), told, 2)
    assert slow.clocks[1] - slow.clocks[0] >= 1.5 * STATUS_PERIOD
    assert slow.clocks[0] == pytest.approx(0.25 * fast.clocks[0], rel=0.01)
    for rate in (0.0, 1.1, np.nan):
        with pytest.raises(InputError, match="rate up to 1 of the wall's"):
            WallClock(Statuses(DrakeLcm("memq://")), rate=rate)


def test_a_message_that_is_sent_again_counts_once():
    lcm = DrakeLcm("memq://")
    messages = Statuses(lcm).statuses
    for message in (b"one", b"one", b"two", b"one"):
        lcm.Publish("STATUS", message)
        lcm.HandleSubscriptions(0)
    assert messages.count == 3


def test_gaps_are_counted_without_being_kept():
    gaps = IntervalHistogram()
    assert np.isnan(gaps.quantile(0.5))
    for seconds in [0.005] * 98 + [0.0312, 1.5]:
        gaps.add(seconds)
    assert gaps.quantile(0.5) == pytest.approx(0.005, abs=1.01e-4)
    assert gaps.quantile(0.99) == pytest.approx(0.0312, abs=1.01e-4)
    assert gaps.longest == 1.5


def test_a_status_that_is_sent_again_with_other_torques_is_no_new_one():
    lcm = DrakeLcm("memq://")
    messages = Statuses(lcm).statuses
    head = bytes(range(16))
    for message in (head + b"a", head + b"b", head[:-1] + b"\x00" + b"b"):
        lcm.Publish("STATUS", message)
        lcm.HandleSubscriptions(0)
    assert messages.count == 2


def test_in_step_a_status_that_comes_again_is_answered_again_and_is_no_step():
    lcm, words = DrakeLcm("memq://"), []
    pace, simulator = LockstepClock(Statuses(lcm), 0.01), Simulator(ConstantVectorSource([0.0]))
    lcm.Subscribe("STATUS" + ACKNOWLEDGED, words.append)
    pace.begin()
    for number in range(3):
        for _ in range(3):
            lcm.Publish("STATUS", bytes([number]) * 40)
        pace.advance(simulator, Told(), 1)
        lcm.HandleSubscriptions(0)
    assert simulator.get_context().get_time() == 3 * STATUS_PERIOD
    # What is asked for is the status after this one, and not before anybody wants it.
    assert words == [b"", *(bytes([number]) * HEAD_SIZE for number in range(2))]
    words.clear()
    lcm.Publish("STATUS", bytes([2]) * 40)
    pace.advance(simulator, Told(), 1)  # nobody speaks but of what is known: the word was lost, and it goes on without
    while lcm.HandleSubscriptions(0):
        pass
    assert len(words) > 1
    assert set(words) == {bytes([2]) * HEAD_SIZE}


def test_a_robot_in_step_waits_for_the_word_about_its_own_status():
    """Words about the one before, which was sent again meanwhile, move it no further."""
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


def test_in_step_it_does_not_matter_who_is_faster():
    """An answer to the first status that says so, or to its repetition, counts for the same step."""
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


def test_a_word_that_is_none_answers_nothing():
    within, lcm = DrakeLcm("memq://"), DrakeLcm("memq://")
    simulator = Simulator(SimulatedIiwa(BncWorkcell(), within))
    lcm.Subscribe(
        IiwaDriver.status_channel, lambda message: lcm.Publish(IiwaDriver.status_channel + ACKNOWLEDGED, b"yes")
    )
    simulator.Initialize()
    assert serve_in_lockstep(simulator, within, lcm, 2 * STATUS_PERIOD, 0.01) == 0.0


@pytest.mark.parametrize(("periods", "says"), [(MAX_MISSED_MESSAGES - 1, False), (MAX_MISSED_MESSAGES + 1, True)])
def test_a_simulated_robot_that_falls_behind_its_clock_says_so_once(monkeypatch, periods, says):
    said, wall = [], [0.0]
    monkeypatch.setattr("guiderail.diagrams.hardware.lcm.simulated.time.monotonic", lambda: wall[0])

    def attend():
        attended.append(True)
        wall[0] = (periods + len(attended)) * STATUS_PERIOD

    attended = []
    simulator = Simulator(ConstantVectorSource([0.0]))
    serve_in_real_time(simulator, 3 * STATUS_PERIOD, attend, 1.0, said.append)
    assert len(attended) == 3
    assert bool(said) == says
    assert len(said) <= 1
    assert all("give a smaller --rate" in words for words in said)
