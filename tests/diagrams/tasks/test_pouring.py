"""Environment Pouring: scripted policies, adversaries, rewards, starts and options."""

import gymnasium
import numpy as np
import pytest

import guiderail  # noqa: F401 (registers the environments)
from guiderail.diagrams.envs.make import make_env
from guiderail.diagrams.tasks.pouring import scripted_pour
from guiderail.models.common.errors import InputError
from research.action_fuzzing.pouring import ADVERSARIES


@pytest.fixture(scope="module")
def env():
    return make_env("Pouring")


@pytest.fixture(scope="module")
def unconstrained():
    return make_env("Pouring", active_constraints=False)


def run(env, policy, seed=None, options=None, max_actions=150, on_step=None):
    """Run an episode; return the last info, the return and the actions."""
    observation, info = env.reset(seed=seed, options=options)
    total, actions = 0.0, []
    for _ in range(max_actions):
        action = policy(observation)
        actions.append(action)
        observation, reward, terminated, truncated, info = env.step(action)
        total += reward
        if on_step:
            on_step(env, info)
        if terminated or truncated:
            break
    return info, total, actions


def test_spaces_are_those_of_velocity_without_guidance():
    env = gymnasium.make("guiderail/Pouring-v0", guidance="none", reward="sparse")
    assert env.action_space.shape == (6,)
    assert env.observation_space.shape == (6,)


# Starts [m] at opposite corners of their range: azimuth [°], radius and height [m].
STARTS = [
    (radius * np.cos(np.deg2rad(azimuth)), radius * np.sin(np.deg2rad(azimuth)), height)
    for azimuth, radius, height in [(-120, 0.30, 0.19), (-75, 0.24, 0.08)]
]


@pytest.mark.parametrize("start", STARTS)
def test_scripted_policy_pours_only_with_the_constraints(env, unconstrained, start):
    info, total, actions = run(env, scripted_pour, seed=1, options={"start": start})
    assert info["termination"] == "success"
    assert total > 200.0
    assert env.trace.statistics()["max_commanded_violation"] <= 1e-9
    assert env.trace.statistics()["collisions"] == 0.0
    # Without constraints: the recorded actions for the first start, the scripted policy for the second.
    recorded = iter([*actions, *[actions[-1]] * 150])
    policy = scripted_pour if STARTS.index(start) % 2 else lambda observation: next(recorded)
    info, _, _ = run(unconstrained, policy, seed=1, options={"start": start})
    assert info["termination"] in ("collision", "spill")


@pytest.mark.parametrize("adversary", ADVERSARIES)
def test_adversary_neither_collides_nor_violates_constraints(env, adversary):
    rng = np.random.default_rng([7, list(ADVERSARIES).index(adversary)])
    tilts, violations = [], []

    def on_step(env, info):
        context = env.simulator.get_context()
        state = env.diagram.diagram.GetOutputPort("state").Eval(context)[0]
        turn = env.diagram.diagram.GetOutputPort("observation").Eval(context)[3:]
        tilts.append((state, np.hypot(turn[0], turn[1])))
        violations.append(info["constraint_violation"])

    info, _, _ = run(env, ADVERSARIES[adversary](rng), seed=int(rng.integers(2**31)), max_actions=20, on_step=on_step)
    assert info["termination"] not in ("collision", "spill")
    assert max(violations) <= 1e-9
    # The thermos is upright in state 0, up to the tracking error of the arm.
    assert max((tilt for state, tilt in tilts if state == 0), default=0.0) < np.deg2rad(3.0)


def test_velocity_ends_in_a_collision_without_guidance():
    env = make_env("Pouring", guidance="none", reward="hand_shaped")
    info, total, _ = run(env, lambda observation: np.array([0.0, 1.0, -0.6, 0.0, 0.0, 0.0]), seed=0)
    assert info["termination"] in ("collision", "spill")
    assert total < 0.0


def test_active_constraints_filter_a_velocity():
    env = make_env("Pouring", guidance="none", reward="sparse", active_constraints=True)
    rng = np.random.default_rng(0)
    corner = np.sign(rng.normal(size=6))
    info, _, _ = run(env, lambda observation: corner, seed=0, max_actions=30)
    assert info["termination"] not in ("collision", "spill")
    assert info["constraint_violation"] <= 1e-9


