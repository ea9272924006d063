"""Commands that return along a recorded path."""

from itertools import pairwise

import numpy as np
import pytest

from guiderail_hardware.robot.preflight import (
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
    indices = [int(np.flatnonzero((path == pose).all(axis=1))[0]) for pose in poses]
    assert indices[0] == 99
    assert indices[-1] == 0
    assert (np.diff(indices) <= 0).all()
    assert not set(indices) & set(range(41, 60))
    assert {*range(20, 29), *range(70, 79)} <= set(indices)  # fast segments keep their speed
    # Successive commands differ by at most a step at the minimum speed plus a step of the path.
    for pair in pairwise(poses):
        distance, angle = pose_distance(*pair)
        assert distance <= MIN_SPEED * PERIOD + np.abs(steps[:, :3]).max() * np.sqrt(3)
        assert angle <= MIN_ANGULAR_SPEED * PERIOD + np.abs(steps[:, 3:]).max()
    assert len(poses) < 0.7 * len(path)


@pytest.mark.parametrize(
    ("axis", "slow", "speed"),
    [
        *((0, SPEED, speed) for speed in (0.004, 0.009, 0.03, 0.2)),  # [m/s]
        *((3, ANGULAR_SPEED, speed) for speed in (0.02, 0.045, 0.08, 0.2, 0.45, 1.0)),  # [rad/s]
    ],
)
def test_retrace_moves_at_recorded_or_approach_speed(axis, slow, speed):
    path = np.zeros((400, 6))
    path[:, axis] = speed * PERIOD * np.arange(len(path))
    fastest = max(pose_distance(*pair)[axis == 3] for pair in pairwise(retrace(path, PERIOD))) / PERIOD
    assert fastest <= max(speed, slow) + 1e-9


def test_retrace_returns_both_ends_of_a_path_at_rest():
    assert retrace(np.empty((0, 6)), PERIOD) == []
    assert len(retrace(np.zeros((50, 6)), PERIOD)) == 2
