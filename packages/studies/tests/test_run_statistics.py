import itertools

import numpy as np
import pytest

from guiderail_studies.run_statistics import bootstrap_band, interquartile_mean, median_survival, survival


def test_bootstrap_band_contains_the_mean_and_narrows():
    rng = np.random.default_rng(0)
    few, many = rng.normal(size=(3, 5)), rng.normal(size=(60, 5))
    for values in (few, many):
        low, high = bootstrap_band(values)
        assert (low <= values.mean(axis=0)).all()
        assert (high >= values.mean(axis=0)).all()
    widths = [np.mean(np.subtract(*bootstrap_band(values)[::-1])) for values in (few, many)]
    assert widths[1] < 0.5 * widths[0]
    np.testing.assert_array_equal(bootstrap_band(few), bootstrap_band(few))


def test_bootstrap_band_of_equal_runs_has_no_width():
    low, high = bootstrap_band(np.ones((4, 3)))
    np.testing.assert_array_equal(low, np.ones(3))
    np.testing.assert_array_equal(high, np.ones(3))


def test_interquartile_mean_omits_a_quarter_at_each_end():
    mean, interval = interquartile_mean([-100.0, 1.0, 3.0, 100.0])
    assert mean == 2.0
    assert interval is not None
    assert interval[0] <= mean <= interval[1]
    assert interquartile_mean([5.0]) == (5.0, None)


@pytest.mark.parametrize("scale", [1.0, -1.0])
def test_interval_of_few_seeds_is_computed_from_all_resamples(scale):
    values = scale * np.array([-16.67216437, -15.0276135, -2.031366, 36.33370554, 52.79995048])
    means = [np.sort(resample)[1:4].mean() for resample in itertools.product(values, repeat=5)]
    np.testing.assert_allclose(interquartile_mean(values)[1], np.percentile(means, [2.5, 97.5]))


def test_survival_censors_runs_that_never_converged():
    """By hand: 1 of 4 runs converges at 10, 1 is censored at 30 − 10 = 20, and 1 of the remaining 2 converges at 30."""
    steps, fractions = survival([10, 30, None, None], [60, 60, 30, 60])
    np.testing.assert_allclose(steps[steps <= 30], [0, 10, 20, 30])
    np.testing.assert_allclose(fractions[steps <= 30], [1, 0.75, 0.75, 0.375])
    assert median_survival(steps, fractions) == 30
    assert median_survival(*survival([None, None], [20, 20])) is None


@pytest.mark.parametrize("converged", [12, 13])
def test_median_survival_includes_a_half_despite_rounding(converged):
    runs = [*range(1, converged + 1), *[None] * (24 - converged)]
    assert median_survival(*survival(runs, [100] * 24)) == 12
