import numpy as np
import pytest

from guiderail_calibration.inference import Kernels, Posterior, Regression, to_normal, to_quantiles


def test_left_out_predictions_equal_those_of_a_fit_without_the_sample():
    rng = np.random.default_rng(0)
    x = rng.standard_normal((25, 4))
    y = x[:, 0] + 0.1 * rng.standard_normal(25)
    kernels = Kernels(x)
    regression = Regression(kernels.decompositions, y)
    values, vectors = kernels.decompositions[regression._index]
    kernel = (vectors * values) @ vectors.T
    centered = y - y.mean()
    ridges = np.logspace(-3, 3, 13)
    errors = []
    for ridge in ridges:
        rest = np.arange(1, 25)
        dual = np.linalg.solve(kernel[np.ix_(rest, rest)] + ridge * np.eye(24), centered[rest])
        errors.append(abs(y.mean() + kernel[0, rest] @ dual - regression.left_out[0]))
    assert min(errors) < 1e-8


def test_quantiles_and_normal_values_are_inverse():
    quantiles = np.linspace(0.01, 0.99, 50)
    np.testing.assert_allclose(to_quantiles(to_normal(quantiles)), quantiles)


@pytest.fixture(scope="module")
def linear():
    """Return draws of three parameters, of which the summaries contain the first with noise and the second exactly."""
    rng = np.random.default_rng(1)
    quantiles = rng.uniform(size=(300, 3))
    z = to_normal(quantiles)
    noise = rng.standard_normal((300, 8))
    summaries = np.column_stack([z[:, 0] + 0.5 * noise[:, 0], z[:, 1], z[:, 1] ** 2, noise[:, 1:]])
    return quantiles, summaries


def test_posterior_covers_hidden_parameters_and_names_what_is_unknown(linear):
    quantiles, summaries = linear
    posterior = Posterior(quantiles[:200], summaries[:200])
    assert posterior.identifiable.tolist() == [True, True, False]
    assert posterior.sensitivities[0] == pytest.approx(0.8, abs=0.1)  # 1 / (1 + 0.5²)
    inside = []
    for truth, observed in zip(quantiles[200:], summaries[200:], strict=True):
        draws = posterior.sample(observed, 300)
        low, high = np.quantile(draws, (0.05, 0.95), axis=0)
        inside.append((low <= truth) & (truth <= high))
        assert draws[:, 2].std() == pytest.approx(12**-0.5, abs=0.05)  # the prior, uniform
    assert (np.mean(inside, axis=0) > 0.8).all()
    alarms = [not posterior.explains(observed)[0] for observed in summaries[200:]]
    assert np.mean(alarms) <= 0.12
    outside = summaries[200:].copy()
    outside[:, 2] = -2.0  # no parameter has a negative square
    assert np.mean([not posterior.explains(observed)[0] for observed in outside]) > 0.8
    again = posterior.sample(summaries[0], 50, seed=3)
    np.testing.assert_array_equal(again, posterior.sample(summaries[0], 50, seed=3))
