import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource, TrajectorySource, ZeroOrderHold
from pydrake.trajectories import PiecewisePolynomial

from guiderail.models.common.errors import InputError
from guiderail.systems import CommandDisturbance

PERIOD, POSE = 0.125, -5.0  # control period [s] and measured pose


def delivered_commands(steps=12, seed=0, first=0.0, **options):
    """Return the delivered command of each control step if the command is `first` plus the number of the step."""
    builder = DiagramBuilder()
    ramp = TrajectorySource(PiecewisePolynomial.FirstOrderHold([0.0, 500.0 * PERIOD], [[first, first + 500.0]]))
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
        simulator.AdvanceTo(step * PERIOD)  # before the events of this instant, the command is that of step − 1
        outputs.append(line.get_delivered_command_output_port().Eval(context)[0])
    return np.array(outputs)


def test_measured_pose_must_be_finite_at_initialization(monkeypatch):
    monkeypatch.setattr(f"{__name__}.POSE", np.nan)
    with pytest.raises(InputError, match="measured pose must be finite"):
        delivered_commands()


def test_commands_are_unchanged_without_disturbance():
    np.testing.assert_allclose(delivered_commands(), np.arange(12.0), atol=1e-9)


@pytest.mark.parametrize("delay", [1, 2, 5])
def test_commands_arrive_after_the_delay(delay):
    """The first command is 7. The 0 that the hold outputs before its first update must not be delivered."""
    outputs = delivered_commands(first=7.0, delay=delay)
    np.testing.assert_array_equal(outputs[:delay], POSE)
    np.testing.assert_allclose(outputs[delay:], 7.0 + np.arange(12.0 - delay), atol=1e-9)


def test_measured_pose_replaces_a_lost_first_command():
    first_commands = [delivered_commands(1, seed, first=7.0, loss_probability=0.5)[0] for seed in range(20)]
    assert set(first_commands) == {POSE, 7.0}


def test_lost_command_is_replaced_by_the_last_delivered_one():
    outputs = delivered_commands(400, loss_probability=0.3, seed=1)
    is_lost = np.abs(outputs - np.arange(400.0)) > 1e-6
    assert 0.2 < is_lost.mean() < 0.4
    for step in np.flatnonzero(is_lost[1:]) + 1:
        assert outputs[step] == outputs[step - 1]
    np.testing.assert_array_equal(delivered_commands(400, loss_probability=0.3, seed=1), outputs)
    assert not np.array_equal(delivered_commands(400, loss_probability=0.3, seed=2), outputs)


def test_losses_depend_on_seed_and_step_and_repeat_after_reset():
    system = CommandDisturbance(1, PERIOD, loss_probability=0.4)
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    command = system.get_command_input_port().FixValue(context, [POSE])
    system.get_pose_input_port().FixValue(context, [POSE])
    expected = [np.random.default_rng([0, count]).uniform() < 0.4 for count in range(1, 1028)]
    assert expected[-1]
    for _ in range(2):  # the default seed is 0
        context.SetTime(0.0)
        simulator.Initialize()
        command.GetMutableData().set_value([9999.0])
        assert system.get_delivered_command_output_port().Eval(context)[0] == 9999.0  # no loss before a step
        is_lost = []
        for step in range(1027):
            simulator.AdvanceTo((step + 0.5) * PERIOD)
            command.GetMutableData().set_value([float(step)])
            is_lost.append(system.get_delivered_command_output_port().Eval(context)[0] != step)
        assert is_lost == expected


@pytest.mark.parametrize(("share", "is_lost"), [(0.9995, False), (1.0005, True)])
def test_command_is_lost_when_its_sample_is_below_probability(share, is_lost):
    sample = np.random.default_rng([3, 1]).uniform()
    output = delivered_commands(1, seed=3, first=7.0, loss_probability=share * sample)[0]
    assert output == (POSE if is_lost else 7.0)


def test_loss_probability_slightly_below_one_is_accepted():
    np.testing.assert_array_equal(delivered_commands(3, loss_probability=0.9995), POSE)
