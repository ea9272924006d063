"""Limits of a motion: their refusals, scaling, and the bounds of the rotation vector's derivatives."""

import numpy as np
import pytest

from guiderail.models.common.errors import InputError
from guiderail_hardware.models.motion_limits import MotionLimits
from oracles.franka import FRANKA_LIMITS


def left_jacobian(r):
    """Return the left Jacobian of SO(3), (3, 3), at a rotation vector (3,)."""
    x, y, z = r
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    angle = np.linalg.norm(r)
    return np.eye(3) + (1 - np.cos(angle)) / angle**2 * cross + (angle - np.sin(angle)) / angle**3 * cross @ cross


def test_derivatives_of_the_left_jacobian_are_bounded():
    rng, step = np.random.default_rng(0), 1e-4
    for _ in range(2000):
        r, d = rng.normal(size=(2, 3))
        r *= rng.uniform(0.01, np.pi) / np.linalg.norm(r)
        d *= step / np.linalg.norm(d)
        before, here, after = (left_jacobian(r + k * d) for k in (-1, 0, 1))
        assert np.linalg.norm(here, 2) <= 1.0 + 1e-9
        assert np.linalg.norm((after - before) / (2 * step), 2) <= 1 / 2 + 1e-6
        assert np.linalg.norm((after - 2 * here + before) / step**2, 2) <= 1 / 3 + 1e-5


def test_scaled_limits_are_a_share_of_each_limit():
    scaled = FRANKA_LIMITS.scaled(0.1)
    np.testing.assert_allclose(scaled.linear, [0.17, 1.3, 650.0])
    np.testing.assert_allclose(scaled.angular, [0.25, 2.5, 1250.0])
    assert FRANKA_LIMITS.scaled(1.0) == FRANKA_LIMITS


@pytest.mark.parametrize("factor", [0.0, -0.1, 1.001, np.nan])
def test_scaled_refuses_a_factor_out_of_range(factor):
    with pytest.raises(InputError, match="above 0 and at most 1"):
        FRANKA_LIMITS.scaled(factor)


@pytest.mark.parametrize("bad", [0.0, -1.0, np.inf, np.nan])
def test_limits_are_positive_and_finite(bad):
    with pytest.raises(InputError, match="positive and finite"):
        MotionLimits((1.0, bad, 1.0), (1.0, 1.0, 1.0))


def test_limits_refuse_a_too_small_angular_acceleration():
    with pytest.raises(InputError, match="more acceleration"):
        MotionLimits((1.0, 1.0, 1.0), (2.0, 2.0, 100.0))
    assert MotionLimits((1.0, 1.0, 1.0), (2.0, 2.1, 100.0)).rotation_vector_limits()[1] == pytest.approx(0.1)
