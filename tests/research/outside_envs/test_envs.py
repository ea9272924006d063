"""Guidance in metaworld and robosuite: every command satisfies the constraints. `make outside` runs the tests."""

from importlib import import_module

import numpy as np
import pytest

PACKAGES = {"peg": "metaworld", "assembly": "metaworld", "nut": "robosuite"}


def load(name):
    """Return a task; skip the test if its package is not installed."""
    pytest.importorskip(PACKAGES[name], reason=f"{PACKAGES[name]} is installed by make outside")
    return import_module(f"research.outside_envs.{name}").TASK


@pytest.mark.parametrize("name", PACKAGES)
def test_commands_satisfy_constraints_and_motion_ends(name):
    task = load(name)
    segments = task.make_segments(count=4)
    assert all(segment.recorded.num_demonstrations == 4 for segment in segments)
    env, rng = task.make("skgrl", 0, segments), np.random.default_rng(0)
    for seed in range(2):
        env.reset(seed=seed)
        done, worst = False, -np.inf
        while not done:
            _, _, terminated, truncated, info = env.step(rng.choice([-1.0, 1.0], env.action_space.shape[0]))
            worst, done = max(worst, info["constraint_violation"]), terminated or truncated
        assert worst <= 1e-9
        assert info["is_success"] or info["phase"] == 1.0


@pytest.mark.parametrize("name", PACKAGES)
def test_scene_is_reproducible_for_a_seed(name):
    env = load(name).make_env(0)
    first, _ = env.reset(seed=3)
    env.reset()
    second, _ = env.reset(seed=3)
    assert np.array_equal(first, second)
    assert not np.array_equal(first, env.reset(seed=4)[0])


@pytest.mark.parametrize("name", PACKAGES)
def test_assumed_goal_is_on_the_selected_side(name):
    task = load(name)
    env = task.make_env(0)
    smallest, largest = import_module(f"research.outside_envs.{name}").OFFSETS
    for side in (-1.0, 1.0):
        env.reset(seed=5, options={"side": side})
        assert smallest <= side * (env.assumed_goal - env.true_goal)[1] <= largest


def test_scheduled_actions_insert_the_peg_on_both_sides():
    task = load("peg")
    env = task.make("kgrl", 0, task.make_segments())
    for episode, side in enumerate((-1.0, 1.0)):
        _, info = env.reset(seed=20_000 + episode, options={"side": side})
        done = False
        while not done:
            *_, terminated, truncated, info = env.step(task.schedule[info["segment"]])
            done = terminated or truncated
        assert info["is_success"]
