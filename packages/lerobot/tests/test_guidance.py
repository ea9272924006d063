"""Guidance that follows a base policy: reference, constraints, guard and refused options."""

from types import SimpleNamespace

import numpy as np
import pytest

from guiderail.diagrams.envs.make import make_env
from guiderail.models.common.errors import InputError
from guiderail.models.control.motion_constraints import MotionConstraints
from guiderail.models.primitives import LinearConstraints
from guiderail_lerobot.base_policy import BASE_POLICIES, base_policy_key
from guiderail_lerobot.guidance import guard_limits

KINDS = ("kgrl_base_policy", "residual_base_policy")


def run(env, actions, seed=0):
    """Return the trace of an episode with the given actions, or of its beginning if the actions end before."""
    env.reset(seed=seed)
    for action in actions:
        *_, terminated, truncated, _ = env.step(action)
        if terminated or truncated:
            break
    return env.unwrapped.trace


@pytest.fixture
def register(monkeypatch):
    """Return a function that registers base policies for the test only."""
    monkeypatch.setattr(BASE_POLICIES, "_entries", {})
    monkeypatch.setattr(BASE_POLICIES, "_origins", {})
    return BASE_POLICIES.register


@pytest.mark.parametrize(("kind", "plain"), [*zip(KINDS, ("kgrl", "residual"), strict=True)])
def test_guidance_equals_plain_guidance_without_base_policy(kind, plain):
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (4, 2))
    traces = [run(make_env("NarrowPassage", guidance=name, action_repeat=5), actions) for name in (kind, plain)]
    assert (traces[0].commanded == traces[1].commanded).all()
    assert (traces[0].measured == traces[1].measured).all()


@pytest.mark.parametrize("kind", KINDS)
def test_command_follows_the_chunk_of_each_observation(kind, register):
    observations = []

    def hold(observation):
        observations.append(observation.copy())
        return np.tile([[0.05, 0.02]], (3, 1)) + np.outer(np.arange(3), [1e-3, 0.0])

    register("hold", hold)
    env = make_env("NarrowPassage", guidance=kind, base_policy="hold", action_repeat=5)
    observation, _ = env.reset(seed=0)
    env.step(np.zeros(2))
    assert (observations[0] == observation).all()  # the learned policy has the same observation
    assert len(observations) == 1
    env.step(np.zeros(2))
    assert len(observations) == 2
    assert np.allclose(env.unwrapped.trace.commanded[-1], [0.052, 0.02], atol=3e-3)


def test_diagram_is_not_reused_when_base_policy_is_replaced(register):
    def last_y(y):
        register("line", lambda observation: np.tile([[0.05, y]], (8, 1)))
        env = make_env("NarrowPassage", guidance="base_policy", base_policy={"policy": "line", "guard": "none"})
        trace = run(env, np.zeros((2, 2)))
        env.close()
        return trace.commanded[-1, 1]

    assert [last_y(y) for y in (0.02, 0.03)] == pytest.approx([0.02, 0.03])


def test_key_changes_when_a_policy_file_is_replaced(tmp_path):
    file = tmp_path / "policy.safetensors"
    file.write_bytes(b"one")
    before = base_policy_key(str(tmp_path))
    assert before == base_policy_key(str(tmp_path))
    (tmp_path / "new").write_bytes(b"two")
    (tmp_path / "new").replace(file)
    assert before != base_policy_key(str(tmp_path))


def test_commands_satisfy_constraints_for_any_base_policy(register):
    random = np.random.default_rng(1)
    register("random", lambda observation: random.uniform(-1.0, 1.0, (3, 8, 2)))
    env = make_env("NarrowPassage", guidance="kgrl_base_policy", base_policy="random", action_repeat=1)
    trace = run(env, random.choice([-1.0, 1.0], (60, 2)))
    assert len(trace) == 60
    assert trace.signals["commanded_violation"].max() <= 1e-9
    worst = -np.inf
    for index, corner in enumerate([(1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0)]):
        register(f"corner{index}", lambda observation, corner=corner: np.tile(corner, (8, 1)))
        free = make_env("NarrowPassage", guidance="residual_base_policy", base_policy=f"corner{index}")
        worst = max(worst, run(free, np.zeros((1, 2))).signals["commanded_violation"].max())
    assert worst > 0.1  # [m]; residual guidance does not enforce the constraint


def test_base_policy_is_refused_when_not_registered():
    with pytest.raises(InputError, match="no base policy 'missing'"):
        make_env("NarrowPassage", guidance="kgrl_base_policy", base_policy="missing")


def test_base_policy_is_refused_when_the_observation_is_an_image(register):
    register("hold", lambda observation: np.zeros((2, 2)))
    with pytest.raises(InputError, match="takes no images"):
        make_env("NarrowPassage", guidance="kgrl_base_policy", base_policy="hold", observation="image")


