"""Statistics of methods over seeds: interquartile mean and probability of improvement (Agarwal et al., 2021).

The package `rliable` has the same definitions. Its latest version, 1.2.0, needs a version of `arch` that cannot be
imported with pandas 3, which guiderail needs. `scipy.stats.bootstrap` refuses a task with a single seed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from scipy import stats

CONFIDENCE, RESAMPLES = 0.95, 20_000
Scores = Sequence[np.ndarray]
"""Scores of the seeds of each task, (R,) each, or (…, R) for several resamples at once."""


def interquartile_mean(scores: Scores) -> np.ndarray:
    """Return the mean of the middle half of the scores of all tasks together, (…)."""
    return np.asarray(stats.trim_mean(np.concatenate(scores, axis=-1), 0.25, axis=-1))


def probability_of_improvement(first: Scores, second: Scores) -> np.ndarray:
    """Return the probability that a seed of the first method scores higher than one of the second on the same task.

    Ties count half. The probability is averaged over the tasks, (…).
    """
    pairs = zip(first, second, strict=True)
    signs = [np.sign(x[..., :, None] - y[..., None, :]).mean(axis=(-2, -1)) for x, y in pairs]
    return 0.5 + 0.5 * np.mean(signs, axis=0)


def bootstrap_interval(
    statistic: Callable[..., np.ndarray], *methods: Scores, seed: int = 0, resamples: int = RESAMPLES
) -> tuple[float, float]:
    """Return the 95 % interval of a statistic by percentiles of a stratified bootstrap.

    Seeds are resampled within each task and method.

    Args:
        statistic: Function of the scores of one or more methods.
        methods: Scores of each method.
        seed: Seed of the resampling; equal scores and seeds give equal intervals.
        resamples: Number of resamples.
    """
    rng = np.random.default_rng(seed)
    resampled = [[rng.choice(scores, (resamples, len(scores))) for scores in method] for method in methods]
    low, high = np.quantile(statistic(*resampled), [0.5 - 0.5 * CONFIDENCE, 0.5 + 0.5 * CONFIDENCE])
    return float(low), float(high)
