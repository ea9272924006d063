"""All guidance made of a primitive: the same ports, and what sets each kind apart."""

from dataclasses import replace

import numpy as np
import pytest
from pydantic import ValidationError
from pydrake.systems.analysis import Simulator

from guiderail.diagrams.envs.config import EnvConfig
from guiderail.diagrams.envs.make import make_env
from guiderail.diagrams.envs.options import PrimitiveOptions
from guiderail.diagrams.guidance.guidance import INPUTS, OUTPUTS, check_guidance_ports
from guiderail.diagrams.guidance.prior import PrimitiveConfig, PriorKnowledge, limits_per_output
from guiderail.diagrams.guidance.registry import build_guidance, check_guidance
from guiderail.models.common.errors import InputError
from guiderail.models.control.keep_out import KeepOut
from guiderail.models.control.motion_constraints import MotionConstraints
from guiderail.models.control.shapes import Sphere
from guiderail.models.primitives import LinearConstraints, ReferenceTrajectory
from guiderail.models.primitives.gains import authority
from guiderail.models.primitives.stepper import StateProgress

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
    return build_guidance(kind, PriorKnowledge(skill.control_period, demonstrations=skill), task)


def rollout(guidance, actions, pose=START, track=True):
    """Commands and fallback_steps of every control step; with `track` the robot is where it was commanded."""
    simulator = Simulator(guidance)
    context = simulator.get_mutable_context()
    action = guidance.GetInputPort("action").FixValue(context, np.zeros(guidance.GetInputPort("action").size()))
    measured = guidance.GetInputPort("pose").FixValue(context, pose)
    guidance.GetInputPort("wrench").FixValue(context, np.zeros(guidance.GetInputPort("wrench").size()))
    simulator.Initialize()
    commands, fallback_steps = [], []
    for n, a in enumerate(actions):
        action.GetMutableData().set_value(a)
        simulator.AdvanceTo((n + 0.5) * PERIOD)
        commands.append(guidance.GetOutputPort("desired_pose").Eval(context).copy())
        fallback_steps.append(guidance.GetOutputPort("fallback").Eval(context)[0])
        if track:
            measured.GetMutableData().set_value(commands[-1])
    return np.array(commands), np.array(fallback_steps)


def constant(value):
    return np.tile(value, (STEPS, 1))


@pytest.mark.parametrize("kind", PRIMITIVE_GUIDANCE)
def test_all_guidance_has_the_same_ports(skill, kind):
    guidance = build(kind, skill)
    inputs = [guidance.get_input_port(i).get_name() for i in range(guidance.num_input_ports())]
    outputs = [guidance.get_output_port(i).get_name() for i in range(guidance.num_output_ports())]
    assert (tuple(inputs), tuple(outputs)) == (INPUTS, OUTPUTS)
    check_guidance_ports(guidance, pose_size=2, wrench_size=2)
    with pytest.raises(InputError, match="port wrench of guidance 'guidance' has size 2, where 6 is needed"):
        check_guidance_ports(guidance, pose_size=2, wrench_size=6)


@pytest.mark.parametrize("kind", PRIMITIVE_GUIDANCE)
def test_zero_action_follows_the_demonstrations(skill, kind):
    commands, fallback_steps = rollout(build(kind, skill), constant([0.0, 0.0]))
    means = skill.reference.means
    # Where the safe variants are not already avoiding what lies at x = 0.1.
    free = means[:, 0] < 0.09
    assert (np.abs(commands - means) < skill.reference.standard_deviations)[free].all()
    assert not fallback_steps[free].any()


def test_the_demonstrations_alone_ignore_the_action(skill):
    still, _ = rollout(build("kmp", skill), constant([0.0, 0.0]))
    moved, _ = rollout(build("kmp", skill), constant([1.0, -1.0]))
    np.testing.assert_array_equal(still, moved)


def test_a_residual_is_alike_at_any_time_and_in_any_direction(skill):
    still, _ = rollout(build("residual", skill), constant([0.0, 0.0]))
    moved, _ = rollout(build("residual", skill), constant([1.0, -1.0]))
    rms = np.sqrt(np.mean(skill.reference.standard_deviations**2))
    np.testing.assert_allclose(moved - still, constant(np.sqrt(3) * rms * np.array([1, -1])), atol=1e-12)


def test_null_space_actions_scale_with_the_demonstrations(skill):
    free = replace(skill, constraints=LinearConstraints.none(2), keep_out=None)
    still, _ = rollout(build("kgrl", free), constant([0.0, 0.0]))
    moved, _ = rollout(build("kgrl", free), constant([1.0, 0.0]))
    offset = np.abs(moved - still)[:, 0]
    deviation = skill.reference.standard_deviations[:, 0]
    assert np.corrcoef(offset, deviation)[0, 1] > 0.95
    primitive = free.primitive(history=False)
    np.testing.assert_allclose(authority(primitive, free.null_space_gains(primitive)), np.sqrt(3), rtol=1e-9)


