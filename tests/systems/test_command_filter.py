import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from guiderail.models.common.errors import InputError
from guiderail.models.control.command_filters import BarrierFilter, KeepOut, KeepOutFilter, TangentSpaceFilter
from guiderail.models.control.motion_constraints import MotionConstraintFilter, MotionConstraints
from guiderail.models.primitives import LinearConstraints
from guiderail.systems.command_checks import CommandFilter

PERIOD = 0.125
BOX = LinearConstraints.box([-1.0, -np.inf], [1.0, np.inf])
WALL = ([[0.5, 2.0]], [[9.0, 3.0]])  # keep-out box 0.5 < x < 9, 2 < y < 3
KEEP_OUT = KeepOut(*WALL, BOX, margin=0.1)
LAWS = {"barrier": BarrierFilter(KEEP_OUT, 0.3), "tangent": TangentSpaceFilter(KEEP_OUT, 0.2)}


def clearance(point):
    """Return the distance to the nearest bound or face of the wall minus the margin of 0.1; negative if violated."""
    wall_distance = max(0.5 - point[0], 2.0 - point[1], point[1] - 3.0)
    return min(0.9 - abs(point[0]), wall_distance - 0.1)


@pytest.mark.parametrize("law", LAWS.values(), ids=LAWS)
def test_commands_satisfy_constraints_for_random_inputs(law):
    rng = np.random.default_rng(0)
    last, smallest = np.array([0.0, 0.0]), np.inf
    for _ in range(3000):
        desired = last + rng.normal(0.0, rng.choice([0.01, 0.3, 5.0]), 2) + [0.02, 0.02]
        last, _ = law.apply(last, desired)
        smallest = min(smallest, clearance(last))
    assert -1e-8 < smallest < 0.02  # a constraint was reached, and none was violated


def test_slack_decreases_at_most_by_the_decay_of_the_barrier():
    last = np.array([0.0, 0.0])
    command, is_changed = LAWS["barrier"].apply(last, np.array([5.0, 0.0]))
    assert is_changed
    np.testing.assert_allclose(command, [0.3 * 0.9, 0.0], atol=1e-9)
    allowed = np.array([0.3 * 0.9 - 1e-6, 0.0])
    command, is_changed = LAWS["barrier"].apply(last, allowed)
    assert not is_changed
    np.testing.assert_array_equal(command, allowed)


def test_barrier_with_full_decay_is_a_projection():
    law = BarrierFilter(KeepOut(np.empty((0, 2)), np.empty((0, 2)), BOX, margin=0.0), 1.0)
    np.testing.assert_allclose(law.apply(np.zeros(2), np.array([3.0, 4.0]))[0], [1.0, 4.0], atol=1e-9)


def test_tangent_space_scales_the_normal_step_by_the_slack():
    law, step = LAWS["tangent"], np.array([0.05, 0.05])
    at_bound, _ = law.apply(np.array([0.9, 0.0]), np.array([0.9, 0.0]) + step)
    np.testing.assert_allclose(at_bound, [0.9, 0.05], atol=1e-3)
    near_bound, _ = TangentSpaceFilter(KeepOut(np.empty((0, 2)), np.empty((0, 2)), BOX, margin=0.0), 0.2).apply(
        np.array([0.8, 0.0]), np.array([0.85, 0.0])
    )
    assert near_bound[0] == pytest.approx(0.8 + 0.5 * 0.05, abs=1e-3)  # the slack equals the width: half of the step
    law = TangentSpaceFilter(KEEP_OUT, 1e-3)
    np.testing.assert_allclose(law.apply(np.zeros(2), step)[0], step, atol=1e-6)


@pytest.mark.parametrize("law", LAWS.values(), ids=LAWS)
def test_command_moves_inside_when_it_starts_outside(law):
    command = np.array([1.4, 0.0])
    positions = [1.4]
    for _ in range(40):
        command, _ = law.apply(command, np.array([0.0, 0.0]))
        positions.append(command[0])
    assert positions[-1] <= 0.9
    assert (np.diff(positions) <= 1e-9).all()


@pytest.mark.parametrize("desired", [[np.nan, 0.0], [np.inf, 0.0]])
@pytest.mark.parametrize(
    "keep_out", [KEEP_OUT, KeepOut(np.empty((0, 2)), np.empty((0, 2)), LinearConstraints.none(2), 0.0)]
)
def test_last_command_is_repeated_when_desired_is_not_finite(keep_out, desired):
    for law in (BarrierFilter(keep_out, 0.3), TangentSpaceFilter(keep_out, 0.2)):
        command, is_changed = law.apply(np.array([0.1, 0.2]), np.array(desired))
        np.testing.assert_array_equal(command, [0.1, 0.2])
        assert is_changed


def test_system_filters_from_measured_pose_then_last_command():
    system = CommandFilter(LAWS["barrier"], PERIOD)
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    desired = system.get_desired_pose_input_port().FixValue(context, [5.0, 0.0])
    pose = system.get_pose_input_port().FixValue(context, [0.4, 0.0])
    simulator.Initialize()
    pose.GetMutableData().set_value([0.0, 0.0])  # without effect after the initialization
    initial_slack, commands = 0.5, []
    for step in range(3):
        simulator.AdvanceTo((step + 0.5) * PERIOD)
        commands.append(system.get_safe_pose_output_port().Eval(context)[0])
    np.testing.assert_allclose(commands, 0.9 - initial_slack * 0.7 ** np.arange(1, 4), atol=1e-9)
    assert system.get_intervention_output_port().Eval(context)[0] == 1.0
    desired.GetMutableData().set_value([0.6, 0.0])
    assert system.get_intervention_output_port().Eval(context)[0] == 0.0
    simulator.Initialize()
    assert system.get_safe_pose_output_port().Eval(context)[0] == pytest.approx(0.3 * 0.9)


