"""Connector whose policy observes directions of force and torque."""

import numpy as np

from guiderail.diagrams.tasks.bnc_connector import BncConnector
from guiderail.tools.environments import make_environment
from research.directions import ConnectorDirections, directions


def test_directions_have_length_one_above_the_thresholds():
    found = directions(np.array([3.0, 0.0, 4.0, 0.0, 1e-3, 0.0]))
    np.testing.assert_allclose(found, [0.6, 0.0, 0.8, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(directions(np.array([0.1, 0.0, 0.0, 0.0, 0.0, -2.0])), [0, 0, 0, 0, 0, -1])


def test_only_the_wrench_of_the_observation_differs():
    ours, theirs = (task().observe().terms for task in (ConnectorDirections, BncConnector))
    differing = [(a.signal, b.signal) for a, b in zip(ours, theirs, strict=True) if a.signal != b.signal]
    assert differing == [("wrench_directions", "wrench")]
    with make_environment("ConnectorDirections", {"difficulty": "hard", "guidance": "kgrl"}) as env:
        observation, _ = env.reset(seed=0)
        assert env.observation_space.contains(observation)
