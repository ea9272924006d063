import numpy as np
import pytest

from guiderail.models.common.errors import InputError
from guiderail.models.primitives import Kmp, Matern52, SquaredExponential


def data(n=300, outputs=6, seed=0):
    """Return times (n,), means (n, O) and correlated covariances (n, O, O)."""
    rng = np.random.default_rng(seed)
    t = np.linspace(0, 8, n)
    means = np.column_stack([np.sin(t + o) for o in range(outputs)])
    mix = rng.standard_normal((outputs, outputs)) * 0.2 + np.eye(outputs)
    width = 0.05 + 0.04 * np.sin(t)[:, None] * np.ones(outputs)
    return t, means, np.einsum("ni,ij,kj,nk->nik", width, mix, mix, width)


def textbook(kernel, t, means, covariances, queries, lambda_):
    """Compute equations 2.17 and 2.18 directly."""
    outputs = means.shape[1]
    eye = np.eye(outputs)
    A = np.kron(kernel(t, t), eye)
    for i, block in enumerate(covariances):
        A[i * outputs : (i + 1) * outputs, i * outputs : (i + 1) * outputs] += lambda_ * block
    k = np.kron(kernel(queries, t), eye)
    reduced = np.kron(kernel(queries, queries), eye) - k @ np.linalg.solve(A, k.T)
    blocks = np.einsum("noni->noi", reduced.reshape(len(queries), outputs, len(queries), outputs))
    return (k @ np.linalg.solve(A, means.ravel())).reshape(len(queries), outputs), len(t) / lambda_ * blocks


@pytest.mark.parametrize("kernel", [SquaredExponential(0.5), Matern52(0.7)])
@pytest.mark.parametrize("lambda_", [1.5, 20.0])
def test_mean_and_covariance_match_equations_2_17_and_2_18(kernel, lambda_):
    t, means, covariances = data(80, 3)
    queries = np.linspace(-0.3, 8.3, 17)
    mean, covariance = textbook(kernel, t, means, covariances, queries, lambda_)
    primitive = Kmp(t, means, covariances, kernel, lambda_)
    np.testing.assert_allclose(primitive.mean(queries), mean, atol=1e-8)
    np.testing.assert_allclose(primitive.covariance(queries), covariance, rtol=1e-6, atol=1e-7)


def test_motion_passes_through_via_points_and_the_original_does_not_change():
    t, means, covariances = data(60, 2)
    kernel, queries, tight = SquaredExponential(0.5), np.linspace(-0.5, 9.5, 23), 1e-6 * np.eye(2)
    original = Kmp(t, means, covariances, kernel)
    before = original.mean(queries)
    passing = original.through([3.3], [1.0, 0.5], tight).through([9.0], [0.0, 0.0], tight)
    points = np.append(t, [3.3, 9.0]), np.vstack([means, [1.0, 0.5], [0.0, 0.0]]), [*covariances, tight, tight]
    mean, covariance = textbook(kernel, *points, queries, 1.0)
    np.testing.assert_allclose(passing.mean(queries), mean, atol=5e-6)
    np.testing.assert_allclose(passing.covariance(queries), covariance, atol=1e-6)
    np.testing.assert_allclose(passing.mean([3.3]), [[1.0, 0.5]], atol=5e-3)
    np.testing.assert_array_equal(original.mean(queries), before)


def test_kmp_accepts_a_state_as_input():
    """The input of a primitive may be a state of two numbers instead of a time."""
    rng = np.random.default_rng(0)
    x = rng.uniform(-1, 1, (120, 2))
    y = np.column_stack([x[:, 0] * x[:, 1], x.sum(axis=1), np.cos(x[:, 0])])
    primitive = Kmp(x, y, np.tile(1e-4 * np.eye(3), (120, 1, 1)))
    inside = rng.uniform(-0.7, 0.7, (20, 2))
    expected = np.column_stack([inside[:, 0] * inside[:, 1], inside.sum(axis=1), np.cos(inside[:, 0])])
    np.testing.assert_allclose(primitive.mean(inside), expected, atol=0.02)
    assert primitive.through([0.5, 0.5], np.zeros(3), 1e-8 * np.eye(3)).mean([[0.5, 0.5]]) == pytest.approx(
        0.0, abs=0.01
    )


@pytest.mark.parametrize(
    ("via_point", "message"),
    [
        ((np.nan, [0.0, 0.0], np.eye(2)), "inputs must be finite"),
        ((0.0, [0.0, np.inf], np.eye(2)), "means and covariances must be finite"),
        ((0.0, [0.0, 0.0], np.zeros((2, 2))), "positive definite"),
        ((0.0, [0.0, 0.0], np.array([[1.0, 0.5], [0.0, 1.0]])), "point 20 is not symmetric"),
    ],
)
def test_points_that_are_not_finite_or_definite_are_refused(via_point, message):
    with pytest.raises(InputError, match=message):
        Kmp(*data(20, 2)).through(*via_point)


def test_lambda_must_be_positive():
    with pytest.raises(InputError, match="lambda_ must be positive"):
        Kmp(*data(20, 2), lambda_=0.0)


def test_kmp_copies_its_arguments():
    arguments = data(60, 2)
    expected, changed = Kmp(*arguments), Kmp(*arguments)
    queries = arguments[0].copy()
    for array in arguments:
        array[:] = 1.0
    np.testing.assert_array_equal(
        changed.through([3.0], [0.4, -0.3], np.eye(2)).mean(queries),
        expected.through([3.0], [0.4, -0.3], np.eye(2)).mean(queries),
    )
    np.testing.assert_array_equal(changed.mean(queries), Kmp(*data(60, 2)).mean(queries))
