import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.systems.analysis import Simulator

from guiderail.models.common.errors import InputError
from guiderail_hardware.models.joint_status import MAX_SENDERS, Fault, Heartbeat
from guiderail_hardware.systems.heartbeat_monitor import FORGET_TIME, HeartbeatMonitor

PERIOD, TIMEOUT = 0.125, 0.5


class Rig:
    """Heartbeat monitor whose heartbeats are set before each step."""

    def __init__(self, period=PERIOD):
        self.system, self.period = HeartbeatMonitor(period=period, timeout=TIMEOUT), period
        self.simulator = Simulator(self.system)
        self.context = self.simulator.get_mutable_context()
        self.heartbeats = self.system.get_heartbeats_input_port().FixValue(self.context, Value[object]())
        self.status_fault = self.system.get_status_fault_input_port().FixValue(self.context, [0.0])
        self.simulator.Initialize()
        self.num_steps = 0

    def set(self, *heartbeats):
        self.heartbeats.GetMutableData().set_value(heartbeats)

    def step(self, *heartbeats):
        """Set the heartbeats, return the fault, and advance to the next check."""
        self.set(*heartbeats)
        fault = self.fault
        self.num_steps += 1
        self.simulator.AdvanceTo(self.num_steps * self.period)
        return fault

    @property
    def fault(self):
        return Fault(int(self.system.get_fault_output_port().Eval(self.context).item()))

    @property
    def is_alive(self):
        return self.system.is_alive(self.context)


def test_no_fault_is_raised_before_the_first_heartbeat():
    rig = Rig()
    assert {rig.step() for _ in range(10)} == {Fault.NONE}
    assert not rig.is_alive
    rig.heartbeats.GetMutableData().set_value(object())
    assert rig.fault == Fault.NONE


def test_fault_is_raised_while_a_monitor_is_stopping():
    rig = Rig()
    assert rig.step(Heartbeat(1, False)) == Fault.NONE
    assert rig.step(Heartbeat(2, True)) == Fault.MONITOR_STOP
    assert rig.step(Heartbeat(2, True), Heartbeat(1, False, 5)) == Fault.MONITOR_STOP
    assert rig.step(Heartbeat(3, False), Heartbeat(2, True, 5)) == Fault.MONITOR_STOP
    assert rig.step(Heartbeat(4, False), Heartbeat(3, False, 5)) == Fault.NONE


def test_fault_is_raised_when_the_heartbeat_times_out():
    """The ages are 0, 1, … periods. An age of four periods equals the timeout and is no fault."""
    rig = Rig()
    faults = [rig.step(Heartbeat(1, False)) for _ in range(20)]
    assert faults == [Fault.NONE] * 5 + [Fault.MONITOR_STOP] * 15
    assert not rig.is_alive
    assert rig.step(Heartbeat(2, False)) == Fault.NONE
    assert rig.is_alive


@pytest.mark.parametrize(("age", "is_alive"), [(TIMEOUT, True), (1.0005 * TIMEOUT, False)])
def test_monitor_is_alive_up_to_the_timeout(age, is_alive):
    rig = Rig(period=age)
    rig.step(Heartbeat(1, False))
    assert rig.is_alive == is_alive
    assert rig.fault == (Fault.NONE if is_alive else Fault.MONITOR_STOP)


def test_monitor_is_alive_when_sequence_numbers_are_large():
    rig = Rig()
    assert {rig.step(Heartbeat(10**6 + k, False)) for k in range(10)} == {Fault.NONE}


@pytest.mark.parametrize("sequence", [4, 5])
def test_repeated_or_older_heartbeat_does_not_prevent_a_timeout(sequence):
    rig = Rig()
    rig.step(Heartbeat(5, False))
    for _ in range(5):
        rig.step(Heartbeat(sequence, False))
    assert rig.fault == Fault.MONITOR_STOP


def test_missing_monitor_is_a_fault_while_another_is_alive():
    rig = Rig()
    rig.step(Heartbeat(1, False, 7), Heartbeat(1, False, 8))
    faults = [rig.step(Heartbeat(1, False, 7), Heartbeat(2 + k, False, 8)) for k in range(12)]
    assert faults[:4] == [Fault.NONE] * 4
    fault_steps = round(FORGET_TIME / PERIOD) - 4
    assert faults[4 : 4 + fault_steps] == [Fault.MONITOR_STOP] * fault_steps
    assert set(faults[4 + fault_steps :]) == {Fault.NONE}  # the missing monitor is forgotten
    assert rig.is_alive
    # If the forgotten monitor sends a heartbeat, its next timeout is a fault.
    rig.step(Heartbeat(2, False, 7), Heartbeat(90, False, 8))
    faults = [rig.step(Heartbeat(2, False, 7), Heartbeat(91 + k, False, 8)) for k in range(5)]
    assert faults == [Fault.NONE] * 4 + [Fault.MONITOR_STOP]


@pytest.mark.parametrize(("age", "fault"), [(1.0, Fault.MONITOR_STOP), (1.0005, Fault.NONE)])
def test_silent_monitor_is_forgotten_after_the_forget_time(age, fault):
    rig = Rig(period=age)
    rig.step(Heartbeat(1, False, 7), Heartbeat(1, False, 8))
    assert rig.step(Heartbeat(1, False, 7), Heartbeat(2, False, 8)) == fault


def test_only_monitor_is_never_forgotten():
    rig = Rig()
    for _ in range(100):
        rig.step(Heartbeat(1, False, 7))
    assert rig.fault == Fault.MONITOR_STOP


def test_stop_ends_when_the_missing_monitor_is_forgotten():
    rig = Rig()
    rig.step(Heartbeat(1, True, 7), Heartbeat(1, False, 8))
    for k in range(20):
        fault = rig.step(Heartbeat(1, True, 7), Heartbeat(2 + k, False, 8))
    assert fault == Fault.NONE


def test_number_of_senders_is_limited_to_the_newest():
    rig = Rig()
    for sender in range(3 * MAX_SENDERS):
        rig.step(Heartbeat(1, False, sender))
        senders = rig.context.get_discrete_state(0).value()[::3]
        stored = sorted(senders[np.isfinite(senders)].tolist())
        assert stored == list(range(max(sender + 1 - MAX_SENDERS, 0), sender + 1))
    assert rig.is_alive


def test_initialization_forgets_all_monitors():
    rig = Rig()
    rig.step(Heartbeat(1, False))
    rig.set()
    rig.simulator.Initialize()
    assert not rig.is_alive


def test_status_fault_takes_precedence():
    rig = Rig()
    rig.status_fault.GetMutableData().set_value([float(Fault.STALE)])
    assert rig.step(Heartbeat(1, True)) == Fault.STALE


@pytest.mark.parametrize(
    "arguments", [{"period": 0.0}, {"timeout": 0.0}, {"timeout": np.nan}, {"timeout": np.inf}, {"timeout": FORGET_TIME}]
)
def test_constructor_refuses_arguments_out_of_range(arguments):
    with pytest.raises(InputError):
        HeartbeatMonitor(**{"period": PERIOD, "timeout": TIMEOUT} | arguments)
    HeartbeatMonitor(period=PERIOD, timeout=0.9995 * FORGET_TIME)
