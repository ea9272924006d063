"""Guidance from a movement primitive: ports, reference, null space actions, constraints and limits."""

from dataclasses import replace

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from guiderail.diagrams.guidance.guidance import INPUTS, OUTPUTS, check_guidance_ports
from guiderail.diagrams.guidance.primitive import make_law
from guiderail.diagrams.guidance.prior import PrimitiveConfig, PriorKnowledge, limits_per_output
from guiderail.diagrams.guidance.registry import build_guidance
from guiderail.models.common.errors import InputError
from guiderail.models.control.command_filters import KeepOut, KeepOutFilter
from guiderail.models.control.motion_constraints import MotionConstraints
from guiderail.models.control.shapes import Sphere
from guiderail.models.laws import StateProgress
from guiderail.models.primitives import LinearConstraints, ReferenceTrajectory
from guiderail.models.primitives.gains import authority

PERIOD, STEPS = 0.02, 60
PRIMITIVE_GUIDANCE = ("kmp", "residual", "safe_residual", "kgrl", "skgrl", "residual_covariance")
START = np.array([0.0, 0.0])


def reference():
    phase = np.linspace(0, 1, STEPS)
    means = np.column_stack([0.1 * np.sin(3 * phase), 0.3 * phase])
    deviations = np.column_stack([0.02 + 0.03 * np.sin(np.pi * phase), np.full(STEPS, 0.01)])
    return ReferenceTrajectory(PERIOD * np.arange(STEPS), means, deviations[:, :, None] ** 2 * np.eye(2))


@pytest.fixture(scope="module")
def skill():
    constraints = LinearConstraints([[-1.0, 0.0]], [-0.11])
    wall = KeepOut([[0.13, -1.0]], [[0.2, 1.0]], constraints, margin=0.01)
    return PrimitiveConfig(reference(), constraints, PERIOD, history=5, horizon=10, keep_out=wall, wrench_size=2)


def build(kind, skill, task="this task"):
    return build_guidance(kind, PriorKnowledge(skill.control_period, primitive=skill), task)


def rollout(guidance, actions, pose=START, track=True):
    """Return the command and the fallback flag of every control step.

    With `track`, the measured pose is the last command; otherwise it is always `pose`.
    """
    simulator = Simulator(guidance)
    context = simulator.get_mutable_context()
    action = guidance.GetInputPort("action").FixValue(context, np.zeros(guidance.GetInputPort("action").size()))
    measured = guidance.GetInputPort("pose").FixValue(context, pose)
    guidance.GetInputPort("wrench").FixValue(context, np.zeros(guidance.GetInputPort("wrench").size()))
    simulator.Initialize()
    commands, fallbacks = [], []
    for n, a in enumerate(actions):
        action.GetMutableData().set_value(a)
        simulator.AdvanceTo((n + 0.5) * PERIOD)
        commands.append(guidance.GetOutputPort("desired_pose").Eval(context).copy())
        fallbacks.append(guidance.GetOutputPort("fallback").Eval(context)[0])
        if track:
            measured.GetMutableData().set_value(commands[-1])
    return np.array(commands), np.array(fallbacks)


def constant(value):
    """Return `value` for every control step."""
    return np.tile(value, (STEPS, 1))


@pytest.mark.parametrize("kind", PRIMITIVE_GUIDANCE)
def test_guidance_has_the_common_ports(skill, kind):
    guidance = build(kind, skill)
    inputs = [guidance.get_input_port(i).get_name() for i in range(guidance.num_input_ports())]
    outputs = [guidance.get_output_port(i).get_name() for i in range(guidance.num_output_ports())]
    assert (tuple(inputs), tuple(outputs)) == (INPUTS, OUTPUTS)
    check_guidance_ports(guidance, pose_size=2, wrench_size=2)
    with pytest.raises(InputError, match="port wrench of guidance 'guidance' has size 2, where 6 is needed"):
        check_guidance_ports(guidance, pose_size=2, wrench_size=6)


@pytest.mark.parametrize("kind", PRIMITIVE_GUIDANCE)
def test_command_follows_demonstrations_when_action_is_zero(skill, kind):
    commands, fallbacks = rollout(build(kind, skill), constant([0.0, 0.0]))
    means = skill.reference.means
    # Safe guidance deviates from the demonstrations near its bound at x = 0.1 m.
    free = means[:, 0] < 0.09
    assert (np.abs(commands - means) < skill.reference.standard_deviations)[free].all()
    assert not fallbacks[free].any()


def test_kmp_ignores_the_action(skill):
    without_action, _ = rollout(build("kmp", skill), constant([0.0, 0.0]))
    with_action, _ = rollout(build("kmp", skill), constant([1.0, -1.0]))
    np.testing.assert_array_equal(without_action, with_action)


