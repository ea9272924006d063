import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from guiderail.models.common.errors import InputError
from guiderail_hardware.systems.torque_publisher import TorquePublisher

PERIOD = 0.125


def test_torque_or_hold_is_sent_once_per_period_while_enabled():
    messages, hold_calls = [], []
    system = TorquePublisher(
        lambda torque, time: messages.append((time, *torque)), 2, period=PERIOD, hold=lambda: hold_calls.append(True)
    )
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    system.get_torque_input_port().FixValue(context, [1.0, -2.0])
    sending = system.get_is_sending_input_port().FixValue(context, [0.0])
    holding = system.get_is_holding_input_port().FixValue(context, [0.0])
    simulator.AdvanceTo(4 * PERIOD)
    assert messages == []
    sending.GetMutableData().set_value([1.0])
    simulator.AdvanceTo(7 * PERIOD)
    assert messages == [(step * PERIOD, 1.0, -2.0) for step in (5, 6, 7)]
    assert hold_calls == []
    holding.GetMutableData().set_value([1.0])
    simulator.AdvanceTo(9 * PERIOD)
    assert (len(messages), hold_calls) == (3, [True, True])


def test_torque_is_sent_when_the_driver_cannot_hold():
    message_times = []
    system = TorquePublisher(lambda torque, time: message_times.append(time), 1, period=PERIOD, hold=lambda: False)
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    for port in ("torque", "is_holding", "is_sending"):
        system.GetInputPort(port).FixValue(context, [1.0])
    simulator.AdvanceTo(PERIOD)
    assert message_times == [0.0, PERIOD]
    system.get_is_sending_input_port().FixValue(context, [0.0])
    simulator.AdvanceTo(2 * PERIOD)
    assert message_times == [0.0, PERIOD]


@pytest.mark.parametrize("arguments", [{"period": 0.0}, {"num_joints": 0}])
def test_constructor_refuses_arguments_out_of_range(arguments):
    with pytest.raises(InputError):
        TorquePublisher(print, **({"num_joints": 2, "period": PERIOD, "hold": print} | arguments))


def test_torques_of_another_size_are_refused():
    system = TorquePublisher(print, 2, period=PERIOD, hold=print)
    with pytest.raises(RuntimeError):
        system.get_torque_input_port().FixValue(system.CreateDefaultContext(), np.zeros(3))
