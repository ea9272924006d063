"""Interquartile mean, probability of improvement and stratified bootstrap."""

import numpy as np
import pytest

from guiderail_studies.statistics import bootstrap_interval, interquartile_mean, probability_of_improvement


def test_interquartile_mean_ignores_the_outer_quarters():
    scores = [np.array([0.0, 0.5, 0.7, 100.0])]
    assert interquartile_mean(scores) == pytest.approx(0.6)
    assert interquartile_mean([scores[0][:2], scores[0][2:]]) == pytest.approx(
        0.6
    )  # the scores of all tasks are pooled


@pytest.mark.parametrize(
    ("first", "second", "probability"),
    [
        ([1.0, 2.0], [0.0, 0.5], 1.0),
        ([1.0, 1.0], [1.0, 1.0], 0.5),
        ([0.0, 2.0], [1.0, 1.0], 0.5),
        ([1.0], [1.0, 0.0], 0.75),
    ],
)
def test_probability_of_improvement_counts_pairs(first, second, probability):
    assert probability_of_improvement([np.array(first)], [np.array(second)]) == probability
    assert probability_of_improvement([np.array(second)], [np.array(first)]) == 1.0 - probability


def test_bootstrap_interval_covers_the_true_mean():
    rng, hits, repetitions = np.random.default_rng(0), 0, 40
    for seed in range(repetitions):
        scores = [rng.uniform(0, 1, 12), rng.uniform(0, 1, 12)]
        low, high = bootstrap_interval(interquartile_mean, scores, seed=seed)
        hits += low <= 0.5 <= high
    assert hits >= 0.8 * repetitions  # the nominal coverage is 95 %


def test_bootstrap_resamples_within_each_task():
    """The scores of each task are equal, so resampling within a task does not change them."""
    low, high = bootstrap_interval(interquartile_mean, [np.zeros(4), np.ones(4)])
    assert low == high == 0.5


def test_bootstrap_interval_is_reproducible():
    scores = [np.array([0.2, 0.9, 1.0])]
    assert bootstrap_interval(interquartile_mean, scores) == bootstrap_interval(interquartile_mean, scores)
