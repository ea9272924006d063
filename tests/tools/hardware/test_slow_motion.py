from itertools import pairwise

import numpy as np
import pytest

from guiderail.tools.hardware.preflight import (
    ANGULAR_SPEED,
    MIN_ANGULAR_SPEED,
    MIN_SPEED,
    SPEED,
    pose_distance,
    retrace,
)

PERIOD = 0.02


def test_retrace_skips_segments_at_rest():
    rng = np.random.default_rng(0)
    steps = rng.normal(0.0, 0.3, (100, 6)) * [*[MIN_SPEED * PERIOD] * 3, *[MIN_ANGULAR_SPEED * PERIOD] * 3]
    steps[20:30, 0], steps[40:60], steps[70:80, 3] = 5.0 * MIN_SPEED * PERIOD, 0.0, 5.0 * MIN_ANGULAR_SPEED * PERIOD
    path = np.cumsum(steps, axis=0)
    poses = retrace(path, PERIOD)
    index = [int(np.flatnonzero((path == pose).all(axis=1))[0]) for pose in poses]
    assert index[0] == 99
    assert index[-1] == 0
    assert (np.diff(index) <= 0).all()
    assert not set(index) & set(range(41, 60))
    assert {*range(20, 29), *range(70, 79)} <= set(index)  # fast segments keep their speed
    # The distance of two commands is at most the minimum speed's plus one step of the path.
    for one, other in pairwise(poses):
        distance, angle = pose_distance(one, other)
        assert distance <= MIN_SPEED * PERIOD + np.abs(steps[:, :3]).max() * np.sqrt(3)
        assert angle <= MIN_ANGULAR_SPEED * PERIOD + np.abs(steps[:, 3:]).max()
    assert len(poses) < 0.7 * len(path)


@pytest.mark.parametrize("speed", [0.02, 0.045, 0.08, 0.2, 0.45, 1.0])
def test_retrace_turns_at_recorded_or_approach_speed(speed):
    path = np.zeros((400, 6))
    path[:, 3] = speed * PERIOD * np.arange(len(path))
    fastest = max(pose_distance(*pair)[1] for pair in pairwise(retrace(path, PERIOD))) / PERIOD
    assert fastest <= max(speed, ANGULAR_SPEED) + 1e-9


@pytest.mark.parametrize("speed", [0.004, 0.009, 0.03, 0.2])
def test_retrace_moves_at_recorded_or_approach_speed(speed):
    path = np.zeros((400, 6))
    path[:, 0] = speed * PERIOD * np.arange(len(path))
    fastest = max(pose_distance(*pair)[0] for pair in pairwise(retrace(path, PERIOD))) / PERIOD
    assert fastest <= max(speed, SPEED) + 1e-9


def test_retrace_returns_nothing_for_an_empty_path():
    assert retrace(np.empty((0, 6)), PERIOD) == []
    assert len(retrace(np.zeros((50, 6)), PERIOD)) == 2
