"""Guidance around any Gymnasium environment: constraints, frames, segments, observations and refused arguments."""

import warnings
from contextlib import nullcontext
from dataclasses import replace

import gymnasium
import numpy as np
import pytest
from point_env import PERIOD, PointEnv, demonstrations, pose, to_action
from scipy.spatial.transform import Rotation

from guiderail import Demonstrations, Frame, GuidedEnv, LinearConstraints, Segment
from guiderail.models.common.errors import InputError
from guiderail.models.common.transforms import RigidTransform, RotationMatrix, pose_to_transform, transform_to_pose
from guiderail.models.control.motion_constraints import MotionConstraints
from guiderail.models.control.shapes import Sphere
from guiderail.models.laws import Law
from guiderail.models.primitives import UnsolvableError
from guiderail.models.primitives.demonstrations import compute_bounds
from guiderail.models.primitives.poses import pose_rotation
from guiderail.models.templates import load_template
from guiderail.tools.evaluation.rollout import rollout
from guiderail.tools.guided import guide

TOLERANCE = 1e-9
ENFORCED = ("kgrl", "skgrl", "clipped_residual")
RECORDED = demonstrations()
BOX = LinearConstraints.box([-np.inf, -0.13, -np.inf], [np.inf, 0.01, np.inf])


def at_target(env, observation):
    """Return the origin of a segment's frame: the target of the environment."""
    return env.unwrapped.target


def make_guided(guidance="kgrl", kind="box", **keywords):
    """Return a guided point environment; `kind` is its observation space, and `keywords` replace arguments."""
    arguments = {
        "demonstrations": RECORDED, "frame": at_target, "constraints": BOX, "pose": pose, "to_action": to_action,
        "guidance": guidance, "period": PERIOD, "action_repeat": 3,
    }  # fmt: skip
    return GuidedEnv(PointEnv(kind), **(arguments | keywords))


def run_episode(env, policy, seed=0, options=None):
    """Run an episode with a policy from the index of an action to an action; return the infos of reset and steps."""
    observation, info = env.reset(seed=seed, options=options)
    infos, done, k = [info], False, 0
    while not done:
        observation, _, terminated, truncated, info = env.step(policy(k))
        infos.append({**info, "observation": observation, "terminated": terminated, "truncated": truncated})
        done, k = terminated or truncated, k + 1
    return infos


@pytest.mark.parametrize("guidance", [*ENFORCED, "kmp"])
def test_motion_without_actions_ends_at_the_target(guidance):
    env = make_guided(guidance, constraints=None)
    last = run_episode(env, lambda k: np.zeros(3))[-1]
    assert last["phase"] == 1.0
    assert np.linalg.norm(env.unwrapped.p - env.unwrapped.target) < 0.02
    assert (last["truncated"], last["terminated"]) == (True, False)


@pytest.mark.parametrize("guidance", ENFORCED)
@pytest.mark.parametrize("seed", range(3))
def test_commands_satisfy_the_constraints_for_any_actions(guidance, seed):
    env, rng = make_guided(guidance, action_scale=20.0), np.random.default_rng(seed)
    policies = [
        lambda k: rng.uniform(-1, 1, 3),
        lambda k: rng.choice([-1.0, 1.0], 3),
        lambda k: np.array([0, 1.0, 0]),
        lambda k: np.array([0, -1.0, 0]),
    ]
    for policy in policies:
        env.unwrapped.commands.clear()
        infos = run_episode(env, policy, seed)
        local = np.array(env.unwrapped.commands) - env.unwrapped.target
        assert max(BOX.violation(y) for y in local) <= TOLERANCE
        assert max(info["constraint_violation"] for info in infos[1:]) <= TOLERANCE
        assert sum(info["fallback"] for info in infos[1:]) == 0
    assert np.abs(local[:, 1] + 0.13).min() < 1e-6  # the last policy reaches the bound


