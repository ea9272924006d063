"""Pouring by scripted policies, adversaries and unconstrained inputs."""

import gymnasium
import numpy as np
import pytest

import guiderail  # noqa: F401 (registers the environments)
from guiderail.diagrams.envs.make import make_env
from guiderail.diagrams.tasks.pouring.task import START_HEIGHT, START_RADIUS, scripted_pour
from guiderail.models.common.errors import InputError
from research.action_fuzzing.pouring import ADVERSARIES


@pytest.fixture(scope="module")
def env():
    return make_env("Pouring")


@pytest.fixture(scope="module")
def unconstrained():
    return make_env("Pouring", active_constraints=False)


def run(env, inputs, seed=None, options=None, limit=150, watch=None):
    """An episode: how it ended, its return, and its actions."""
    observation, info = env.reset(seed=seed, options=options)
    total, actions = 0.0, []
    for _ in range(limit):
        action = inputs(observation)
        actions.append(action)
        observation, reward, terminated, truncated, info = env.step(action)
        total += reward
        if watch:
            watch(env, info)
        if terminated or truncated:
            break
    return info, total, actions


def test_is_registered():
    made = gymnasium.make("guiderail/Pouring-v0", guidance="none", reward="sparse")
    assert made.action_space.shape == (6,)
    assert made.observation_space.shape == (6,)


# The corners of where episodes start, and its middle.
STARTS = [
    (radius * np.cos(np.deg2rad(azimuth)), radius * np.sin(np.deg2rad(azimuth)), height)
    for azimuth, radius, height in [(-120, 0.24, 0.08), (-120, 0.30, 0.19), (-75, 0.24, 0.19), (-75, 0.30, 0.08)]
]


@pytest.mark.parametrize("start", STARTS)
def test_scripted_policy_pours_because_of_the_constraints(env, unconstrained, start):
    info, total, actions = run(env, scripted_pour, seed=1, options={"start": start})
    assert info["termination"] == "success"
    assert total > 200.0
    assert env.trace.statistics()["max_commanded_violation"] <= 1e-9
    assert env.trace.statistics()["collisions"] == 0.0
    # The same inputs, or the same scripted policy, which reacts: the result does not depend on it.
    replay = iter([*actions, *[actions[-1]] * 150])
    second = scripted_pour if STARTS.index(start) % 2 else lambda observation: next(replay)
    info, _, _ = run(unconstrained, second, seed=1, options={"start": start})
    assert info["termination"] in ("collision", "spill")


@pytest.mark.parametrize("adversary", ADVERSARIES)
def test_adversaries_neither_collide_nor_leave_constraints(env, adversary):
    rng = np.random.default_rng([7, list(ADVERSARIES).index(adversary)])
    tilts, worst = [], []

    def watch(env, info):
        context = env.simulator.get_context()
        state = env.task.diagram.GetOutputPort("state").Eval(context)[0]
        turn = env.task.diagram.GetOutputPort("observation").Eval(context)[3:]
        tilts.append((state, np.hypot(turn[0], turn[1])))
        worst.append(info["constraint_violation"])

    info, _, _ = run(env, ADVERSARIES[adversary](rng), seed=int(rng.integers(2**31)), limit=35, watch=watch)
    assert info["termination"] not in ("collision", "spill")
    assert max(worst) <= 1e-9
    # Upright until the tilt is allowed, as far as the arm's drives track.
    assert max((tilt for state, tilt in tilts if state == 0), default=0.0) < np.deg2rad(3.0)


def test_unguided_velocity_reaches_collisions():
    env = make_env("Pouring", guidance="none", reward="hand_shaped")
    info, total, _ = run(env, lambda observation: np.array([0.0, 1.0, -0.6, 0.0, 0.0, 0.0]), seed=0)
    assert info["termination"] in ("collision", "spill")
    assert total < 0.0


def test_the_constraints_are_a_safety_filter_behind_a_velocity():
    env = make_env("Pouring", guidance="none", reward="sparse", active_constraints=True)
    rng = np.random.default_rng(0)
    for seed in range(2):
        held = np.sign(rng.normal(size=6))
        info, _, _ = run(env, lambda observation, held=held: held, seed=seed, limit=30)
        assert info["termination"] not in ("collision", "spill")
        assert info["constraint_violation"] <= 1e-9


@pytest.mark.parametrize(
    ("mug", "position"),
    [({"mug_inner_diameter": 0.10, "mug_depth": 0.075}, (0.03, -0.03)), ({"mug_inner_diameter": 0.07}, (-0.03, 0.02))],
)
def test_template_follows_the_objects_of_each_episode(mug, position):
    env = make_env("Pouring", **mug)
    info, _, _ = run(env, scripted_pour, seed=1, options={"mug_position": position})
    assert info["termination"] == "success"
    assert env.trace.statistics()["max_commanded_violation"] <= 1e-9


def test_faster_inputs_are_as_safe():
    env = make_env("Pouring", reward="sparse", action_repeat=20)
    info, _, _ = run(env, scripted_pour, seed=3)
    assert info["termination"] == "success"
    assert info["control_steps"] < 250
    assert env.trace.statistics()["max_commanded_violation"] <= 1e-9
    rng = np.random.default_rng(0)
    info, _, _ = run(env, ADVERSARIES["noisy_pour"](rng), seed=3, limit=15)
    assert info["termination"] not in ("collision", "spill")