@pytest.mark.parametrize("kind", ["kgrl", "skgrl"])
def test_null_space_guidance_satisfies_constraints_always(skill, kind):
    rng = np.random.default_rng(0)
    for actions in (constant([1.0, 1.0]), rng.uniform(-1, 1, (STEPS, 2)), rng.choice([-1.0, 1.0], (STEPS, 2))):
        commands, _ = rollout(build(kind, skill), actions)
        assert commands[:, 0].max() <= 0.11 + 1e-9


def test_safe_residual_stops_at_walls_and_reports_fallback(skill):
    commands, fallback_steps = rollout(build("safe_residual", skill), constant([1.0, 0.0]))
    unsafe, _ = rollout(build("residual", skill), constant([1.0, 0.0]))
    assert unsafe[:, 0].max() > 0.13
    assert commands[:, 0].max() <= 0.10 + 1e-9
    assert set(fallback_steps) <= {0.0, 1.0}


def test_smooth_guidance_starts_where_the_robot_is(skill):
    elsewhere = START + [0.02, -0.01]
    jump = {}
    for kind in ("kgrl", "skgrl"):
        commands, _ = rollout(build(kind, skill), constant([0.0, 0.0]), pose=elsewhere, track=False)
        jump[kind] = np.linalg.norm(commands[0] - elsewhere)
    assert jump["kgrl"] > 0.02
    assert jump["skgrl"] < 0.005


def test_only_a_measured_history_follows_the_robot(skill):
    pushed = np.array([-0.05, 0.1])

    def command_after(source):
        guidance = build("skgrl", replace(skill, history_source=source))
        return rollout(guidance, constant([0.0, 0.0])[:20], pose=pushed, track=False)[0][-1]

    # The robot is held away from the demonstrations.
    assert np.linalg.norm(command_after("measured") - pushed) < 0.02
    assert np.linalg.norm(command_after("commanded") - skill.reference.means[19]) < 0.02


def test_only_explored_outputs_have_an_action(skill):
    sideways = replace(skill, action_dims=(0,), constraints=LinearConstraints.none(2))
    for kind in ("residual", "kgrl", "skgrl"):
        guidance = build(kind, sideways)
        assert guidance.GetInputPort("action").size() == 1
        still, _ = rollout(build(kind, sideways), constant([0.0]))
        moved, _ = rollout(guidance, constant([1.0]))
        assert np.abs(moved - still)[:, 0].max() > 0.01
        assert np.abs(moved - still)[:, 1].max() < 1e-9


def test_an_action_is_held_for_a_control_period(skill):
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


def test_nothing_is_computed_between_control_steps(skill):
    """Drake's sources, sums and gains count as depending on time: with one of them this would be 10 a step."""
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


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("magic", "there is no guidance 'magic': .*kgrl, .*kmp, none, residual, .*safe_residual, sct, skgrl"),
        ("kgrll", "did you mean kgrl"),
        (
            "sct",
            "'sct' needs a shared control template.*use base_policy, kgrl, .*kmp, residual, .*skgrl",
        ),
        ("none", "'none' needs .*kmp"),
    ],
)
def test_impossible_guidance_is_refused_with_alternatives(skill, kind, message):
    with pytest.raises(InputError, match=message):
        build(kind, skill)


def test_safe_residual_is_not_offered_without_walls(skill):
    with pytest.raises(
        InputError,
        match=r"walls to keep out of, .*BncConnector.*kmp, residual, residual_base_policy, residual_covariance, skgrl",
    ):
        build("safe_residual", replace(skill, keep_out=None), "BncConnector")
    assert check_guidance("kmp", ("demonstrations",)).label == "demonstration alone"


@pytest.mark.parametrize(
    "change",
    [
        {"history_source": "imagined"},
        {"action_scale": 0.0},
        {"action_scale": np.nan},
        {"history": 0},
        {"action_dims": ()},
        {"action_dims": (2,)},
        {"action_dims": (0, 0)},
    ],
)
def test_a_skill_that_makes_no_sense_is_refused(skill, change):
    with pytest.raises(InputError):
        replace(skill, **change)


def test_gains_of_the_wrong_size_are_refused(skill):
    with pytest.raises(InputError, match="one per output"):
        build("kgrl", replace(skill, gains=(1.0, 2.0, 3.0)))


@pytest.mark.parametrize("option", ["horizon", "history"])
def test_options_bound_the_time_to_factor_a_step(option):
    assert getattr(PrimitiveOptions(**{option: 200}), option) == 200
    with pytest.raises(ValidationError, match="less than or equal to 200"):
        PrimitiveOptions(**{option: 201})


