"""Interquartile mean, probability of improvement and stratified bootstrap."""

import numpy as np
import pytest

from research.results.statistics import bootstrap_interval, interquartile_mean, probability_of_improvement


def test_interquartile_mean_ignores_the_outer_quarters():
    scores = [np.array([0.0, 0.5, 0.7, 100.0])]
    assert interquartile_mean(scores) == pytest.approx(0.6)
    assert interquartile_mean([scores[0][:2], scores[0][2:]]) == pytest.approx(0.6)  # tasks are pooled


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


def test_interval_contains_the_truth_as_often_as_it_claims():
    rng, hits, count = np.random.default_rng(0), 0, 40
    for seed in range(count):
        scores = [rng.uniform(0, 1, 12), rng.uniform(0, 1, 12)]
        low, high = bootstrap_interval(interquartile_mean, scores, seed=seed)
        hits += low <= 0.5 <= high
    assert 0.8 * count <= hits <= count


def test_tasks_are_resampled_by_themselves():
    """Both tasks are constant, so that a resampling within each of them changes nothing."""
    low, high = bootstrap_interval(interquartile_mean, [np.zeros(4), np.ones(4)])
    assert low == high == 0.5


def test_equal_scores_have_equal_intervals():
    scores = [np.array([0.2, 0.9, 1.0])]
    assert bootstrap_interval(interquartile_mean, scores) == bootstrap_interval(interquartile_mean, scores)