class PassThrough:
    """User-defined law that returns the desired command."""

    num_outputs = 2

    def apply(self, last, desired, pose):
        return desired.copy(), False

    def start(self, pose):
        return pose.copy()


@pytest.mark.parametrize("law", [LAWS["barrier"], PassThrough()])
@pytest.mark.parametrize("number", [np.nan, np.inf])
def test_system_repeats_its_command_when_desired_is_not_finite(law, number):
    system = CommandFilter(law, PERIOD)
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    desired = system.get_desired_pose_input_port().FixValue(context, [0.0, 0.1])
    system.get_pose_input_port().FixValue(context, [0.0, 0.0])
    simulator.Initialize()
    simulator.AdvanceTo(1.5 * PERIOD)
    last = system.get_safe_pose_output_port().Eval(context)
    desired.GetMutableData().set_value([0.0, number])
    simulator.AdvanceTo(2.5 * PERIOD)
    np.testing.assert_array_equal(system.get_safe_pose_output_port().Eval(context), last)
    assert system.get_intervention_output_port().Eval(context)[0] == 1.0
    desired.GetMutableData().set_value([0.0, 0.2])
    simulator.AdvanceTo(5.5 * PERIOD)
    np.testing.assert_allclose(system.get_safe_pose_output_port().Eval(context), [0.0, 0.2], atol=1e-3)


def test_system_stores_the_velocity_of_a_motion_filter():
    motion = MotionConstraints(BOX, max_speed=[0.8, 0.8], max_acceleration=[1.6, 1.6])
    system = CommandFilter(MotionConstraintFilter(motion, PERIOD), PERIOD)
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    desired = system.get_desired_pose_input_port().FixValue(context, [0.5, 0.0])
    system.get_pose_input_port().FixValue(context, [0.0, 0.0])
    simulator.Initialize()
    commands = []
    for step in range(6):
        simulator.AdvanceTo((step + 0.5) * PERIOD)
        commands.append(system.get_safe_pose_output_port().Eval(context)[0])
    np.testing.assert_allclose(commands, np.cumsum([0.025, 0.05, 0.075, 0.1, 0.1, 0.1]), atol=1e-9)
    assert system.get_intervention_output_port().Eval(context)[0] == 0.0
    desired.GetMutableData().set_value([np.nan, 0.0])
    assert system.get_intervention_output_port().Eval(context)[0] == 1.0
    assert system.get_safe_pose_output_port().Eval(context)[0] == pytest.approx(0.35 + 0.075)


def test_measured_pose_at_initialization_must_be_finite():
    system = CommandFilter(LAWS["tangent"], PERIOD)
    simulator = Simulator(system)
    system.get_desired_pose_input_port().FixValue(simulator.get_mutable_context(), [0.0, 0.0])
    system.get_pose_input_port().FixValue(simulator.get_mutable_context(), [np.inf, 0.0])
    with pytest.raises(InputError, match="measured pose must be finite"):
        simulator.Initialize()


@pytest.fixture
def projection():
    """Return a filter by projection with a wall at 1 < x < 2 and a margin of 0.1."""
    wall = KeepOut([[1.0, -9.0]], [[2.0, 9.0]], LinearConstraints.none(2), margin=0.1)
    return CommandFilter(KeepOutFilter(wall), period=0.1)


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


def test_measured_pose_has_no_direct_feedthrough(projection):
    feedthrough = [[projection.HasDirectFeedthrough(i, o) for o in range(2)] for i in range(2)]
    assert feedthrough == [[True, True], [False, False]]


def test_command_into_the_wall_is_projected_onto_its_margin(projection):
    _, context, _, _ = start(projection, [3.0, 0.0], [0.0, 0.0])
    np.testing.assert_allclose(projection.get_safe_pose_output_port().Eval(context), [0.9, 0.0], atol=1e-5)
    assert projection.get_intervention_output_port().Eval(context) == [1.0]


def test_measured_pose_takes_effect_at_the_next_control_step(projection):
    simulator, context, _, pose = start(projection, [3.0, 1.0], [0.0, 0.0])
    simulator.AdvanceTo(0.05)
    before = projection.get_safe_pose_output_port().Eval(context).copy()
    pose.GetMutableData().set_value([0.8, 0.9])
    simulator.AdvanceTo(0.1)
    np.testing.assert_array_equal(projection.get_safe_pose_output_port().Eval(context), before)
    simulator.AdvanceTo(0.15)
    assert projection.get_safe_pose_output_port().Eval(context)[1] > 0.9


def test_last_command_is_repeated_when_a_pose_is_not_finite(projection):
    simulator, context, desired, pose = start(projection, [0.5, 0.3], [0.0, 0.0])
    simulator.AdvanceTo(0.15)
    for port, value in ((desired, [np.nan, 0.0]), (pose, [np.nan, 0.0])):
        port.GetMutableData().set_value(value)
        simulator.AdvanceTo(context.get_time() + 0.1)
        np.testing.assert_array_equal(projection.get_safe_pose_output_port().Eval(context), [0.5, 0.3])
        assert projection.get_intervention_output_port().Eval(context) == [1.0]