@pytest.mark.parametrize("number", [0, 1])
def test_violation_of_an_action_is_nan_if_a_command_has_nan(number, monkeypatch):
    env = make_guided()
    command, violations = env.guide.command, iter([np.nan if k == number else -1.0 for k in range(3)])
    monkeypatch.setattr(
        env.guide, "command", lambda *step: (command(*step)[0]._replace(violation=next(violations)), 0.0)
    )
    env.reset(seed=0)
    assert np.isnan(env.step(np.zeros(3))[-1]["constraint_violation"])


def test_residual_reports_its_constraint_violation():
    infos = run_episode(make_guided("residual", action_scale=5.0), lambda k: np.array([0.0, 1.0, 0.0]))
    assert max(info["constraint_violation"] for info in infos[1:]) > 0.02


def test_action_dims_select_entries_of_a_full_action():
    env = make_guided(action_dims=[1])
    assert env.action_space.shape == (1,)
    selected = run_episode(env, lambda k: np.ones(1))
    full = run_episode(make_guided(), lambda k: np.array([0.0, 1.0, 0.0]))
    for a, b in zip(selected[1:], full[1:], strict=True):
        np.testing.assert_allclose(a["command"], b["command"], atol=1e-12)


def test_info_and_observation_have_phase_and_command():
    env = make_guided(history=4)
    assert env.observation_space.shape == (6 + 1 + 3,)
    observation, info = env.reset(seed=0)
    assert env.observation_space.contains(observation)
    assert info["own"] == 1
    assert observation[6] == -1.0
    observation, reward, _, _, info = env.step(np.zeros(3))
    assert env.observation_space.contains(observation)
    assert observation[6] == pytest.approx(2 * info["phase"] - 1)
    assert info["own"] == 2
    assert info["segment"] == "0"
    assert np.abs(observation[7:]).max() < 1.5
    assert reward < 0


@pytest.mark.parametrize(("kind", "keys"), [("dict", {"state", "phase"}), ("image", {"observation", "phase"})])
def test_dict_and_image_observations_are_extended(kind, keys):
    env = make_guided(kind=kind, observe=["phase"])
    observation, _ = env.reset(seed=0)
    assert set(observation) == keys
    assert env.observation_space.contains(observation)


def two_segments(**second):
    """Return a motion to 0.1 m above the target, and a motion down; `second` replaces arguments of the latter."""
    approach = demonstrations(end=(0.0, 0.0, 0.1))
    down = demonstrations(start=(0.0, 0.0, 0.1), steps=15, seed=1)
    return [
        Segment(approach, frame=at_target, extra=-1.0, name="approach"),
        Segment(down, **{"frame": at_target, "extra": 1.0, "name": "insert", "dwell": 6, **second}),
    ]


def test_segments_follow_in_order_with_their_gripper_values():
    env = make_guided(demonstrations=two_segments(), constraints=None, frame=None)
    infos = run_episode(env, lambda k: np.zeros(3))
    names = [info["segment"] for info in infos]
    assert names == sorted(names, key=["approach", "insert"].index)
    assert infos[-1]["is_success"]  # only a closed gripper at the target succeeds
    assert infos[-1]["terminated"]


def test_frame_is_evaluated_at_the_start_of_the_segment():
    positions = []

    def frame(env, observation):
        positions.append(env.unwrapped.p.copy())
        return env.unwrapped.target

    env = make_guided(demonstrations=two_segments(frame=frame), constraints=None, frame=None)
    run_episode(env, lambda k: np.zeros(3))
    assert len(positions) == 1
    assert np.linalg.norm(positions[0] - env.unwrapped.target) < 0.15


def test_event_ends_a_segment_early():
    late, early = two_segments(), two_segments()
    early[0] = Segment(
        early[0].demonstrations, frame=at_target, until=lambda env, o: env.unwrapped.p[0] > 0.2, name="approach"
    )
    counts = []
    for segments in (late, early):
        env = make_guided(demonstrations=segments, constraints=None, frame=None, action_repeat=1)
        counts.append(sum(info["segment"] == "approach" for info in run_episode(env, lambda k: np.zeros(3))))
    assert counts[1] < counts[0] - 3


