"""Segments of a motion: events, cuts, discrete outputs, frames and alignment in time."""

import numpy as np
import pytest

from guiderail import Demonstrations, Segment, cut_demonstrations, find_events
from guiderail.models.common.errors import InputError
from guiderail_data.alignment import _warping_path, align_demonstrations


def recordings():
    """Return three demonstrations of 40 samples of two outputs, 0.1 s apart."""
    t = 0.1 * np.arange(40)
    paths = [np.column_stack([np.linspace(0, 1, 40), np.full(40, float(m))]) for m in range(3)]
    return Demonstrations([t] * 3, paths, ["x [m]", "y [m]"])


def test_find_events_searches_the_conditions_in_order():
    signals = [np.array([[0], [1], [0], [1], [2]]), np.array([[1], [1], [0], [2], [1]])]
    events = find_events(signals, [lambda s: s[0] == 1, lambda s: s[0] == 2])
    assert events == [[1, 4], [0, 3]]
    with pytest.raises(InputError, match="event 1 does not occur in recording 0"):
        find_events(signals, [lambda s: s[0] == 2, lambda s: s[0] == 1])


def test_find_events_accepts_an_array_of_recordings():
    assert find_events(np.arange(10.0).reshape(2, 5, 1), [lambda s: s[0] in (3, 7)]) == [[3], [2]]


def test_cut_parts_share_a_sample_and_begin_at_time_zero():
    parts = cut_demonstrations(recordings(), [[10, 30], [12, 25], [9, 20]])
    assert [len(part.times[0]) for part in parts] == [11, 21, 10]
    assert all(t[0] == 0.0 for part in parts for t in part.times)
    np.testing.assert_array_equal(parts[0].outputs[1][-1], parts[1].outputs[1][0])
    assert parts[2].names == ("x [m]", "y [m]")


GRIPPER = [np.where(np.arange(40) < k, -1, 1) for k in (10, 20, 30)]  # closes at sample k


def test_discrete_value_is_the_most_frequent_at_each_phase():
    values = Segment(recordings(), discrete=GRIPPER).discrete_values(20)
    assert [int(v) for v in values] == [-1] * 10 + [1] * 10


def test_number_of_steps_follows_from_the_period():
    segment = Segment(recordings())
    assert segment.steps_of(0.1) == 40
    assert segment.steps_of(0.05) == 79
    assert segment.steps_of(0.9) == 12
    with pytest.raises(InputError, match=r"shorter than 4 periods of 1\.2 s"):
        segment.steps_of(1.2)
    with pytest.raises(InputError, match="give the period of the environment"):
        segment.steps_of(None)
    assert Segment(recordings(), num_steps=20).steps_of(None) == 20


def test_alignment_moves_an_event_to_the_same_phase():
    t = np.linspace(0, 1, 101)
    steps = [np.column_stack([1 / (1 + np.exp(-60 * (t - at))), t * 0]) for at in (0.4, 0.5, 0.6)]
    before = Demonstrations([t] * 3, steps)
    after = align_demonstrations(before, band=0.3)
    events = [[int(np.argmax(y[:, 0] > 0.5)) for y in motions.outputs] for motions in (before, after)]
    assert np.ptp(events[0]) >= 19  # samples
    assert np.ptp(events[1]) <= 2
    assert all(y.min() >= 0 and y.max() <= 1 for y in after.outputs)
    np.testing.assert_array_equal(after.outputs[1], steps[1])


def warping_path_by_full_matrix(target, other, width):
    """Return the first and last matching sample of `other` for each sample of `target`, by the matrix of all costs."""
    size = len(target)
    cost = np.full((size + 1, size + 1), np.inf)
    cost[0, 0] = 0.0
    for i in range(size):
        for j in range(max(0, i - width), min(size, i + width + 1)):
            distance = np.linalg.norm(other[j : j + 1] - target[i], axis=1)[0]
            cost[i + 1, j + 1] = distance + min(cost[i, j], cost[i, j + 1], cost[i + 1, j])
    matched, i, j = [[] for _ in target], size, size
    while i > 0 and j > 0:
        matched[i - 1].append(j - 1)
        i, j = min(((i - 1, j - 1), (i - 1, j), (i, j - 1)), key=lambda at: cost[at])
    return [(min(samples), max(samples)) for samples in matched]


@pytest.mark.parametrize("decimals", [0, 6])  # rounded samples have equal costs
@pytest.mark.parametrize("width", [1, 7, 60])
def test_warping_path_equals_the_path_by_the_full_matrix(width, decimals):
    rng = np.random.default_rng(width)
    target, other = (np.round(rng.normal(size=(50, 2)).cumsum(axis=0), decimals) for _ in range(2))
    assert _warping_path(target, other, width) == warping_path_by_full_matrix(target, other, width)