def test_starts_are_drawn_and_repeat_with_the_seed(env):
    first = env.reset(seed=3)[1]["start"]
    second = env.reset()[1]["start"]
    assert not np.allclose(first, second)
    np.testing.assert_array_equal(env.reset(seed=3)[1]["start"], first)


def test_held_out_starts_are_none_of_trainings(env):
    trained = [env.reset(seed=seed)[1]["start"] for seed in range(5)]
    held_out = [env.reset(seed=seed, options={"held_out": True})[1]["start"] for seed in range(5)]
    assert not np.isin(held_out, trained).any()
    np.testing.assert_array_equal(env.reset(seed=4, options={"held_out": True})[1]["start"], held_out[4])
    # From the same places nevertheless: `held_out` is about which starts, not about harder ones.
    radii, heights = np.hypot(*np.transpose(held_out)[:2]), np.transpose(held_out)[2]
    np.testing.assert_array_equal(np.clip(radii, *START_RADIUS), radii)
    np.testing.assert_array_equal(np.clip(heights, *START_HEIGHT), heights)


def test_an_episode_repeats_to_the_last_bit(env):
    def episode():
        observation, _ = env.reset(seed=5)
        seen = [observation]
        for _ in range(12):
            seen.append(env.step(scripted_pour(seen[-1]))[0])
        return np.array(seen)

    first = episode()
    run(env, scripted_pour, seed=9, limit=12)
    np.testing.assert_array_equal(episode(), first)


def test_the_balls_stay_in_the_thermos_until_it_is_poured(env):
    env.reset(seed=0)
    station = env.task.diagram.GetSubsystemByName("station")
    for _ in range(10):
        env.step(np.zeros(3))
    context = station.GetMyContextFromRoot(env.simulator.get_context())
    balls = station.GetOutputPort("balls_in_thermos").Eval(context).reshape(2, 6)
    thermos = station.config.thermos
    assert all(thermos.contains(p) for p in balls[:, :3])
    # And they lie there: the lower one on the bottom.
    assert balls[:, 2].min() == pytest.approx(-thermos.depth + 0.02, abs=2e-3)


def test_shaping_is_the_progress_of_the_template(env):
    """Equation 3.7: over an episode the shaping adds up, whatever the way."""
    sums = {"shaping": 0.0, "action_cost": 0.0, "terminal_reward": 0.0}

    def watch(env, info):
        for name in sums:
            sums[name] += info[name]

    _, total, actions = run(env, scripted_pour, seed=2, watch=watch)
    assert sums["terminal_reward"] == 200.0
    assert total == pytest.approx(sum(sums.values()))
    # The last action's cost counts for as long as it lasted.
    cost = [float(a @ a) for a in np.clip(actions, -1.0, 1.0)]
    assert -sum(cost) - 1e-9 <= sums["action_cost"] <= -sum(cost[:-1]) + 1e-9
    # From the start's distance to wherever the tilt ended, 5 a meter and 0.0175 a degree, times 200.
    assert 200.0 * 1.2 < sums["shaping"] < 200.0 * 2.8


def test_hand_shaped_reward_is_the_thesiss():
    env = make_env("Pouring", guidance="none", reward="hand_shaped")
    observation, _ = env.reset(seed=0)
    j = np.linalg.norm(observation[:3] / 5.0)
    observation, reward, *_, info = env.step(np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0]))
    j_after = np.linalg.norm(observation[:3] / 5.0)
    assert info["approach"] == pytest.approx(15.0 * (j - j_after), abs=1e-5)  # float32 observations
    assert info["tilting"] <= 0.0
    assert reward == pytest.approx(info["approach"] + info["tilting"] - 1.0, abs=1e-9)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"guidance": "kgrl"}, "needs demonstrations, which Pouring doesn't have: use none, sct"),
        ({"reward": "dense"}, "hand_shaped"),
        ({"observation": "image"}, "state"),
        ({"mug_offset": 1.0}, "at most 0.04"),
        ({"mug_inner_diameter": 0.03}, "too small for the balls"),
        ({"mug_inner_diameter": 0.03, "ball_diameter": 0.03}, "stay within 0.0375 to 0.2 m and 0.045 to 0.25 m"),
        ({"input_speed": 5.0}, "at most 2"),
    ],
)
def test_refuses_what_makes_no_sense(arguments, said):
    with pytest.raises(InputError, match=said):
        make_env("Pouring", **arguments)


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
def test_refuses_reset_options_that_make_no_sense(env, options):
    with pytest.raises(InputError):
        env.reset(options=options)


def test_unreachable_start_is_resampled_or_refused_when_given():
    env = gymnasium.make("guiderail/Pouring-v0", guidance="sct", mug_offset=0.04)
    _, info = env.reset(seed=11)  # whose first draw is beyond a joint's limit
    far = {"start": [-0.15, -0.26, 0.19], "mug_position": [-0.04, -0.04]}
    with pytest.raises(InputError, match="joint's limit"):
        env.reset(seed=11, options=far)
    assert np.abs(info["mug_position"]).max() <= 0.04