def test_motion_is_independent_of_the_rotation_of_the_frame():
    R = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    rotated = Demonstrations(RECORDED.times, [y @ R for y in RECORDED.outputs])  # Rᵀ applied to every row
    unrotated = make_guided(constraints=None)
    in_rotated_frame = make_guided(
        demonstrations=rotated, constraints=None, frame=lambda env, o: Frame(env.unwrapped.target, R)
    )
    a, b = (run_episode(env, lambda k: np.zeros(3)) for env in (unrotated, in_rotated_frame))
    np.testing.assert_allclose(a[5]["command"], b[5]["command"], atol=5e-3)
    np.testing.assert_allclose(a[-1]["command"], b[-1]["command"], atol=5e-3)


@pytest.mark.parametrize("orientation", ["rotation_vector", "euler_zyx"])
def test_frame_transforms_are_inverse(orientation):
    frame = Frame([0.1, 0.2, 0.3], [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    output = np.array([0.5, -0.2, 0.1, 0.3, 0.4, -0.5])
    inside = frame.to_frame(output, orientation)
    assert not np.allclose(inside[3:], output[3:])
    np.testing.assert_allclose(frame.to_world(inside, orientation), output, atol=1e-12)
    unwrapped = frame.to_frame(output, orientation, near=np.array([0, 0, 0, 6.3, 0, 0]))
    np.testing.assert_allclose(frame.to_world(unwrapped, orientation)[:3], output[:3], atol=1e-12)


EULER, VECTOR = ("Rz [rad]", "Ry [rad]", "Rx [rad]"), ("r_x [rad]", "r_y [rad]", "r_z [rad]")


def pose_demonstrations(angles):
    """Return demonstrations of poses with a constant orientation; `angles` are the names of the last three outputs."""
    outputs = [np.hstack([y, np.tile([0.5, -0.4, 0.3], (len(y), 1))]) for y in RECORDED.outputs]
    return Demonstrations(RECORDED.times, outputs, ["x [m]", "y [m]", "z [m]", *angles])


def make_guided_poses(angles, **keywords):
    """Return an environment with these demonstrations in a frame that is rotated by 90° about z."""
    R = RotationMatrix.MakeZRotation(np.pi / 2).matrix()
    arguments = {
        "demonstrations": pose_demonstrations(angles),
        "frame": lambda env, observation: Frame(env.unwrapped.target, R),
        "pose": lambda env, observation: np.append(env.unwrapped.p, np.zeros(3)),
        "to_action": lambda env, observation, command, extra: np.zeros(4),
    }
    return make_guided("kmp", **{"constraints": None, **arguments, **keywords})


@pytest.mark.parametrize(
    ("angles", "orientation", "expected_orientation"),
    [
        (EULER, None, "euler_zyx"),
        (("psi_z [rad]", "psi_y [rad]", "psi_x [rad]"), None, "euler_zyx"),
        (EULER, "euler_zyx", "euler_zyx"),
        (VECTOR, None, "rotation_vector"),
        (("a", "b", "c"), None, "rotation_vector"),
        (("a", "b", "c"), "euler_zyx", "euler_zyx"),
    ],
)
def test_orientation_follows_from_the_output_names(angles, orientation, expected_orientation):
    env = make_guided_poses(angles, orientation=orientation)
    command = run_episode(env, lambda k: np.zeros(6))[-1]["command"]
    expected = Rotation.from_euler("z", np.pi / 2) * pose_rotation(np.array([0.5, -0.4, 0.3]), expected_orientation)
    assert (pose_rotation(command[3:], expected_orientation).inv() * expected).magnitude() < 0.02


def test_constraints_may_be_computed_bounds_and_functions():
    bounds = compute_bounds(RECORDED, phases=3, margin=0.1, min_margin=0.005)
    for constraints in (bounds, lambda env, o: BOX, lambda env, o: bounds):
        env = make_guided(constraints=constraints, action_scale=20.0)
        infos = run_episode(env, lambda k: np.array([1.0, 1.0, -1.0]))
        assert max(info["constraint_violation"] for info in infos[1:]) <= TOLERANCE


def test_fallback_is_counted_and_satisfies_the_constraints(monkeypatch):
    env = make_guided()
    env.reset(seed=0)

    def fail(*_):
        raise UnsolvableError("no solution")

    monkeypatch.setattr("guiderail.models.primitives.lc_ns_kmp.LcNsKmp.predict", fail)
    *_, info = env.step(np.zeros(3))
    assert info["fallback"] == 3
    assert info["constraint_violation"] <= TOLERANCE


@pytest.mark.parametrize("action", [[np.nan, 0, 0], [np.inf, 0, 0], [0.0, 0.0], ["a", "b", "c"]])
def test_invalid_action_is_refused_without_a_step(action):
    env = make_guided()
    env.reset(seed=0)
    before = env.unwrapped.p.copy()
    with pytest.raises(InputError, match="action"):
        env.step(action)
    np.testing.assert_array_equal(env.unwrapped.p, before)
    env.step(np.zeros(3))


def test_action_beyond_the_range_is_clipped():
    a, b = (run_episode(make_guided(), lambda k, s=scale: np.full(3, s)) for scale in (1.0, 100.0))
    np.testing.assert_array_equal(a[-1]["command"], b[-1]["command"])


@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        ({"guidance": "kgr"}, "did you mean kgrl"),
        ({"demonstrations": None}, "needs demonstrations="),
        ({"demonstrations": [], "constraints": None, "frame": None}, "at least one segment"),
        ({"period": None}, "period of the environment"),
        ({"period": -1.0}, "period of the environment"),
        ({"action_repeat": 0}, "action_repeat"),
        ({"history": 0}, "history"),
        ({"observe": ["force"]}, "observe"),
        ({"action_dims": [7]}, "action_dims"),
        ({"constraints": LinearConstraints.none(2)}, "2 outputs"),
        ({"guidance": "template"}, "template="),
        ({"orientation": "quaternion"}, "choose euler_zyx or rotation_vector"),
        ({"period": 50.0}, r"demonstrations of 1.2 s are shorter than 4 periods of 50 s: give as period"),
        ({"period": 0.35}, "shorter than 4 periods"),
        ({"action_dims": [0, 0]}, r"action_dims names an output twice, \[0, 0\]"),
        ({"action_dims": [0.5]}, "action_dims"),
        ({"action_dims": [True, False, True]}, "action_dims"),
        ({"guidance": "residual", "action_scale": -1.0}, "action_scale .* must be positive"),
        (
            {"demonstrations": [Segment(RECORDED, floor=[0.1] * 2)], "constraints": None, "frame": None},
            "floor is one standard deviation, or 3",
        ),
        ({"template": "pouring"}, "guidance='kgrl' does not use template"),
        ({"guidance": "template", "template": "pouring", "template_frames": pose}, "does not use demonstrations"),
        ({"demonstrations": two_segments()}, "each Segment"),
        ({"kind": "dict_with_phase"}, "has an entry 'phase' already"),
        ({"guidance": "residual", "constraints": MotionConstraints(BOX, max_speed=np.ones(3))}, "enforce max_speed"),
        ({"orientation": "euler_zyx"}, "orientation needs poses of 6 outputs, and there are 3: leave it out"),
    ],
)
def test_invalid_argument_is_refused(keywords, message):
    with pytest.raises(InputError, match=message):
        make_guided(**keywords)