def test_residual_is_constant_in_time_and_all_directions(skill):
    without_action, _ = rollout(build("residual", skill), constant([0.0, 0.0]))
    with_action, _ = rollout(build("residual", skill), constant([1.0, -1.0]))
    rms = np.sqrt(np.mean(skill.reference.standard_deviations**2))
    np.testing.assert_allclose(with_action - without_action, constant(np.sqrt(3) * rms * np.array([1, -1])), atol=1e-12)


def test_null_space_action_scales_with_standard_deviation(skill):
    free = replace(skill, constraints=LinearConstraints.none(2), keep_out=None)
    without_action, _ = rollout(build("kgrl", free), constant([0.0, 0.0]))
    with_action, _ = rollout(build("kgrl", free), constant([1.0, 0.0]))
    offset = np.abs(with_action - without_action)[:, 0]
    deviation = skill.reference.standard_deviations[:, 0]
    assert np.corrcoef(offset, deviation)[0, 1] > 0.95
    primitive = free.primitive(history=False)
    np.testing.assert_allclose(authority(primitive, free.null_space_gains(primitive)), np.sqrt(3), rtol=1e-9)


@pytest.mark.parametrize("kind", ["kgrl", "skgrl"])
def test_null_space_guidance_satisfies_the_constraint(skill, kind):
    rng = np.random.default_rng(0)
    for actions in (constant([1.0, 1.0]), rng.uniform(-1, 1, (STEPS, 2)), rng.choice([-1.0, 1.0], (STEPS, 2))):
        commands, _ = rollout(build(kind, skill), actions)
        assert commands[:, 0].max() <= 0.11 + 1e-9


def test_safe_residual_stops_before_a_wall(skill):
    commands, fallbacks = rollout(build("safe_residual", skill), constant([1.0, 0.0]))
    unsafe, _ = rollout(build("residual", skill), constant([1.0, 0.0]))
    assert unsafe[:, 0].max() > 0.13
    assert commands[:, 0].max() <= 0.10 + 1e-9
    assert set(fallbacks) <= {0.0, 1.0}


def test_skgrl_starts_at_the_measured_pose(skill):
    displaced = START + [0.02, -0.01]
    jump = {}
    for kind in ("kgrl", "skgrl"):
        commands, _ = rollout(build(kind, skill), constant([0.0, 0.0]), pose=displaced, track=False)
        jump[kind] = np.linalg.norm(commands[0] - displaced)
    assert jump["kgrl"] > 0.02
    assert jump["skgrl"] < 0.005


def test_command_follows_the_robot_when_history_is_measured(skill):
    pushed = np.array([-0.05, 0.1])

    def command_after(source):
        guidance = build("skgrl", replace(skill, history_source=source))
        return rollout(guidance, constant([0.0, 0.0])[:20], pose=pushed, track=False)[0][-1]

    # The measured pose is constant and displaced from the demonstrations.
    assert np.linalg.norm(command_after("measured") - pushed) < 0.02
    assert np.linalg.norm(command_after("commanded") - skill.reference.means[19]) < 0.02


def test_action_moves_only_the_selected_outputs(skill):
    sideways = replace(skill, action_dims=(0,), constraints=LinearConstraints.none(2))
    for kind in ("residual", "kgrl", "skgrl"):
        guidance = build(kind, sideways)
        assert guidance.GetInputPort("action").size() == 1
        without_action, _ = rollout(build(kind, sideways), constant([0.0]))
        with_action, _ = rollout(guidance, constant([1.0]))
        offset = np.abs(with_action - without_action).max(axis=0)
        assert offset[0] > 0.01
        assert offset[1] < 1e-9


def test_action_is_constant_for_a_control_period(skill):
    guidance = build("residual", skill)
    simulator = Simulator(guidance)
    context = simulator.get_mutable_context()
    action = guidance.GetInputPort("action").FixValue(context, [0.0, 0.0])
    guidance.GetInputPort("pose").FixValue(context, START)
    guidance.GetInputPort("wrench").FixValue(context, [0.0, 0.0])
    simulator.Initialize()
    simulator.AdvanceTo(0.25 * PERIOD)
    before = guidance.GetOutputPort("desired_pose").Eval(context).copy()
    action.GetMutableData().set_value([1.0, 1.0])
    simulator.AdvanceTo(0.75 * PERIOD)
    np.testing.assert_array_equal(guidance.GetOutputPort("desired_pose").Eval(context), before)
    simulator.AdvanceTo(1.25 * PERIOD)
    assert (guidance.GetOutputPort("desired_pose").Eval(context) > before).all()


