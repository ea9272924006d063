"""Pouring with several balls, some of which must fall into the mug."""

import numpy as np
import pytest

from guiderail.diagrams.envs.config import EnvConfig
from guiderail.diagrams.envs.make import make_env
from guiderail.diagrams.stations.pouring import PouringConfig
from guiderail.diagrams.tasks.pouring import scripted_pour_aimed
from guiderail.models.objects.pouring import Ball

OPTIONS = {"balls": 6, "balls_in": 5, "ball_diameter": 0.026}
# Positions of a ball [m] in the frame of the mug's tip.
IN_MUG, FALLEN, IN_THERMOS = [0.0, 0.0, -0.05], [0.3, 0.0, -0.2], [0.3, 0.0, 0.1]


def outcome(in_mug, fallen):
    """Return success and spill of the task with six balls, of which five are required; the rest are in the thermos."""
    positions = [IN_MUG] * in_mug + [FALLEN] * fallen + [IN_THERMOS] * (6 - in_mug - fallen)
    balls = np.array([[*position, 0.0, 0.0, 0.0] for position in positions]).ravel()
    conditions = EnvConfig.resolve("Pouring", OPTIONS).declared.done()
    return conditions["success"].holds(balls), conditions["spill"](balls, balls)


@pytest.mark.parametrize(
    ("in_mug", "fallen", "expected"),
    [
        (6, 0, (True, False)),
        (5, 0, (True, False)),
        (4, 0, (False, False)),
        (5, 1, (True, False)),
        (4, 1, (False, False)),
        (4, 2, (False, True)),
        (0, 6, (False, True)),
    ],
)
def test_five_balls_are_a_success_and_two_fallen_are_a_spill(in_mug, fallen, expected):
    assert outcome(in_mug, fallen) == expected


@pytest.mark.parametrize(("number", "diameter"), [(2, 0.04), (3, 0.04), (6, 0.026), (8, 0.02)])
def test_balls_start_inside_the_thermos_without_overlap(number, diameter):
    config = PouringConfig(ball=Ball(diameter=diameter), num_balls=number)
    positions = config.stack()
    distances = np.linalg.norm(positions[:, None] - positions, axis=2)[~np.eye(number, dtype=bool)]
    assert distances.min() >= diameter - 1e-9
    assert all(config.thermos.contains(position) for position in positions)
    assert np.abs(positions[:, 0]).max() + diameter / 2 <= config.thermos.inner_diameter / 2 + 1e-9


@pytest.mark.parametrize("control_period", [0.01, 0.02, 0.05])
def test_success_requires_balls_in_the_mug_for_0_1_s(control_period):
    config = EnvConfig.resolve("Pouring", {"control_period": control_period})
    steps = config.steps_of(config.declared.done()["success"].seconds)
    assert steps * control_period == pytest.approx(0.1)


def test_aimed_policy_pours_five_of_six_balls():
    env = make_env("Pouring", difficulty="hard", **OPTIONS)
    observation, _ = env.reset(seed=1, options={"mug_error": (0.045, 0.0)})
    is_over = False
    while not is_over:
        observation, _, terminated, truncated, info = env.step(scripted_pour_aimed(observation))
        is_over = terminated or truncated
    assert info["termination"] == "success"
    assert env.trace.statistics()["max_commanded_violation"] <= 1e-9