@pytest.mark.parametrize("invalid", [np.full(3, np.nan), np.zeros(2)], ids=["nan", "size"])
def test_invalid_pose_is_refused_at_reset(invalid):
    env = make_guided(pose=lambda env, observation: invalid)
    with pytest.raises(InputError, match="pose must return 3 finite numbers"):
        env.reset(seed=0)


class PouringPointEnv(PointEnv):
    """Point environment that starts 0.34 m from the mug of the test."""

    def reset(self, *, seed=None, options=None):
        result = super().reset(seed=seed, options=options)
        self.p = np.array([0.6, -0.3, 0.45])
        return result


def test_template_that_limits_the_force_is_refused():
    template = load_template("pouring")
    limited = replace(template, states=(replace(template.states[0], max_force_n=12.0), *template.states[1:]))
    guide.TemplateGuide(template, lambda env, observation: {}, 0.02)
    with pytest.raises(InputError, match="GuidedEnv has no controller that could follow the limit"):
        guide.TemplateGuide(limited, lambda env, observation: {}, 0.02)


def test_template_guides_within_its_active_constraints():
    frames = {"mug_tip": RigidTransform([0.6, 0.0, 0.3])}
    env = GuidedEnv(
        PouringPointEnv(),
        guidance="template",
        template="pouring",
        template_frames=lambda env, o: frames,
        pose=lambda env, o: transform_to_pose(RigidTransform(env.unwrapped.p)),
        to_action=lambda env, o, command, extra: np.append(np.clip((command[:3] - env.unwrapped.p) / 0.04, -1, 1), 0),
        period=0.02,
    )
    env.reset(seed=0)
    states = set()
    for _ in range(60):
        *_, info = env.step(np.array([0.0, 1.0, -1.0]))
        assert info["constraint_violation"] <= TOLERANCE
        states.add(info["segment"])
    assert len(states) > 1
    assert env.action_space.shape == (3,)


