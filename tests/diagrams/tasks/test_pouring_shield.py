"""Shield of pouring at difficulty hard: the thermos only tilts over the pour line of the observed mug."""

import numpy as np
import pytest
from pydrake.math import RigidTransform

from guiderail.diagrams.envs.make import make_env
from guiderail.diagrams.stations.pouring import PouringConfig
from guiderail.diagrams.tasks.pouring import (
    MAX_MUG_ERROR,
    POUR_LINE,
    THESIS,
    frames_of,
    make_template,
    scripted_pour,
)

PERIOD = 0.01
TOLERANCE = 1e-6


@pytest.fixture(scope="module")
def template():
    return make_template(PouringConfig(), aim=True, shield=True)


def tilt_deg(X):
    return np.rad2deg(np.arccos(np.clip(X.rotation().matrix()[2, 2], -1, 1)))


@pytest.mark.parametrize("seed", range(4))
def test_tilt_is_bounded_away_from_the_pour_line_under_random_inputs(template, seed):
    rng = np.random.default_rng(seed)
    angle, size = rng.uniform(-np.pi, np.pi), rng.uniform(0, MAX_MUG_ERROR)
    observed = RigidTransform([size * np.cos(angle), size * np.sin(angle), 0.0])
    frames = frames_of(template, RigidTransform(), observed)
    X = template.project(0, RigidTransform([0.0, -0.25, 0.1]), frames)
    state, inputs, tilted = template.state_at(X, frames), np.zeros(3), 0
    line = observed.translation()[:2] + POUR_LINE
    for step in range(1500):
        if step % 20 == 0:
            inputs = np.sign(rng.normal(size=3))
            if rng.uniform() < 0.7:  # random inputs alone seldom reach the last states
                to_line = line - X.translation()[:2]
                inputs = np.clip([*(to_line / 0.02), -1.0 if state < 2 else 1.0], -1, 1)
        request = template.displace(X, template.map(state, inputs, X, frames, PERIOD))
        X = template.command(state, X, request, frames, PERIOD).X_WE
        state = template.next_state(state, X, frames, PERIOD)
        if tilt_deg(X) > template.parameters["pour_deg"] + TOLERANCE:
            tilted += 1
            away = np.linalg.norm(X.translation()[:2] - line)
            assert away <= template.parameters["line_m"] + 0.005 + TOLERANCE
    assert tilted > 0 or size > 0.045  # the last states were tested


def test_pour_line_is_at_the_observed_mug(template):
    frames = frames_of(template, RigidTransform(), RigidTransform([0.03, 0.01, 0.0]))
    assert np.allclose(frames["pour_line"].translation(), [0.03 + POUR_LINE[0], 0.01 + POUR_LINE[1], 0.0])
    assert np.allclose(frames["behind_mug"].translation()[:2], [0.0, template.parameters["behind_m"]])


@pytest.mark.parametrize(("options", "ending"), [({}, "success"), ({"pour_distance": 0.1}, "spill")])
def test_scripted_policy_pours_or_spills(options, ending):
    env = make_env("Pouring", guidance="sct", reward="shaped", difficulty="thesis", **options)
    observation, _ = env.reset(seed=5)
    is_over = False
    while not is_over:
        observation, _, terminated, truncated, info = env.step(scripted_pour(observation).astype(np.float32))
        is_over = terminated or truncated
    assert info["termination"] == ending


def test_thesis_difficulty_slows_the_inputs():
    assert THESIS["input_speed"] < 0.5
    assert THESIS["time_limit"] > 15.0
