import struct

import numpy as np
import pytest
from pydrake.lcm import DrakeLcm
from pydrake.systems.analysis import Simulator

from guiderail.models.common.errors import InputError
from guiderail.systems.torque_publisher import TorquePublisher

PERIOD = 0.125


def encode(time, torque):
    return struct.pack("3d", time, *torque)


def test_sends_once_a_period_while_it_may_and_nothing_otherwise():
    lcm, heard = DrakeLcm("memq://"), []
    lcm.Subscribe("torques", lambda message: heard.append(struct.unpack("3d", message)))
    system = TorquePublisher(lcm, "torques", encode, 2, period=PERIOD)
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    system.get_torque_input_port().FixValue(context, [1.0, -2.0])
    sending = system.get_is_sending_input_port().FixValue(context, [0.0])
    simulator.AdvanceTo(4 * PERIOD)
    lcm.HandleSubscriptions(0)
    assert heard == []
    sending.GetMutableData().set_value([1.0])
    simulator.AdvanceTo(7 * PERIOD)
    while lcm.HandleSubscriptions(0):
        pass
    assert heard == [(step * PERIOD, 1.0, -2.0) for step in (5, 6, 7)]


@pytest.mark.parametrize("wrong", [{"period": 0.0}, {"num_joints": 0}])
def test_refuses_what_makes_no_sense(wrong):
    with pytest.raises(InputError):
        TorquePublisher(DrakeLcm("memq://"), "torques", encode, **({"num_joints": 2, "period": PERIOD} | wrong))


def test_torques_are_what_it_was_made_for():
    system = TorquePublisher(DrakeLcm("memq://"), "torques", encode, 2, period=PERIOD)
    with pytest.raises(RuntimeError):
        system.get_torque_input_port().FixValue(system.CreateDefaultContext(), np.zeros(3))