def test_scaled_command_of_a_template_is_in_its_frame():
    X_WF = RigidTransform(RotationMatrix.MakeZRotation(np.pi / 2), [6.0, -3.0, 3.0])
    template_guide = guide.TemplateGuide(load_template("pouring"), lambda env, observation: {"mug_tip": X_WF}, 0.02)
    X_FE = pose_to_transform(np.array([-0.1, -0.2, 0.15, 0.3, 0.1, -0.2]))
    template_guide.reset(None, None, transform_to_pose(X_WF @ X_FE))
    command = pose_to_transform(template_guide.command(None, None, np.zeros(3), np.zeros(6))[0].pose)
    scaled = template_guide.scaled_command()
    np.testing.assert_allclose(
        scaled * [0.2, 0.2, 0.2, np.pi, np.pi, np.pi], transform_to_pose(X_WF.inverse() @ command)
    )
    assert 0.1 < np.abs(scaled).max() < 1.5


def test_gymnasium_checker_accepts_the_environment():
    from gymnasium.utils.env_checker import check_env

    check_env(make_guided(), skip_render_check=True)
    assert isinstance(make_guided(), gymnasium.Wrapper)


@pytest.mark.parametrize("guidance", ["kgrl", "skgrl"])
def test_shapes_and_limits_apply_in_the_segment_frame(guidance):
    ball = Sphere([-0.2, -0.03, 0.0], 0.04)
    motion = MotionConstraints(BOX, [ball], np.full(3, 0.8), np.full(3, 8.0))
    env = make_guided(guidance, constraints=motion, action_scale=5.0)
    rng = np.random.default_rng(0)
    env.unwrapped.commands.clear()
    infos = run_episode(env, lambda k: rng.uniform(-1, 1, 3))
    local = np.array(env.unwrapped.commands) - env.unwrapped.target
    assert min(ball.distance(y) for y in local) >= 0.0
    assert max(BOX.violation(y) for y in local) <= TOLERANCE
    assert max(info["constraint_violation"] for info in infos[1:]) <= TOLERANCE
    displacements = np.diff(local, axis=0)
    assert np.abs(displacements).max() <= 0.8 * PERIOD * (1 + 1e-9)
    assert np.abs(np.diff(displacements, axis=0)).max() <= 8.0 * PERIOD**2 * (1 + 1e-6)