@pytest.mark.parametrize(
    ("mug", "position"),
    [({"mug_inner_diameter": 0.10, "mug_depth": 0.075}, (0.03, -0.03)), ({"mug_inner_diameter": 0.07}, (-0.03, 0.02))],
)
def test_scripted_policy_pours_into_other_mugs_and_positions(mug, position):
    env = make_env("Pouring", **mug)
    info, _, _ = run(env, scripted_pour, seed=1, options={"mug_position": position})
    assert info["termination"] == "success"
    assert env.trace.statistics()["max_commanded_violation"] <= 1e-9


def test_starts_are_sampled_and_repeat_with_the_seed(env):
    first = env.reset(seed=3)[1]["start"]
    second = env.reset()[1]["start"]
    assert not np.allclose(first, second)
    np.testing.assert_array_equal(env.reset(seed=3)[1]["start"], first)


def test_balls_rest_in_the_thermos_when_the_action_is_zero(env):
    env.reset(seed=0)
    station = env.diagram.diagram.GetSubsystemByName("station")
    for _ in range(10):
        env.step(np.zeros(3))
    context = station.GetMyContextFromRoot(env.simulator.get_context())
    balls = station.GetOutputPort("balls_in_thermos").Eval(context).reshape(2, 6)
    thermos = station.config.thermos
    assert all(thermos.contains(p) for p in balls[:, :3])
    # The lower ball rests on the bottom: its center is 20 mm, one radius, above.
    assert balls[:, 2].min() == pytest.approx(-thermos.depth + 0.02, abs=2e-3)


def test_sum_of_shaping_is_the_progress_of_the_template(env):
    """Equation 3.7: the sum of the shaping over an episode depends only on the first and the last pose."""
    sums = {"shaping": 0.0, "action_cost": 0.0, "terminal_reward": 0.0}

    def on_step(env, info):
        for name in sums:
            sums[name] += info[name]

    _, total, actions = run(env, scripted_pour, seed=2, on_step=on_step)
    assert sums["terminal_reward"] == 200.0
    assert total == pytest.approx(sum(sums.values()))
    # The last action may cost less than the others, because the episode ends before its last control step.
    costs = [float(action @ action) for action in np.clip(actions, -1.0, 1.0)]
    assert -sum(costs) - 1e-9 <= sums["action_cost"] <= -sum(costs[:-1]) + 1e-9
    # The progress is 5 per meter of approach and 0.0175 per degree of tilt; the shaping is 200 times the progress.
    assert 200.0 * 1.2 < sums["shaping"] < 200.0 * 2.8


def test_hand_shaped_reward_is_that_of_the_thesis():
    env = make_env("Pouring", guidance="none", reward="hand_shaped")
    observation, _ = env.reset(seed=0)
    distance = np.linalg.norm(observation[:3] / 5.0)
    observation, reward, *_, info = env.step(np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0]))
    distance_after = np.linalg.norm(observation[:3] / 5.0)
    assert info["approach"] == pytest.approx(15.0 * (distance - distance_after), abs=1e-5)  # float32 observations
    assert info["tilting"] <= 0.0
    assert reward == pytest.approx(info["approach"] + info["tilting"] - 1.0, abs=1e-9)


@pytest.mark.parametrize(
    "options",
    [
        {"strat": (0, 0, 0)},
        {"start": (0, 0)},
        {"start": (np.nan, 0, 0)},
        {"start": (5, 5, 5)},
        {"start": (0.1, -0.25, 0.25)},
        {"mug_position": (0.5, 0.0)},
    ],
)
def test_reset_option_is_refused_when_invalid(env, options):
    with pytest.raises(InputError):
        env.reset(options=options)


def test_unreachable_start_is_resampled_or_refused_if_given():
    env = gymnasium.make("guiderail/Pouring-v0", guidance="sct", mug_offset=0.04)
    _, info = env.reset(seed=11)  # the first sample of this seed exceeds a joint limit
    far = {"start": [-0.15, -0.26, 0.19], "mug_position": [-0.04, -0.04]}
    with pytest.raises(InputError, match="joint's limit"):
        env.reset(seed=11, options=far)
    assert np.abs(info["mug_position"]).max() <= 0.04
