"""Bounds contain the demonstrations, with a small margin."""

import numpy as np
import pytest

from guiderail.models.common.errors import InputError
from guiderail.models.primitives import Demonstrations
from guiderail.models.primitives.demonstrations import compute_bounds


def make_demonstrations():
    t = np.linspace(0.0, 2.0, 101)
    return Demonstrations(t, [np.column_stack([a * t, np.sin(3 * t) + a]) for a in (0.9, 1.0, 1.1)])


@pytest.mark.parametrize("phases", [1, 3, 7])
def test_bounds_contain_every_demonstration(phases):
    bounds = compute_bounds(make_demonstrations(), phases, margin=0.0)
    for outputs in make_demonstrations().outputs:
        assert bounds.contains(outputs).all()


def test_bounds_contain_demonstrations_with_uneven_samples():
    t = np.array([0.0, 0.1, 0.13, 0.16, 1.0, 1.2, 1.7, 2.0])
    peak = np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0, -2.0, 0.0])
    bounds = compute_bounds(Demonstrations(t, [peak[:, None], np.zeros((8, 1))]), 2, margin=0.0)
    np.testing.assert_array_equal(bounds.upper[:, 0], [1.0, 0.0])
    assert bounds.lower[1, 0] == -2.0


def test_bounds_are_tighter_with_more_phases():
    room = [np.mean(b.upper - b.lower) for b in (compute_bounds(make_demonstrations(), k) for k in (1, 2, 4, 8))]
    assert sorted(room, reverse=True) == room
    assert room[-1] < 0.4 * room[0]


def test_margin_is_relative_to_the_range_with_a_minimum():
    tight = compute_bounds(make_demonstrations(), margin=0.0)
    wide = compute_bounds(make_demonstrations(), margin=0.25)
    size = tight.upper - tight.lower
    np.testing.assert_allclose(wide.upper - tight.upper, 0.25 * size)
    np.testing.assert_allclose(tight.lower - wide.lower, 0.25 * size)
    np.testing.assert_allclose(
        compute_bounds(make_demonstrations(), margin=0.0, min_margin=5.0).upper - tight.upper, 5.0
    )


def test_unbounded_output_has_infinite_bounds():
    bounds = compute_bounds(make_demonstrations(), 2, bounded=[1])
    assert np.isinf(bounds.lower[:, 0]).all()
    assert np.isfinite(bounds.upper[:, 1]).all()


def test_max_rates_use_the_clock_of_each_demonstration():
    np.testing.assert_allclose(compute_bounds(make_demonstrations()).max_rates[0], 1.1, rtol=1e-9)


@pytest.mark.parametrize("arguments", [{"phases": 0}, {"phases": 99}, {"margin": -1.0}, {"bounded": [2]}])
def test_compute_bounds_refuses_invalid_arguments(arguments):
    with pytest.raises(InputError):
        compute_bounds(make_demonstrations(), **arguments)