class TransientSuccess(gymnasium.Wrapper):
    """Environment that reports success at its fourth step only."""

    def step(self, action):
        self.count = getattr(self, "count", 0) + 1
        return *self.env.step(action)[:4], {"is_success": self.count == 4}


def test_success_inside_an_action_is_reported():
    keywords = {"demonstrations": RECORDED, "pose": pose, "to_action": to_action, "period": PERIOD, "action_repeat": 3}
    env = GuidedEnv(TransientSuccess(PointEnv()), **keywords)
    env.reset(seed=0)
    infos = [env.step(np.zeros(env.action_space.shape))[-1] for _ in range(3)]
    assert [bool(info["is_success"]) for info in infos] == [False, True, False]
    assert [info["control_steps"] for info in infos] == [3, 6, 9]
    env = GuidedEnv(TransientSuccess(PointEnv()), **keywords)
    row = rollout(env, lambda observation: np.zeros(3), seed=0)
    assert (row["success"], row["steps"]) == (1, RECORDED.times[0].size)


@pytest.mark.parametrize("reason", ["terminated", "truncated"])
def test_step_raises_after_the_end_of_an_episode(reason):
    segments = two_segments() if reason == "terminated" else [Segment(RECORDED, frame=at_target)]
    env = make_guided(demonstrations=segments, constraints=None, frame=None, action_repeat=60)
    env.reset(seed=0)
    _, _, terminated, truncated, _ = env.step(np.zeros(3))
    assert (terminated, truncated) == (reason == "terminated", reason == "truncated")
    before = env.unwrapped.p.copy()
    with pytest.raises(gymnasium.error.ResetNeeded, match="the episode has ended: call reset"):
        env.step(np.zeros(3))
    np.testing.assert_array_equal(env.unwrapped.p, before)
    env.reset(seed=0)
    env.step(np.zeros(3))


def test_step_raises_before_a_reset():
    env = GuidedEnv(PointEnv(), demonstrations=RECORDED, pose=pose, to_action=to_action, period=PERIOD)
    with pytest.raises(gymnasium.error.ResetNeeded, match="call reset"):
        env.step(np.zeros(env.action_space.shape))


@pytest.mark.parametrize(("guidance", "history"), [("kgrl", 4), ("kmp", 4), ("skgrl", 1), ("skgrl", 4)])
def test_acceleration_is_limited_from_segment_to_segment(guidance, history):
    limits = MotionConstraints(LinearConstraints.none(3), max_speed=np.full(3, 0.8), max_acceleration=np.full(3, 4.0))
    parts = [replace(part, frame=None, constraints=limits, until=None, dwell=0) for part in two_segments()]
    env = make_guided(guidance, demonstrations=parts, constraints=None, frame=None, history=history, action_repeat=1)
    infos = run_episode(env, lambda k: np.array([1.0, 0.3, 0.0]))
    commands = np.array([info["command"] for info in infos[1:]])
    at = next(k for k, info in enumerate(infos[1:]) if info["segment"] != infos[1]["segment"])
    assert np.abs(commands[at - 1] - commands[at - 2]).max() > 1e-3
    changes = np.abs(np.diff(commands, 2, axis=0)) / PERIOD**2
    assert changes[at - 2 : at].max() <= 4.0 * (1 + 1e-6)


