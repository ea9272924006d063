"""Connector whose policy observes directions of force and torque."""

from importlib import import_module

import numpy as np
import pytest

from guiderail.diagrams.tasks.bnc_connector import BncConnector
from guiderail.tools.environments import make_environment

NAME = "ConnectorDirections"


@pytest.fixture(scope="module")
def study(own_tasks):
    """Return the study's module."""
    return import_module("research.directions")


def test_directions_have_length_one_above_the_thresholds(study):
    found = study.directions(np.array([3.0, 0.0, 4.0, 0.0, 1e-3, 0.0]))
    np.testing.assert_allclose(found, [0.6, 0.0, 0.8, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(study.directions(np.array([0.1, 0.0, 0.0, 0.0, 0.0, -2.0])), [0, 0, 0, 0, 0, -1])


def test_only_the_wrench_of_the_observation_differs(study):
    ours, theirs = (task().observe().terms for task in (study.ConnectorDirections, BncConnector))
    differing = [(a.signal, b.signal) for a, b in zip(ours, theirs, strict=True) if a.signal != b.signal]
    assert differing == [("wrench_directions", "wrench")]
    with make_environment(NAME, {"difficulty": "hard", "guidance": "kgrl"}) as env:
        observation, _ = env.reset(seed=0)
        assert env.observation_space.contains(observation)
