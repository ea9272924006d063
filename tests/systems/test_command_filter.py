import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from guiderail.models.common.errors import InputError
from guiderail.models.control.command_filters import BarrierFilter, TangentSpaceFilter
from guiderail.models.control.keep_out import KeepOut
from guiderail.models.control.motion_constraints import MotionConstraintFilter, MotionConstraints
from guiderail.models.primitives import LinearConstraints
from guiderail.systems.command_filter import CommandFilter

PERIOD = 0.125
BOX = LinearConstraints.box([-1.0, -np.inf], [1.0, np.inf])
WALL = ([[0.5, 2.0]], [[9.0, 3.0]])  # above y = 2 where x > 0.5
KEEP_OUT = KeepOut(*WALL, BOX, margin=0.1)
LAWS = {"barrier": BarrierFilter(KEEP_OUT, 0.3), "tangent": TangentSpaceFilter(KEEP_OUT, 0.2)}


def margin(point):
    """Distance to the nearest constraint or face, with the margin of 0.1; negative inside."""
    inside_wall = max(0.5 - point[0], 2.0 - point[1], point[1] - 3.0)
    return min(0.9 - abs(point[0]), inside_wall - 0.1)


@pytest.mark.parametrize("law", LAWS.values(), ids=LAWS)
def test_every_command_keeps_constraints_for_any_desired_one(law):
    rng = np.random.default_rng(0)
    last, smallest = np.array([0.0, 0.0]), np.inf
    for _ in range(3000):
        desired = last + rng.normal(0.0, rng.choice([0.01, 0.3, 5.0]), 2) + [0.02, 0.02]
        last, _ = law.apply(last, desired)
        smallest = min(smallest, margin(last))
    assert -1e-8 < smallest < 0.02  # constraints were reached, and not passed


def test_barrier_decreases_by_its_fraction_at_most():
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


def test_tangent_step_slides_along_a_constraint_and_is_free_far_from_it():
    law, step = LAWS["tangent"], np.array([0.05, 0.05])
    at_wall, _ = law.apply(np.array([0.9, 0.0]), np.array([0.9, 0.0]) + step)
    np.testing.assert_allclose(at_wall, [0.9, 0.05], atol=1e-3)
    half, _ = TangentSpaceFilter(KeepOut(np.empty((0, 2)), np.empty((0, 2)), BOX, margin=0.0), 0.2).apply(
        np.array([0.8, 0.0]), np.array([0.85, 0.0])
    )
    assert half[0] == pytest.approx(0.8 + 0.5 * 0.05, abs=1e-3)  # half remains at a slack of the width
    law = TangentSpaceFilter(KEEP_OUT, 1e-3)
    np.testing.assert_allclose(law.apply(np.zeros(2), step)[0], step, atol=1e-6)


@pytest.mark.parametrize("law", LAWS.values(), ids=LAWS)
def test_command_outside_returns_to_the_constraints(law):
    last = np.array([1.4, 0.0])
    distances = []
    for _ in range(40):
        last, _ = law.apply(last, np.array([0.0, 0.0]))
        distances.append(last[0])
    assert distances[-1] <= 0.9
    assert (np.diff([1.4, *distances]) <= 1e-9).all()


@pytest.mark.parametrize("desired", [[np.nan, 0.0], [np.inf, 0.0]])
@pytest.mark.parametrize(
    "keep_out", [KEEP_OUT, KeepOut(np.empty((0, 2)), np.empty((0, 2)), LinearConstraints.none(2), 0.0)]
)
def test_command_that_is_not_finite_repeats_the_last_one(keep_out, desired):
    for law in (BarrierFilter(keep_out, 0.3), TangentSpaceFilter(keep_out, 0.2)):
        command, is_changed = law.apply(np.array([0.1, 0.2]), np.array(desired))
        np.testing.assert_array_equal(command, [0.1, 0.2])
        assert is_changed


@pytest.mark.parametrize("decay", [0.0, -0.1, 1.1, np.nan])
def test_barrier_raises_when_the_decay_is_out_of_range(decay):
    with pytest.raises(InputError, match="fraction"):
        BarrierFilter(KEEP_OUT, decay)
    assert BarrierFilter(KEEP_OUT, 1.0).num_outputs == 2


@pytest.mark.parametrize("width", [0.0, -1.0, np.inf])
def test_tangent_space_raises_when_the_width_is_not_positive(width):
    with pytest.raises(InputError, match="positive"):
        TangentSpaceFilter(KEEP_OUT, width)


def test_system_starts_at_the_measured_pose_and_keeps_the_last_command():
    system = CommandFilter(LAWS["barrier"], PERIOD)
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    desired = system.get_desired_pose_input_port().FixValue(context, [5.0, 0.0])
    pose = system.get_pose_input_port().FixValue(context, [0.4, 0.0])
    simulator.Initialize()
    pose.GetMutableData().set_value([0.0, 0.0])  # read at initialization only
    slack, commands = 0.5, []
    for step in range(3):
        simulator.AdvanceTo((step + 0.5) * PERIOD)
        commands.append(system.get_safe_pose_output_port().Eval(context)[0])
    np.testing.assert_allclose(commands, 0.9 - slack * 0.7 ** np.arange(1, 4), atol=1e-9)
    assert system.get_intervention_output_port().Eval(context)[0] == 1.0
    desired.GetMutableData().set_value([0.6, 0.0])
    assert system.get_intervention_output_port().Eval(context)[0] == 0.0
    simulator.Initialize()
    assert system.get_safe_pose_output_port().Eval(context)[0] == pytest.approx(0.3 * 0.9)


class PassThrough:
    """A user's law that returns every desired command."""

    num_outputs = 2

    def apply(self, last, desired):
        return desired.copy(), False

    def start(self, pose):
        return pose.copy()


@pytest.mark.parametrize("law", [LAWS["barrier"], PassThrough()])
@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_last_command_repeats_when_desired_one_is_not_finite(law, bad):
    system = CommandFilter(law, PERIOD)
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    desired = system.get_desired_pose_input_port().FixValue(context, [0.0, 0.1])
    system.get_pose_input_port().FixValue(context, [0.0, 0.0])
    simulator.Initialize()
    simulator.AdvanceTo(1.5 * PERIOD)
    last = system.get_safe_pose_output_port().Eval(context)
    desired.GetMutableData().set_value([0.0, bad])
    simulator.AdvanceTo(2.5 * PERIOD)
    np.testing.assert_array_equal(system.get_safe_pose_output_port().Eval(context), last)
    assert system.get_intervention_output_port().Eval(context)[0] == 1.0
    desired.GetMutableData().set_value([0.0, 0.2])
    simulator.AdvanceTo(5.5 * PERIOD)
    np.testing.assert_allclose(system.get_safe_pose_output_port().Eval(context), [0.0, 0.2], atol=1e-3)


def test_system_raises_when_the_period_is_not_positive():
    with pytest.raises(InputError):
        CommandFilter(LAWS["tangent"], 0.0)


def test_system_keeps_the_velocity_of_a_law_that_limits_the_acceleration():
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
