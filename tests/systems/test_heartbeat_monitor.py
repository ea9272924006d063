import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.systems.analysis import Simulator

from guiderail.models.common.errors import InputError
from guiderail.models.control.joint_status import Fault, Heartbeat
from guiderail.systems.heartbeat_monitor import HeartbeatMonitor

PERIOD, TIMEOUT = 0.125, 0.5


class Rig:
    """Monitor with a heartbeat input that is set before each step."""

    def __init__(self):
        self.system = HeartbeatMonitor(period=PERIOD, timeout=TIMEOUT)
        self.simulator = Simulator(self.system)
        self.context = self.simulator.get_mutable_context()
        self.heartbeat = self.system.get_heartbeat_input_port().FixValue(self.context, Value[object]())
        self.status_fault = self.system.get_status_fault_input_port().FixValue(self.context, [0.0])
        self.simulator.Initialize()
        self.num_steps = 0

    def step(self, heartbeat):
        self.heartbeat.GetMutableData().set_value(heartbeat or object())
        self.num_steps += 1
        self.simulator.AdvanceTo(self.num_steps * PERIOD)
        return self.fault

    @property
    def fault(self):
        return Fault(int(self.system.get_fault_output_port().Eval(self.context)[0]))


def test_no_fault_before_the_first_heartbeat():
    rig = Rig()
    assert {rig.step(None) for _ in range(10)} == {Fault.NONE}
    assert not rig.system.is_alive(rig.context)


def test_fault_is_raised_while_the_monitor_is_stopping():
    rig = Rig()
    assert rig.step(Heartbeat(1, False)) == Fault.NONE
    rig.heartbeat.GetMutableData().set_value(Heartbeat(2, True))
    assert rig.fault == Fault.MONITOR_STOP
    assert rig.step(Heartbeat(3, True)) == Fault.MONITOR_STOP
    assert rig.step(Heartbeat(4, False)) == Fault.NONE


def test_fault_is_raised_when_the_heartbeat_times_out():
    rig = Rig()
    rig.step(Heartbeat(1, False))
    faults = [rig.step(Heartbeat(1, False)) for _ in range(6)]
    assert faults == [Fault.NONE] * 4 + [Fault.MONITOR_STOP] * 2
    assert rig.step(Heartbeat(1, False)) == Fault.MONITOR_STOP
    assert not rig.system.is_alive(rig.context)
    assert rig.step(Heartbeat(2, False)) == Fault.NONE
    assert rig.system.is_alive(rig.context)


def test_status_fault_takes_precedence():
    rig = Rig()
    rig.status_fault.GetMutableData().set_value([float(Fault.STALE)])
    assert rig.step(Heartbeat(1, True)) == Fault.STALE


@pytest.mark.parametrize("wrong", [{"period": 0.0}, {"timeout": 0.0}, {"timeout": np.nan}])
def test_constructor_refuses_arguments_out_of_range(wrong):
    with pytest.raises(InputError):
        HeartbeatMonitor(**{"period": PERIOD, "timeout": TIMEOUT} | wrong)
