"""Who waits for whom; the wall's clock is never judged, only what is made of it."""

import numpy as np
import pytest
from pydrake.lcm import DrakeLcm
from pydrake.systems.analysis import Simulator
from pydrake.systems.primitives import ConstantVectorSource

from guiderail.diagrams.stations.driver import STATUS_PERIOD
from guiderail.diagrams.stations.pace import Gaps, NewMessages, RealTime
from guiderail.models.errors import InputError


class Told:
    def __init__(self):
        self.clocks = []

    def tell_time(self, context, clock):
        self.clocks.append(clock)


def test_a_step_for_each_status_and_without_one_after_a_while():
    lcm = DrakeLcm("memq://")
    pace, told = RealTime(lcm, "STATUS"), Told()
    simulator = Simulator(ConstantVectorSource([0.0]))
    pace.begin()
    for number in range(3):
        lcm.Publish("STATUS", bytes([number]))
        pace.advance(simulator, told, 1)
    pace.advance(simulator, told, 2)  # nobody speaks: it goes on all the same
    assert simulator.get_context().get_time() == 5 * STATUS_PERIOD
    assert (np.diff(told.clocks) >= 0.5 * STATUS_PERIOD).all()
    assert (np.diff(told.clocks)[-2:] >= 1.5 * STATUS_PERIOD).all()


def test_a_slower_clock_is_told_as_such():
    slow, fast = Told(), Told()
    for told, rate in ((slow, 0.25), (fast, 1.0)):
        pace = RealTime(DrakeLcm("memq://"), "STATUS", rate=rate)
        pace.advance(Simulator(ConstantVectorSource([0.0])), told, 2)
    assert slow.clocks[1] - slow.clocks[0] >= 1.5 * STATUS_PERIOD
    assert slow.clocks[0] == pytest.approx(0.25 * fast.clocks[0], rel=0.01)
    for rate in (0.0, 1.1, np.nan):
        with pytest.raises(InputError, match="goes as the wall's"):
            RealTime(DrakeLcm("memq://"), "STATUS", rate=rate)


def test_a_message_that_is_sent_again_counts_once():
    lcm = DrakeLcm("memq://")
    messages = NewMessages(lcm, "STATUS")
    for message in (b"one", b"one", b"two", b"one"):
        lcm.Publish("STATUS", message)
        lcm.HandleSubscriptions(0)
    assert messages.count == 3


def test_gaps_are_counted_without_being_kept():
    gaps = Gaps()
    assert np.isnan(gaps.quantile(0.5))
    for seconds in [0.005] * 98 + [0.0312, 1.5]:
        gaps.add(seconds)
    assert gaps.quantile(0.5) == pytest.approx(0.005, abs=1.01e-4)
    assert gaps.quantile(0.99) == pytest.approx(0.0312, abs=1.01e-4)
    assert gaps.longest == 1.5


def test_a_status_that_is_sent_again_with_other_torques_is_no_new_one():
    lcm = DrakeLcm("memq://")
    messages = NewMessages(lcm, "STATUS")
    head = bytes(range(16))
    for message in (head + b"a", head + b"b", head[:-1] + b"\x00" + b"b"):
        lcm.Publish("STATUS", message)
        lcm.HandleSubscriptions(0)
    assert messages.count == 2
