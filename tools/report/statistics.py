"""What a report computes over runs: bands, survival, interquartile means; all of it SciPy's."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy import stats

CONFIDENCE = 0.95
RESAMPLES = 1000
TRIMMED = 0.25  # of the seeds at either end, for the interquartile mean
IN_A_ROW = 10  # successes that convergence needs


def bootstrap_band(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The 95 % interval of the mean over the first axis of (runs, n), at each of n; two runs are needed."""
    return _bootstrap(np.asarray(values, float), np.mean)


def interquartile_mean(values: Sequence[float]) -> tuple[float, tuple[float, float] | None]:
    """The mean without a quarter of the values at either end, and its 95 % interval; None for a single value.

    Of fewer than four values none is left out.
    """
    known = np.asarray(values, float)
    mean = float(stats.trim_mean(known, TRIMMED))
    if len(known) < 2:
        return mean, None
    low, high = _bootstrap(known, lambda x, axis: stats.trim_mean(x, TRIMMED, axis=axis))
    return mean, (float(low), float(high))


def _bootstrap(values: np.ndarray, statistic: Any) -> tuple[Any, Any]:
    if np.ptp(values, axis=0).max() == 0:  # nothing to resample, and SciPy would warn of it
        mean = statistic(values, axis=0)
        return mean, mean
    interval = stats.bootstrap(
        (values,), statistic, axis=0, vectorized=True, confidence_level=CONFIDENCE, n_resamples=RESAMPLES,
        method="percentile", rng=np.random.default_rng(0),
    ).confidence_interval  # fmt: skip
    return interval.low, interval.high


def wilson(successes: int, episodes: int) -> tuple[float, float]:
    """The 95 % interval of a success rate."""
    interval = stats.binomtest(int(successes), int(episodes)).proportion_ci(CONFIDENCE, method="wilson")
    return float(interval.low), float(interval.high)


def wilson_of_each(successes: Sequence[int], episodes: Sequence[int]) -> list[tuple[float, float]]:
    """The 95 % interval of each seed's success rate.

    There is none of all seeds together: episodes of one policy are independent, those of several policies are not, as
    what a seed came to decides all of its own.
    """
    return [wilson(won, of) for won, of in zip(successes, episodes, strict=True)]


def survival(converged: Sequence[int | None], episodes: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
    """How many of the runs have not converged after so many episodes: steps (k,) and the part (k,) from there on.

    Kaplan and Meier's estimate. A run that never converged says only that it takes more episodes than those after which
    ten in a row would still have fitted into it.

    Args:
        converged: after how many episodes each run converged, None for never.
        episodes: how many each has.
    """
    known = [after for after in converged if after is not None]
    censored = [max(n - IN_A_ROW, 0) for after, n in zip(converged, episodes, strict=True) if after is None]
    if not known:
        return np.array([0.0]), np.array([1.0])
    function = stats.ecdf(stats.CensoredData(uncensored=known, right=censored)).sf
    return np.append(0.0, function.quantiles), np.append(1.0, function.probabilities)


def median_survival(steps: np.ndarray, left: np.ndarray) -> float | None:
    """After how many episodes half of the runs have converged; None if fewer do."""
    reached = steps[left <= 0.5]
    return float(reached[0]) if len(reached) else None
