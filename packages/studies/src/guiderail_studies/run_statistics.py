"""Statistics of runs over seeds: bands of learning curves, interquartile mean, and survival until convergence."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
import scipy  # `scipy.stats` is imported on first use

from guiderail.tools.evaluation.metrics import CONFIDENCE, CONVERGED_SUCCESSES

RESAMPLES = 1000  # number of bootstrap resamples
MEAN_RESAMPLES = 20_000  # number of bootstrap resamples of an interquartile mean, which have few distinct values
MAX_ENUMERATED = 6  # largest number of seeds for which all resamples are enumerated
TRIMMED_FRACTION = 0.25  # fraction of the seeds that the interquartile mean drops at either end


def bootstrap_band(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return lower and upper ends, (n,) each, of the 95 % interval of the mean of `values` (R, n) over R ≥ 2 runs."""
    return _bootstrap(np.asarray(values, float), np.mean)


def interquartile_mean(values: Sequence[float]) -> tuple[float, tuple[float, float] | None]:
    """Return the mean of the values without the lowest and the highest quarter, and its 95 % interval.

    With fewer than four values, none is dropped. The interval is None for a single value.
    """
    array = np.asarray(values, float)
    mean = float(scipy.stats.trim_mean(array, TRIMMED_FRACTION))
    if len(array) < 2:
        return mean, None
    if np.ptp(array) == 0:  # SciPy warns if there is nothing to resample
        return mean, (mean, mean)
    size = len(array)
    if size <= MAX_ENUMERATED:  # the interval is exact
        means = scipy.stats.trim_mean(array[np.indices((size,) * size).reshape(size, -1)], TRIMMED_FRACTION, axis=0)
        low, high = np.quantile(means, [0.5 - 0.5 * CONFIDENCE, 0.5 + 0.5 * CONFIDENCE], method="inverted_cdf")
    else:
        trimmed = partial(scipy.stats.trim_mean, proportiontocut=TRIMMED_FRACTION)
        low, high = _bootstrap(array, trimmed, MEAN_RESAMPLES)
    return mean, (float(low), float(high))


def _bootstrap(values: np.ndarray, statistic: Any, resamples: int = RESAMPLES) -> tuple[Any, Any]:
    """Return the ends of the 95 % percentile interval of a statistic over the first axis, by resampling."""
    if np.ptp(values, axis=0).max() == 0:  # SciPy warns if there is nothing to resample
        mean = statistic(values, axis=0)
        return mean, mean
    interval = scipy.stats.bootstrap(
        (values,), statistic, axis=0, vectorized=True, confidence_level=CONFIDENCE, n_resamples=resamples,
        method="percentile", rng=np.random.default_rng(0),
    ).confidence_interval  # fmt: skip
    return interval.low, interval.high


def survival(converged: Sequence[int | None], episodes: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
    """Estimate the fraction of runs that have not converged, by the Kaplan-Meier estimator.

    A run that never converged is censored ten episodes before its end: ten successes that begin later would not fit.

    Args:
        converged: Episodes to convergence of each run; None for a run that never converged.
        episodes: Number of episodes of each run.

    Returns:
        Numbers of episodes in order, beginning with 0, and the fraction from each of them on, (k,) each.
    """
    uncensored = [after for after in converged if after is not None]
    censored = [max(n - CONVERGED_SUCCESSES, 0) for after, n in zip(converged, episodes, strict=True) if after is None]
    if not uncensored:
        return np.array([0.0]), np.array([1.0])
    function = scipy.stats.ecdf(scipy.stats.CensoredData(uncensored=uncensored, right=censored)).sf
    return np.append(0.0, function.quantiles), np.append(1.0, function.probabilities)


def median_survival(steps: np.ndarray, fractions: np.ndarray) -> float | None:
    """Return the number of episodes after which half of the runs have converged; None if fewer than half do.

    The arguments are the results of `survival`, (k,) each.
    """
    reached = steps[fractions < 0.5 + 1e-9]  # the estimator's products round a half to slightly more
    return float(reached[0]) if len(reached) else None
