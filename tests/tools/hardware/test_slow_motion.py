from itertools import pairwise

import numpy as np

from guiderail.tools.hardware.preflight import MIN_ANGULAR_SPEED, MIN_SPEED, pose_distance, retrace

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


def test_retrace_returns_nothing_for_an_empty_path():
    assert retrace(np.empty((0, 6)), PERIOD) == []
    assert len(retrace(np.zeros((50, 6)), PERIOD)) == 2