def test_action_range_grows_with_the_spread_of_the_chunks(register):
    ranges = {}
    for name, spread in (("agree", 0.0), ("disagree", 0.02)):
        chunks = np.tile([[0.05, 0.0]], (2, 6, 1)) + np.array([[[spread, 0.0]], [[-spread, 0.0]]])
        register(name, lambda observation, chunks=chunks: chunks)
        env = make_env(
            "NarrowPassage",
            guidance="kgrl_base_policy",
            base_policy={"policy": name, "covariance_floor": 0.1},
            horizon=5,
        )
        commands = [run(env, np.tile([action, 0.0], (3, 1))).commanded[-1, 0] for action in (0.0, 1.0)]
        ranges[name] = commands[1] - commands[0]
    assert ranges["disagree"] > ranges["agree"] + 0.01


@pytest.mark.parametrize("guard", ["projection", "slowdown"])
def test_guarded_commands_satisfy_bound_speed_and_jerk(guard, register):
    random, limits = np.random.default_rng(2), {"max_speed": (0.3,), "base_policy.max_jerk": (40.0,), "horizon": 11}
    register("jumps", lambda observation: np.tile(random.uniform(-1.0, 1.0, 2), (8, 1)))
    options = {"guidance": "base_policy", "base_policy": "jumps", "action_repeat": 1}
    env = make_env("NarrowPassage", **options, **limits, **{"base_policy.guard": guard})
    trace = run(env, np.ones((60, 2)))
    period = trace.period
    assert np.abs(np.diff(trace.commanded, axis=0)).max() <= 0.3 * period
    assert np.abs(np.diff(trace.commanded, n=3, axis=0)).max() <= 40.0 * period**3
    assert trace.signals["commanded_violation"].max() <= 1e-9
    assert np.ptp(trace.commanded, axis=0).max() > 0.01
    free = run(
        make_env("NarrowPassage", horizon=11, **options, **{"base_policy.guard": "none"}), np.ones((60, 2))
    ).commanded
    assert np.abs(np.diff(free, axis=0)).max() > 10 * 0.3 * period


def test_chunks_are_commanded_unchanged_without_guard(register):
    register("line", lambda observation: np.outer(np.arange(1.0, 9.0), [1e-3, 2e-3]))
    env = make_env(
        "NarrowPassage", guidance="base_policy", base_policy={"policy": "line", "guard": "none", "replan_steps": 4}
    )
    commanded = run(env, np.zeros((8, 2))).commanded
    np.testing.assert_allclose(commanded[:8], np.outer(np.tile(np.arange(1.0, 5.0), 2), [1e-3, 2e-3]), atol=1e-12)


def test_demonstrations_pass_the_default_guard_unchanged():
    guarded, plain = (
        run(
            make_env("NarrowPassage", guidance="base_policy", base_policy={"guard": guard}, action_repeat=20),
            np.zeros((4, 2)),
        )
        for guard in ("projection", "none")
    )
    np.testing.assert_allclose(guarded.commanded[15:], plain.commanded[15:], atol=1e-6)


def test_guard_limits_are_required_for_unmoved_outputs():
    means = np.pad(np.random.default_rng(0).normal(size=(9, 3)), ((0, 0), (0, 3)))
    motion = MotionConstraints(LinearConstraints.none(6), max_speed=[0.3] * 3 + [1.0] * 3)
    config = SimpleNamespace(num_outputs=6, motion=motion, control_period=0.02, reference=SimpleNamespace(means=means))
    with pytest.raises(InputError, match=r"do not move the outputs 3, 4, 5 .* give max_speed and max_jerk"):
        guard_limits(config, (40.0,))
    assert (np.array(guard_limits(config, (40.0, 300.0))) > 0.0).all()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"base_policy.max_jerk": (1.0, 1.0, 1.0)}, "max_jerk is 1, 2"),
        ({"base_policy.max_jerk": (-1.0,)}, "positive"),
        ({"max_acceleration": (1.0,)}, "leave max_acceleration"),
        ({"base_policy.replan_steps": 42}, "steps"),
        ({"progress": "state"}, "clock"),
        ({"base_policy.guard": "brake"}, "brake"),
        ({"base_policy.guard": "none", "max_speed": (0.3,)}, "guard=none enforces no limits"),
        ({"base_policy.guard": "none", "base_policy.max_jerk": (40.0,)}, "guard=none enforces no limits"),
    ],
)
def test_guard_is_refused_when_an_option_does_not_fit(options, words):
    with pytest.raises(InputError, match=words):
        make_env("NarrowPassage", guidance="base_policy", **options)