def test_primitive_is_evaluated_once_a_control_step(skill):
    """Drake's sources, sums and gains depend on time: with any of them, each of the ten reads would evaluate again."""
    for kind in PRIMITIVE_GUIDANCE:
        guidance = build(kind, skill)
        calls = []
        system = guidance.GetSubsystemByName("kmp" if guidance.HasSubsystemNamed("kmp") else "lc_ns_kmp")
        predict = system.primitive.predict
        system.primitive.predict = lambda *a, calls=calls, predict=predict: calls.append(a) or predict(*a)
        simulator = Simulator(guidance)
        context = simulator.get_mutable_context()
        guidance.GetInputPort("action").FixValue(context, [0.5, 0.5])
        guidance.GetInputPort("pose").FixValue(context, START)
        guidance.GetInputPort("wrench").FixValue(context, [0.0, 0.0])
        simulator.Initialize()
        for k in range(1, 101):
            simulator.AdvanceTo((k - 0.5) * PERIOD / 10)
            guidance.GetOutputPort("desired_pose").Eval(context)
        assert len(calls) == 10, kind


@pytest.mark.parametrize("kind", ["kmp", "kgrl", "skgrl"])
def test_motion_constraints_bound_the_primitives_commands(skill, kind):
    disc = Sphere(skill.reference.means[30], 0.03)
    motion = MotionConstraints(skill.constraints, [disc], [0.3, 0.3], [3.0, 3.0])
    guidance = build(kind, replace(skill, motion=motion))
    rng = np.random.default_rng(0)
    commands, _ = rollout(guidance, np.repeat(rng.uniform(-1, 1, (STEPS // 5, 2)), 5, axis=0))
    distances = [disc.distance(command) for command in commands]
    assert 0.0 <= min(distances) < 1e-3  # [m]; the demonstrations lead through the disc
    assert commands[:, 0].max() <= 0.11 + 1e-9
    displacements = np.diff([START, *commands], axis=0)
    assert np.abs(displacements).max() <= 0.3 * PERIOD * (1 + 1e-9)
    assert np.abs(np.diff(displacements, axis=0)).max() <= 3.0 * PERIOD**2 * (1 + 1e-6)


def test_history_contains_commands_after_motion_constraints(skill):
    motion = MotionConstraints(skill.constraints, max_speed=[1e-9, 1e-9])
    commands, _ = rollout(build("skgrl", replace(skill, motion=motion)), constant([0.0, 0.0])[:6])
    np.testing.assert_allclose(commands, np.zeros((6, 2)), atol=1e-9)
    free, _ = rollout(build("skgrl", skill), constant([0.0, 0.0])[:6])
    assert np.abs(free).max() > 1e-4


@pytest.mark.parametrize("kind", ["kmp", "kgrl", "skgrl"])
def test_motion_waits_when_the_robot_does_not_follow(skill, kind):
    actions = np.random.default_rng(0).uniform(-1, 1, (STEPS, 2))
    waiting = replace(skill, progress=StateProgress((0.02, 0.1), 20))
    clock, _ = rollout(build(kind, skill), actions)
    following, _ = rollout(build(kind, waiting), actions)
    np.testing.assert_array_equal(following, clock)  # the measured pose is the command
    delayed, _ = rollout(build(kind, waiting), constant([0.0, 0.0]), track=False)
    free, _ = rollout(build(kind, skill), constant([0.0, 0.0]), track=False)
    first = int(np.argmax(np.linalg.norm(delayed - START, axis=1) > 0.02))
    assert 0 < first < 20
    if kind != "skgrl":  # its history continues while the motion waits
        np.testing.assert_array_equal(delayed[first : first + 20], np.tile(delayed[first], (20, 1)))
        np.testing.assert_array_equal(delayed[first + 20 :], free[first:-20])
    assert np.linalg.norm(delayed[first + 19]) < 0.5 * np.linalg.norm(free[first + 19])


def test_limits_are_expanded_to_all_outputs():
    np.testing.assert_array_equal(limits_per_output("max_speed", [0.1], 6), [0.1] * 3 + [np.inf] * 3)
    np.testing.assert_array_equal(limits_per_output("max_speed", [0.1, 2.0], 6), [0.1] * 3 + [2.0] * 3)
    np.testing.assert_array_equal(limits_per_output("max_speed", [1.0, 2.0, 3.0, 4.0], 4), [1, 2, 3, 4])
    for limits in [], [1.0, 2.0, 3.0]:
        with pytest.raises(InputError, match=f"max_speed is 1, 2 or 6 numbers for 6 outputs, not {len(limits)}"):
            limits_per_output("max_speed", limits, 6)


def test_filter_of_a_residual_is_refused_where_the_constraints_would_replace_it(skill):
    prior = PriorKnowledge(skill.control_period, primitive=skill)
    for options in ({"action": "residual", "constrained": True}, {"action": "null_space", "constrained": False}):
        with pytest.raises(ValueError, match="a filter is for residual commands"):
            make_law(prior, **options, history=False, make_filter=lambda config, walls: KeepOutFilter(walls))