@pytest.mark.parametrize("kind", ["kmp", "kgrl", "skgrl"])
def test_constraints_of_the_motion_hold_behind_the_primitive(skill, kind):
    disc = Sphere(skill.reference.means[30], 0.03)
    motion = MotionConstraints(skill.constraints, [disc], (), [0.3, 0.3], [3.0, 3.0])
    guidance = build(kind, replace(skill, motion=motion))
    rng = np.random.default_rng(0)
    commands, _ = rollout(guidance, np.repeat(rng.uniform(-1, 1, (STEPS // 5, 2)), 5, axis=0))
    distances = [disc.distance(command) for command in commands]
    assert 0.0 <= min(distances) < 1e-3  # the demonstrations lead through it
    assert commands[:, 0].max() <= 0.11 + 1e-9
    displacements = np.diff([START, *commands], axis=0)
    assert np.abs(displacements).max() <= 0.3 * PERIOD * (1 + 1e-9)
    assert np.abs(np.diff(displacements, axis=0)).max() <= 3.0 * PERIOD**2 * (1 + 1e-6)


def test_history_continues_from_commands_behind_the_constraints_of_the_motion(skill):
    motion = MotionConstraints(skill.constraints, max_speed=[1e-9, 1e-9])
    commands, _ = rollout(build("skgrl", replace(skill, motion=motion)), constant([0.0, 0.0])[:6])
    np.testing.assert_allclose(commands, np.zeros((6, 2)), atol=1e-9)
    free, _ = rollout(build("skgrl", skill), constant([0.0, 0.0])[:6])
    assert np.abs(free).max() > 1e-4


@pytest.mark.parametrize("kind", ["kmp", "kgrl", "skgrl"])
def test_motion_waits_for_a_robot_that_does_not_follow(skill, kind):
    actions = np.random.default_rng(0).uniform(-1, 1, (STEPS, 2))
    waiting = replace(skill, progress=StateProgress((0.02, 0.1), 20))
    clock, _ = rollout(build(kind, skill), actions)
    following, _ = rollout(build(kind, waiting), actions)
    np.testing.assert_array_equal(following, clock)  # the robot is where it is commanded
    held, _ = rollout(build(kind, waiting), constant([0.0, 0.0]), track=False)
    free, _ = rollout(build(kind, skill), constant([0.0, 0.0]), track=False)
    first = int(np.argmax(np.linalg.norm(held - START, axis=1) > 0.02))
    assert 0 < first < 20
    if kind != "skgrl":  # whose history is the motion itself
        np.testing.assert_array_equal(held[first : first + 20], np.tile(held[first], (20, 1)))
        np.testing.assert_array_equal(held[first + 20 :], free[first:-20])
    assert np.linalg.norm(held[first + 19]) < 0.5 * np.linalg.norm(free[first + 19])


def test_residual_guidance_refuses_a_motion_that_waits(skill):
    with pytest.raises(InputError, match="clock"):
        build("residual", replace(skill, progress=StateProgress((0.02, 0.1), 20)))


def test_motion_that_waits_refuses_constraints_of_each_step(skill):
    moving = LinearConstraints.box(np.full((STEPS, 2), -1.0), np.full((STEPS, 2), 1.0))
    with pytest.raises(InputError, match="progress=clock"):
        replace(skill, constraints=moving, progress=StateProgress((0.02, 0.1), 20))


LIMITS = {"max_speed": (0.5,), "max_acceleration": (4.0,)}


@pytest.mark.parametrize("guidance", ["residual", "safe_residual", "residual_covariance"])
@pytest.mark.parametrize("name", LIMITS)
def test_guidance_without_constraints_refuses_limits_of_the_motion(guidance, name):
    with pytest.raises(InputError, match=f"only kgrl, skgrl and kmp enforce {name}: choose"):
        make_env("NarrowPassage", guidance=guidance, **{name: LIMITS[name]})


def test_one_number_limits_the_speed_of_all_positions():
    speeds = [EnvConfig.resolve("NarrowPassage", {"max_speed": value}).options["max_speed"] for value in (0.5, "0.5")]
    assert speeds == [(0.5,), (0.5,)]
    with pytest.raises(InputError, match="max_speed must be several numbers, such as"):
        EnvConfig.resolve("NarrowPassage", {"max_speed": True})


def test_limits_are_one_or_two_or_one_for_each_output():
    np.testing.assert_array_equal(limits_per_output("max_speed", [0.1], 6), [0.1] * 3 + [np.inf] * 3)
    np.testing.assert_array_equal(limits_per_output("max_speed", [0.1, 2.0], 6), [0.1] * 3 + [2.0] * 3)
    np.testing.assert_array_equal(limits_per_output("max_speed", [1.0, 2.0, 3.0, 4.0], 4), [1, 2, 3, 4])
    for limits in [], [1.0, 2.0, 3.0]:
        with pytest.raises(InputError, match=f"max_speed is 1, 2 or 6 numbers for 6 outputs, not {len(limits)}"):
            limits_per_output("max_speed", limits, 6)