@pytest.mark.parametrize("guidance", ["kgrl", "kmp", "skgrl"])
def test_fast_start_of_a_segment_avoids_an_obstacle(guidance):
    first, second = (replace(part, frame=None, until=None, dwell=0) for part in two_segments())
    env = make_guided(guidance, demonstrations=[first, second], constraints=None, frame=None, action_repeat=1)
    free = run_episode(env, lambda k: np.zeros(3))[1:]
    at = next(k for k, info in enumerate(free) if info["segment"] != free[0]["segment"])  # start of the second segment
    displacement = free[at - 1]["command"] - free[at - 2]["command"]
    # The motion approaches the ball, whose surface is 10 mm away.
    ball = Sphere(free[at - 1]["command"] + 0.06 * displacement / np.linalg.norm(displacement), 0.05)
    limits = MotionConstraints(LinearConstraints.none(3), [ball], max_acceleration=np.full(3, 0.2))
    parts = [first, replace(second, constraints=limits)]
    env = make_guided(guidance, demonstrations=parts, constraints=None, frame=None, action_repeat=1)
    infos = run_episode(env, lambda k: np.zeros(3))[1:]
    assert max(info["constraint_violation"] for info in infos[at:]) <= TOLERANCE
    assert infos[at]["fallback"] == 1


@pytest.mark.parametrize(("guidance", "last"), [("kgrl", 3.14), ("skgrl", 3.16)])
def test_angle_near_pi_is_continuous_in_the_next_segment(guidance, last):
    def rotation(first, last):
        """Return demonstrations of a rotation about z from one angle to another [rad]."""
        rng, t = np.random.default_rng(0), PERIOD * np.arange(20)
        angles = np.linspace(first, last, 20) + rng.normal(scale=0.02, size=(5, 1)) * np.sin(np.pi * t / t[-1])
        return Demonstrations([t] * 5, [np.column_stack([np.zeros((20, 3)), a, np.zeros((20, 2))]) for a in angles])

    limits = MotionConstraints(LinearConstraints.none(6), max_speed=np.full(6, 3.0), max_acceleration=np.full(6, 20.0))
    env = GuidedEnv(
        PointEnv(),
        demonstrations=[Segment(rotation(*ends), constraints=limits) for ends in ((2.0, last), (0.0, 0.1))],
        pose=lambda env, observation: np.array([0.0, 0.0, 0.0, 2.0, 0.0, 0.0]),
        to_action=lambda env, observation, command, extra: np.zeros(4),
        orientation="euler_zyx",
        guidance=guidance,
        period=PERIOD,
        action_repeat=1,
    )
    angles = np.unwrap([info["command"][3] for info in run_episode(env, lambda k: np.zeros(6))[1:]])
    assert np.ptp(angles[:20]) > 1.0
    assert np.abs(np.diff(angles)).max() <= 3.0 * PERIOD * (1 + 1e-6)
    assert np.abs(np.diff(angles, 2)).max() <= 20.0 * PERIOD**2 * (1 + 1e-6)


def test_step_raises_after_a_failed_reset():
    measured = np.zeros(3)
    env = make_guided(pose=lambda env, observation: measured)
    env.reset(seed=0)
    env.step(np.zeros(3))
    measured = np.full(3, np.nan)
    with pytest.raises(InputError, match="pose must return"):
        env.reset(seed=1)
    measured = np.zeros(3)
    with pytest.raises(gymnasium.error.ResetNeeded, match="call reset"):
        env.step(np.zeros(3))


@pytest.mark.parametrize("failing", ["to_action", "extra"])
@pytest.mark.parametrize("guidance", ["kgrl", "skgrl", "residual"])
def test_error_skips_no_command(failing, guidance):
    calls = {failing: 0}

    def fail_at_fourth_call(name, function):
        def call(*arguments):
            calls[name] = calls.get(name, 0) + 1
            if name == failing and calls[name] == 4:
                raise OSError("no connection")
            return function(*arguments)

        return call

    def commands(is_failing):
        """Return the commands of eight actions; a failed action is repeated."""
        wrap = fail_at_fourth_call if is_failing else lambda name, function: function
        segment = Segment(RECORDED, frame=at_target, constraints=BOX, extra=wrap("extra", lambda phase, is_over: 0.0))
        keywords = {"demonstrations": [segment], "constraints": None, "frame": None, "action_repeat": 1}
        env = make_guided(
            guidance, **keywords, to_action=wrap("to_action", lambda e, o, command, extra: np.append(command, 0))
        )
        env.reset(seed=0)
        results = []
        while len(results) < 8:
            with nullcontext() if not is_failing or calls[failing] != 3 else pytest.raises(OSError, match="connection"):
                results.append(env.step(np.full(3, 0.3))[-1]["command"])
        return results

    np.testing.assert_array_equal(commands(True), commands(False))


