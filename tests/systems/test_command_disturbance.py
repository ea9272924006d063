import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource, TrajectorySource, ZeroOrderHold
from pydrake.trajectories import PiecewisePolynomial

from guiderail.models.common.errors import InputError
from guiderail.systems import CommandDisturbance

PERIOD, POSE = 0.125, -5.0


def delivered(steps=12, seed=0, **options):
    """Return the delivered commands of each period, for commands that count the periods."""
    builder = DiagramBuilder()
    ramp = TrajectorySource(PiecewisePolynomial.FirstOrderHold([0.0, 500.0 * PERIOD], [[0.0, 500.0]]))
    ramp = builder.AddSystem(ramp)
    hold = builder.AddSystem(ZeroOrderHold(PERIOD, 1))
    pose = builder.AddSystem(ConstantVectorSource([POSE]))
    line = builder.AddSystem(CommandDisturbance(1, PERIOD, **options))
    builder.Connect(ramp.get_output_port(), hold.get_input_port())
    builder.Connect(hold.get_output_port(), line.get_command_input_port())
    builder.Connect(pose.get_output_port(), line.get_pose_input_port())
    simulator = Simulator(builder.Build())
    context = line.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    line.set_seed(context, seed)
    simulator.Initialize()
    outputs = []
    for step in range(1, steps + 1):
        simulator.AdvanceTo(step * PERIOD)  # before the events of that instant: command step − 1
        outputs.append(line.get_delivered_command_output_port().Eval(context)[0])
    return np.array(outputs)


def test_every_command_is_delivered_without_disturbance():
    np.testing.assert_allclose(delivered(), np.arange(12.0), atol=1e-9)


def test_commands_arrive_later_by_the_delay():
    outputs = delivered(delay=2)
    np.testing.assert_allclose(outputs[2:], np.arange(10.0), atol=1e-9)
    assert outputs[0] == POSE


def test_lost_command_is_replaced_by_the_last_delivered_one():
    outputs = delivered(400, loss_probability=0.3, seed=1)
    lost = np.abs(outputs - np.arange(400.0)) > 1e-6
    assert 0.2 < lost.mean() < 0.4
    for step in np.flatnonzero(lost[1:]) + 1:
        assert outputs[step] == outputs[step - 1]
    np.testing.assert_array_equal(delivered(400, loss_probability=0.3, seed=1), outputs)
    assert not np.array_equal(delivered(400, loss_probability=0.3, seed=2), outputs)


@pytest.mark.parametrize("wrong", [{"loss_probability": 1.0}, {"loss_probability": -0.1}, {"delay": -1}])
def test_constructor_refuses_arguments_out_of_range(wrong):
    with pytest.raises(InputError):
        CommandDisturbance(1, PERIOD, **wrong)
