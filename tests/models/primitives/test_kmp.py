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


def textbook(kernel, t, means, covariances, queries, lambda_, covariance_lambda):
    """Compute equations 2.17 and 2.18 directly."""
    outputs = means.shape[1]
    eye = np.eye(outputs)
    K = np.kron(kernel(t, t), eye)
    sigma = np.zeros_like(K)
    for i, block in enumerate(covariances):
        sigma[i * outputs : (i + 1) * outputs, i * outputs : (i + 1) * outputs] = block
    k = np.kron(kernel(queries, t), eye)
    mean = (k @ np.linalg.solve(K + lambda_ * sigma, means.ravel())).reshape(len(queries), outputs)
    reduced = np.kron(kernel(queries, queries), eye) - k @ np.linalg.solve(K + covariance_lambda * sigma, k.T)
    blocks = reduced.reshape(len(queries), outputs, len(queries), outputs)
    return mean, len(t) / covariance_lambda * np.einsum("noni->noi", blocks)


@pytest.mark.parametrize("kernel", [SquaredExponential(0.5), Matern52(0.7)])
def test_mean_and_covariance_match_equations_2_17_and_2_18(kernel):
    t, means, covariances = data(80, 3)
    queries = np.linspace(-0.3, 8.3, 17)
    mean, covariance = textbook(kernel, t, means, covariances, queries, 1.5, 20.0)
    primitive = Kmp(t, means, covariances, kernel, lambda_=1.5, covariance_lambda=20.0)
    np.testing.assert_allclose(primitive.mean(queries), mean, atol=1e-8)
    np.testing.assert_allclose(primitive.covariance(queries), covariance, rtol=1e-6, atol=1e-7)


def test_via_points_equal_points_of_the_reference():
    """Added, moved and removed via-points give the result of a new primitive with the same points."""
    kernel = SquaredExponential(0.5)
    t, means, covariances = data(60, 2)
    queries = np.linspace(-0.5, 9.5, 23)
    tight = 1e-6 * np.eye(2)
    primitive = Kmp(t, means, covariances, kernel)

    def expected(points):
        inputs = np.append(t, [p[0] for p in points])
        all_means = np.vstack([means, *[p[1] for p in points]])
        return textbook(
            kernel, inputs, all_means, np.concatenate([covariances, *[[tight]] * len(points)]), queries, 1, 1
        )

    a = primitive.add_via_point(3.3, [1.0, 0.5], tight)
    b = primitive.add_via_point(9.0, [0.0, 0.0], tight)
    mean, covariance = expected([(3.3, [1.0, 0.5]), (9.0, [0.0, 0.0])])
    np.testing.assert_allclose(primitive.mean(queries), mean, atol=5e-6)
    np.testing.assert_allclose(primitive.covariance(queries), covariance, atol=1e-6)
    np.testing.assert_allclose(primitive.mean([3.3]), [[1.0, 0.5]], atol=5e-3)

    primitive.move_via_point(a, 5.0, [0.2, 0.1], tight)
    np.testing.assert_allclose(primitive.mean(queries), expected([(5.0, [0.2, 0.1]), (9.0, [0.0, 0.0])])[0], atol=5e-6)
    primitive.remove_via_point(b)
    primitive.remove_via_point(a)
    np.testing.assert_allclose(primitive.mean(queries), expected([])[0], atol=1e-7)


def test_kmp_accepts_a_state_as_input():
    """The input of a primitive may be a state of two numbers instead of a time."""
    rng = np.random.default_rng(0)
    x = rng.uniform(-1, 1, (120, 2))
    y = np.column_stack([x[:, 0] * x[:, 1], x.sum(axis=1), np.cos(x[:, 0])])
    primitive = Kmp(x, y, np.tile(1e-4 * np.eye(3), (120, 1, 1)))
    inside = rng.uniform(-0.7, 0.7, (20, 2))
    expected = np.column_stack([inside[:, 0] * inside[:, 1], inside.sum(axis=1), np.cos(inside[:, 0])])
    np.testing.assert_allclose(primitive.mean(inside), expected, atol=0.02)


@pytest.mark.parametrize(
    ("via_point", "message"),
    [
        ((np.nan, [0.0, 0.0], np.eye(2)), "finite"),
        ((0.0, [0.0, np.inf], np.eye(2)), "finite"),
        ((0.0, [0.0, 0.0], np.zeros((2, 2))), "positive definite"),
        ((0.0, [0.0, 0.0], np.array([[1.0, 0.5], [0.0, 1.0]])), "not symmetric"),
    ],
)
def test_add_via_point_refuses_invalid_points(via_point, message):
    primitive = Kmp(*data(20, 2))
    before = primitive.mean([1.0])
    with pytest.raises(InputError, match=message):
        primitive.add_via_point(*via_point)
    np.testing.assert_array_equal(primitive.mean([1.0]), before)


def test_kmp_refuses_unknown_via_points_and_invalid_arguments():
    primitive = Kmp(*data(20, 2))
    with pytest.raises(InputError, match="no via-point 7"):
        primitive.remove_via_point(7)
    with pytest.raises(InputError, match="lambda_"):
        Kmp(*data(20, 2), lambda_=0.0)
    t, means, covariances = data(20, 2)
    for arguments in (np.where(t == t[3], np.nan, t), means), (t, np.where(means == means[3], np.nan, means)):
        with pytest.raises(InputError, match="finite"):
            Kmp(*arguments, covariances)


def test_via_point_input_must_be_finite():
    x = np.random.default_rng(0).uniform(-1, 1, (20, 2))
    primitive = Kmp(x, x, np.tile(np.eye(2), (20, 1, 1)))
    for via_input in ([np.nan, 0.0], [0.0, np.inf]):
        with pytest.raises(InputError, match="finite"):
            primitive.add_via_point(via_input, [0.0, 0.0], np.eye(2))


def test_kmp_accepts_lists():
    t, means, covariances = data(20, 2)
    expected = Kmp(t, means, covariances).mean([1.0])
    np.testing.assert_array_equal(Kmp(t.tolist(), means.tolist(), covariances.tolist()).mean([1.0]), expected)


def test_kmp_copies_its_arguments():
    t, means, covariances = data(60, 2)
    expected = Kmp(t, means, covariances)
    target, covariance = np.array([0.4, -0.3]), 1e-4 * np.eye(2)
    arguments = t.copy(), means.copy(), covariances.copy()
    changed = Kmp(*arguments)
    for array in arguments:
        array[:] = 1.0
    expected.add_via_point([3.0], target.copy(), covariance.copy())
    changed.add_via_point([3.0], target, covariance)
    target[:], covariance[:] = 5.0, np.eye(2)
    for primitive in (expected, changed):
        primitive.add_via_point([20.0], [0.1, 0.2], 1e-4 * np.eye(2))  # far away: factored again
    np.testing.assert_array_equal(changed.mean(t), expected.mean(t))
