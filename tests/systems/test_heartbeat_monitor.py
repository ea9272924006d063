import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.systems.analysis import Simulator

from guiderail.models.common.errors import InputError
from guiderail.models.control.joint_status import Fault, Heartbeat
from guiderail.systems.heartbeat_monitor import HeartbeatMonitor

PERIOD, PATIENCE = 0.125, 0.5


class SupervisedTraining:
    def __init__(self):
        self.system = HeartbeatMonitor(period=PERIOD, command_timeout=PATIENCE)
        self.simulator = Simulator(self.system)
        self.context = self.simulator.get_mutable_context()
        self.word = self.system.get_word_input_port().FixValue(self.context, Value[object]())
        self.status_fault = self.system.get_status_fault_input_port().FixValue(self.context, [0.0])
        self.simulator.Initialize()
        self.step = 0

    def hear(self, word):
        self.word.GetMutableData().set_value(word or object())
        self.step += 1
        self.simulator.AdvanceTo(self.step * PERIOD)
        return self.fault

    @property
    def fault(self):
        return Fault(int(self.system.get_fault_output_port().Eval(self.context)[0]))


def test_a_deputy_that_was_never_heard_is_not_missed():
    watched = SupervisedTraining()
    assert {watched.hear(None) for _ in range(10)} == {Fault.NONE}


def test_says_that_the_deputy_acts_at_once_and_as_long():
    watched = SupervisedTraining()
    assert watched.hear(Heartbeat(1, False)) == Fault.NONE
    watched.word.GetMutableData().set_value(Heartbeat(2, True))
    assert watched.fault == Fault.MONITOR_STOP
    assert watched.hear(Heartbeat(3, True)) == Fault.MONITOR_STOP
    assert watched.hear(Heartbeat(4, False)) == Fault.NONE


def test_misses_a_deputy_that_fell_silent_until_it_is_back():
    watched = SupervisedTraining()
    watched.hear(Heartbeat(1, False))
    heard = [watched.hear(Heartbeat(1, False)) for _ in range(6)]
    assert heard == [Fault.NONE] * 4 + [Fault.MONITOR_STOP] * 2
    assert watched.hear(Heartbeat(1, False)) == Fault.MONITOR_STOP
    assert watched.hear(Heartbeat(2, False)) == Fault.NONE


def test_a_fault_of_the_status_comes_first():
    watched = SupervisedTraining()
    watched.status_fault.GetMutableData().set_value([float(Fault.STALE)])
    assert watched.hear(Heartbeat(1, True)) == Fault.STALE


@pytest.mark.parametrize("wrong", [{"period": 0.0}, {"patience": 0.0}, {"patience": np.nan}])
def test_refuses_what_makes_no_sense(wrong):
    with pytest.raises(InputError):
        HeartbeatMonitor(**{"period": PERIOD, "patience": PATIENCE} | wrong)
