"""Explicit features of kernels, compared with kernel matrices in higher precision."""

import mpmath
import numpy as np
import pytest

from guiderail.models.primitives import Matern52, SquaredExponential
from guiderail.models.primitives.window import window_features

KERNELS = [SquaredExponential(0.5), SquaredExponential(0.1), Matern52(0.4)]


def conditional_kernel(kernel, past, future, noise):
    """Compute K_fp (K_pp + ρI)⁻¹ and K_ff − K_fp (K_pp + ρI)⁻¹ K_pf with fifty decimal digits."""
    K = kernel(*(np.r_[past, future].astype(np.longdouble),) * 2)
    P = len(past)
    with mpmath.workdps(50):
        exact = mpmath.matrix([[mpmath.mpf(np.format_float_scientific(x, 20)) for x in row] for row in K])
        Kpp = exact[:P, :P] + mpmath.mpf(noise) * mpmath.eye(P)
        W = exact[P:, :P] * Kpp**-1
        residual_kernel = exact[P:, P:] - W * exact[:P, P:]
        return np.array(W.tolist(), dtype=float), np.array(residual_kernel.tolist(), dtype=float)


@pytest.mark.parametrize("kernel", KERNELS, ids=repr)
@pytest.mark.parametrize("noise", [12e-4, 12e-10])
def test_features_equal_the_kernel_given_the_history(kernel, noise):
    past, future = 0.02 * np.arange(-6, 0), 0.02 * np.arange(9)
    features = window_features(kernel, past, future, noise)
    W, residual_kernel = conditional_kernel(kernel, past, future, noise)
    np.testing.assert_allclose(features.history_map, W, rtol=0, atol=1e-6)
    np.testing.assert_allclose(features.features @ features.features.T, residual_kernel, rtol=0, atol=1e-13)
    assert features.features.shape[1] <= 9


@pytest.mark.parametrize("kernel", KERNELS, ids=repr)
def test_features_equal_the_kernel_without_a_history(kernel):
    future = np.linspace(0, 3, 40)
    features = window_features(kernel, future[:0], future, 0.0)
    assert features.history_map.shape == (40, 0)
    np.testing.assert_allclose(features.features @ features.features.T, kernel(future, future), rtol=0, atol=1e-14)


def test_number_of_features_is_the_rank_of_the_kernel():
    smooth = window_features(SquaredExponential(np.sqrt(5)), np.zeros(0), np.linspace(0, 1, 60), 0.0)
    rough = window_features(SquaredExponential(np.sqrt(5e-6)), np.zeros(0), np.linspace(0, 1, 60), 0.0)
    assert smooth.features.shape[1] <= 12
    assert rough.features.shape[1] == 60
