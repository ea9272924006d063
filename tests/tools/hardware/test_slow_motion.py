from itertools import pairwise

import numpy as np

from guiderail.tools.hardware.slow_motion import BACK, BACK_TURN, back, distance

PERIOD = 0.02


def test_the_way_back_is_the_way_without_standing_on_it():
    rng = np.random.default_rng(0)
    steps = rng.normal(0.0, 0.3, (100, 6)) * [*[BACK * PERIOD] * 3, *[BACK_TURN * PERIOD] * 3]
    steps[20:30, 0], steps[40:60], steps[70:80, 3] = 5.0 * BACK * PERIOD, 0.0, 5.0 * BACK_TURN * PERIOD
    way = np.cumsum(steps, axis=0)
    poses = back(way, PERIOD)
    index = [int(np.flatnonzero((way == pose).all(axis=1))[0]) for pose in poses]
    assert index[0] == 99
    assert index[-1] == 0
    assert (np.diff(index) <= 0).all()
    assert not set(index) & set(range(41, 60))
    assert {*range(20, 29), *range(70, 79)} <= set(index)  # what was gone fast is gone back as fast
    # Nobody has to leap: between two of them lie at most a step's length and what was one step of the way.
    for one, other in pairwise(poses):
        away, turned = distance(one, other)
        assert away <= BACK * PERIOD + np.abs(steps[:, :3]).max() * np.sqrt(3)
        assert turned <= BACK_TURN * PERIOD + np.abs(steps[:, 3:]).max()
    assert len(poses) < 0.7 * len(way)


def test_no_way_is_no_way_back():
    assert back(np.empty((0, 6)), PERIOD) == []
    assert len(back(np.zeros((50, 6)), PERIOD)) == 2
