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
    """What arrives in each period, of commands that count the periods."""
    builder = DiagramBuilder()
    ramp = TrajectorySource(PiecewisePolynomial.FirstOrderHold([0.0, 500.0 * PERIOD], [[0.0, 500.0]]))
    ramp = builder.AddSystem(ramp)
    action_repeat = builder.AddSystem(ZeroOrderHold(PERIOD, 1))
    pose = builder.AddSystem(ConstantVectorSource([POSE]))
    line = builder.AddSystem(CommandDisturbance(1, PERIOD, **options))
    builder.Connect(ramp.get_output_port(), action_repeat.get_input_port())
    builder.Connect(action_repeat.get_output_port(), line.get_command_input_port())
    builder.Connect(pose.get_output_port(), line.get_pose_input_port())
    simulator = Simulator(builder.Build())
    context = line.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    line.set_seed(context, seed)
    simulator.Initialize()
    found = []
    for step in range(1, steps + 1):
        simulator.AdvanceTo(step * PERIOD)  # before the events of that instant: command step − 1
        found.append(line.get_delivered_command_output_port().Eval(context)[0])
    return np.array(found)


def test_a_good_line_delivers_every_command():
    np.testing.assert_allclose(delivered(), np.arange(12.0), atol=1e-9)


def test_late_commands_come_whole_periods_later_and_before_them_the_robot_stays():
    found = delivered(delay=2)
    np.testing.assert_allclose(found[2:], np.arange(10.0), atol=1e-9)
    assert found[0] == POSE


def test_a_lost_command_leaves_the_last_one_that_arrived():
    found = delivered(400, loss_probability=0.3, seed=1)
    lost = np.abs(found - np.arange(400.0)) > 1e-6
    assert 0.2 < lost.mean() < 0.4
    for step in np.flatnonzero(lost[1:]) + 1:
        assert found[step] == found[step - 1]
    np.testing.assert_array_equal(delivered(400, loss_probability=0.3, seed=1), found)
    assert not np.array_equal(delivered(400, loss_probability=0.3, seed=2), found)


@pytest.mark.parametrize("wrong", [{"loss_probability": 1.0}, {"loss_probability": -0.1}, {"delay": -1}])
def test_what_makes_no_sense_is_refused(wrong):
    with pytest.raises(InputError):
        CommandDisturbance(1, PERIOD, **wrong)
