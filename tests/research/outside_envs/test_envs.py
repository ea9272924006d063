"""Guidance in metaworld: demonstrations are found, every command is inside. `make outside` runs this."""

import numpy as np
import pytest

pytest.importorskip("metaworld", reason="metaworld is installed by make outside")


@pytest.mark.parametrize("task", ["peg", "assembly"])
def test_commands_satisfy_the_constraints_and_the_motion_reaches_the_end(task):
    from importlib import import_module

    module = import_module(f"research.outside_envs.{task}")
    segments = module.make_segments(count=6)
    assert all(segment.recorded.num_demonstrations == 6 for segment in segments)
    env, rng = module.make("skgrl", 0, segments), np.random.default_rng(0)
    for seed in range(3):
        env.reset(seed=seed)
        done, worst = False, -np.inf
        while not done:
            _, _, terminated, truncated, info = env.step(rng.choice([-1.0, 1.0], 3))
            worst, done = max(worst, info["constraint_violation"]), terminated or truncated
        assert worst <= 1e-9
        assert info["is_success"] or info["phase"] == 1.0


def test_two_attempts_insert_the_peg_on_both_sides():
    from research.outside_envs import peg

    env = peg.make("kgrl", 0, peg.make_segments())
    for episode, side in enumerate((-1.0, 1.0)):
        _, info = env.reset(seed=20_000 + episode, options={"side": side})
        done, segment = False, "reach"
        while not done:
            first = segment in ("reach", "grasp", "carry", "insert")
            *_, terminated, truncated, info = env.step(np.array([0.0, -0.7 if first else 0.7, 0.3]))
            segment, done = info["segment"], terminated or truncated
        assert info["is_success"]
