import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from guiderail.models.common.errors import InputError
from guiderail.models.control.keep_out import KeepOut
from guiderail.models.primitives import LinearConstraints
from guiderail.systems.safety_filter import SafetyFilter


@pytest.fixture
def system():
    """Return a safety filter with a wall at 1 < x < 2 and a margin of 0.1."""
    wall = KeepOut([[1.0, -9.0]], [[2.0, 9.0]], LinearConstraints.none(2), margin=0.1)
    return SafetyFilter(wall, period=0.1)


def start(system, desired, pose):
    """Return an initialized simulator, its context, and the values of the desired and the measured pose."""
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    ports = (
        system.get_desired_pose_input_port().FixValue(context, desired),
        system.get_pose_input_port().FixValue(context, pose),
    )
    simulator.Initialize()
    return simulator, context, *ports


def test_safety_filter_has_its_ports_and_direct_feedthrough(system):
    assert [system.get_input_port(i).get_name() for i in range(2)] == ["desired_pose", "pose"]
    assert [system.get_output_port(i).get_name() for i in range(2)] == ["safe_pose", "intervention"]
    # The measured pose is sampled at control instants, so it has no direct feedthrough.
    assert [[system.HasDirectFeedthrough(i, o) for o in range(2)] for i in range(2)] == [[True, True], [False, False]]


def test_safe_command_is_passed_through(system):
    _, context, _, _ = start(system, [0.5, 0.3], [0.0, 0.0])
    np.testing.assert_array_equal(system.get_safe_pose_output_port().Eval(context), [0.5, 0.3])
    assert system.get_intervention_output_port().Eval(context) == [0.0]


def test_command_into_the_wall_is_projected_onto_its_margin(system):
    _, context, _, _ = start(system, [3.0, 0.0], [0.0, 0.0])
    np.testing.assert_allclose(system.get_safe_pose_output_port().Eval(context), [0.9, 0.0], atol=1e-5)
    assert system.get_intervention_output_port().Eval(context) == [1.0]


def test_measured_pose_takes_effect_at_the_next_control_step(system):
    simulator, context, _, pose = start(system, [3.0, 1.0], [0.0, 0.0])
    simulator.AdvanceTo(0.05)
    before = system.get_safe_pose_output_port().Eval(context).copy()
    pose.GetMutableData().set_value([0.8, 0.9])
    simulator.AdvanceTo(0.1)
    np.testing.assert_array_equal(system.get_safe_pose_output_port().Eval(context), before)
    simulator.AdvanceTo(0.15)
    assert system.get_safe_pose_output_port().Eval(context)[1] > 0.9


def test_constructor_refuses_a_period_out_of_range():
    with pytest.raises(InputError):
        SafetyFilter(KeepOut([[0, 0]], [[1, 1]], LinearConstraints.none(2), 0.1), period=0.0)