def test_template_frames_may_be_drake_transforms():
    drake, scaled = pytest.importorskip("pydrake.math"), []
    for X_WF in (RigidTransform([0.6, 0.0, 0.3]), drake.RigidTransform([0.6, 0.0, 0.3])):
        template_guide = guide.TemplateGuide(load_template("pouring"), lambda env, o, X=X_WF: {"mug_tip": X}, 0.02)
        template_guide.reset(None, None, np.array([0.6, -0.3, 0.45, 0.1, 0.0, 0.0]))
        output = template_guide.command(None, None, np.array([0.0, 1.0, -1.0]), np.zeros(6))[0].pose
        scaled.append(np.concatenate([output, template_guide.scaled_command()]))
    np.testing.assert_array_equal(*scaled)


class Integrator(Law):
    """Law that adds each action to its last command; without a finite action, its command is invalid."""

    def command(self, last, action, pose, wrench):
        return last + 0.01 * action if action[0] >= 0.0 else np.full(3, np.nan)


def test_law_with_memory_guides_any_environment():
    def make():
        return GuidedEnv(PointEnv(), guidance=Integrator(3), pose=pose, to_action=to_action, action_repeat=2)

    env = make()
    for _ in range(2):
        env.reset(seed=0)
        expected = env.unwrapped.p.copy()
        for action in ([1.0, 0.5, 0.0], [-1.0, 0.0, 0.0], [0.5, 0.0, 1.0]):
            *_, info = env.step(np.array(action))
            expected += 0.02 * np.array(action) if action[0] > 0.0 else 0.0
            np.testing.assert_allclose(info["command"], expected, atol=1e-12)
            assert info["fallback"] == (0 if action[0] > 0.0 else 2)
    assert env.action_space.shape == (3,)
    with pytest.raises(InputError, match="a guide does not use demonstrations"):
        make_guided(Integrator(3), constraints=None, frame=None)


def test_pose_in_another_unit_than_the_demonstrations_is_warned_of_once():
    env = make_guided(constraints=None, frame=None, pose=lambda env, observation: 1e3 * pose(env, observation))
    with pytest.warns(UserWarning, match="check units and frames of the measured pose"):
        env.reset(seed=0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env.reset(seed=1)


@pytest.mark.parametrize(
    ("changed", "message"),
    [(range(5), "the demonstrations are outside of the constraints by"), ([3], "demonstration 3 extends over")],
)
def test_demonstrations_in_another_unit_than_constraints_or_each_other_are_warned_of(changed, message):
    outputs = [1e3 * each if number in changed else each for number, each in enumerate(RECORDED.outputs)]
    box = LinearConstraints.box([-0.6] * 3, [0.1] * 3)
    env = make_guided(demonstrations=Demonstrations(RECORDED.times, outputs), constraints=box)
    with pytest.warns(UserWarning, match=message):
        env.reset(seed=0)


def test_start_at_the_demonstrations_causes_no_warning():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = make_guided()
        for seed in range(20):
            env.reset(seed=seed)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_action_far_outside_of_the_space_is_refused_before_a_step(sign):
    def to_action_in_millimeters(*arguments):
        return np.full_like(to_action(*arguments), sign * 1e3)

    env = make_guided(to_action=to_action_in_millimeters)
    env.reset(seed=0)
    before = env.unwrapped.p.copy()
    with pytest.raises(InputError, match="check the units of to_action, the demonstrations and the constraints"):
        env.step(np.zeros(3))
    np.testing.assert_array_equal(env.unwrapped.p, before)
