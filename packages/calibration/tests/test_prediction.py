import numpy as np
import pytest

from guiderail_calibration.prediction import predict, rate_distribution
from guiderail_calibration.simulations import Simulated


def draws(successes):
    return [Simulated(np.zeros(1), [], np.array(row, dtype=bool), np.linspace(5.0, 6.0, len(row))) for row in successes]


def test_interval_of_equal_draws_is_narrow_and_of_different_draws_wide():
    equal = predict(draws([[1, 0, 1, 0]] * 20))
    different = predict(draws([[1, 1, 1, 1], [0, 0, 0, 0]] * 10))
    for prediction in (equal, different):
        assert prediction.success == pytest.approx(0.5, abs=0.05)
        assert 5.0 <= prediction.peak_force_low <= prediction.peak_force <= prediction.peak_force_high <= 6.0
        assert prediction.episodes == 80
    assert equal.high - equal.low < 0.6 < different.high - different.low


def test_intervals_cover_rates_of_a_beta_distribution(monkeypatch):
    monkeypatch.setattr("guiderail_calibration.prediction._GRID", 49)  # an eighth of the time of 99
    rng = np.random.default_rng(0)
    inside = []
    for _ in range(20):
        mean, concentration = rng.uniform(0.2, 0.9), 10.0 ** rng.uniform(0.0, 1.5)
        rates = rng.beta(mean * concentration, (1.0 - mean) * concentration, size=31)
        values, probability = rate_distribution(rng.binomial(2, rates[:30]), np.full(30, 2))
        cumulative = np.cumsum(probability)
        low, high = (values[np.searchsorted(cumulative, p)] for p in (0.05, 0.95))
        inside.append(low - 0.01 <= rates[30] <= high + 0.01)
    assert np.mean(inside) >= 0.8


def test_certain_success_is_predicted_near_one():
    prediction = predict(draws([[1, 1]] * 40))
    assert prediction.success > 0.97
    assert prediction.high > 0.99
