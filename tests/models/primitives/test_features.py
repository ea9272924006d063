"""Explicit features of kernels, compared with kernel matrices in higher precision."""

import mpmath
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from guiderail.models.primitives import Matern52, SquaredExponential
from guiderail.models.primitives.features import KernelBasis, window_features

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


@given(st.integers(0, 2**32 - 1), st.integers(1, 3))
def test_basis_represents_its_inputs_and_returns_the_residual(seed, dimensions):
    rng = np.random.default_rng(seed)
    kernel = SquaredExponential(np.sqrt(0.5 / rng.uniform(0.1, 5)))
    inputs, other_inputs = rng.uniform(-1, 1, (15, dimensions)), rng.uniform(-3, 3, (7, dimensions))
    basis = KernelBasis(kernel, inputs)
    F = basis.features(inputs)
    assert F.shape == (15, basis.size)
    np.testing.assert_allclose(F @ F.T, kernel(inputs, inputs), rtol=0, atol=1e-13)
    assert np.abs(basis.residual(inputs, F)).max() < 1e-13

    # At other inputs, the features explain the kernel with the basis inputs; the residual is the rest of the diagonal.
    G = basis.features(other_inputs)
    np.testing.assert_allclose(G @ F.T, kernel(other_inputs, inputs), rtol=0, atol=1e-6)
    residual = basis.residual(other_inputs, G)
    np.testing.assert_allclose(residual, 1 - (G**2).sum(axis=1), rtol=0, atol=1e-14)
    assert (residual >= -1e-13).all()

    before = basis.size
    assert not basis.extend(inputs[:5])
    assert basis.size == before
    is_extended = basis.extend(other_inputs)
    assert is_extended == (basis.size > before)
    everything = np.vstack([inputs, other_inputs])
    H = basis.features(everything)
    np.testing.assert_allclose(H @ H.T, kernel(everything, everything), rtol=0, atol=1e-13)
    # The first features are unchanged by the extension.
    np.testing.assert_allclose(H[:15, :before], F, rtol=0, atol=1e-9)


def test_basis_adds_a_feature_for_each_distinct_point():
    kernel = SquaredExponential(np.sqrt(0.5))
    assert KernelBasis(kernel, np.array([[0.0], [100.0], [200.0]])).size == 3
    assert KernelBasis(kernel, np.array([[1.0], [1.0], [1.0]])).size == 1
    empty = KernelBasis(kernel, np.zeros((0, 1)))
    assert empty.size == 0
    assert empty.features(np.ones((2, 1))).shape == (2, 0)
    assert not empty.extend(np.zeros((0, 1)))
    assert empty.extend(np.ones((1, 1)))
