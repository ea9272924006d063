"""Prediction of a policy's success and force on a robot, from simulated episodes of draws of its posterior."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import betainc, betaln

from guiderail_calibration.simulations import Simulated

LEVEL = 0.9  # probability of an interval
_GRID = 99  # points of the grids of mean, concentration and rate


@dataclass(frozen=True)
class Prediction:
    """Predicted success rate and peak force of a policy on one robot."""

    success: float  # mean of the predicted success rate
    low: float  # ends of the interval of the success rate, with probability `LEVEL`
    high: float
    peak_force: float  # median peak force of an episode [N]
    peak_force_low: float  # ends of the interval of an episode's peak force, with probability `LEVEL` [N]
    peak_force_high: float
    episodes: int  # number of simulated episodes


def predict(simulated: Sequence[Simulated]) -> Prediction:
    """Return the prediction from simulated episodes of draws of the posterior."""
    successes = np.array([draw.success.sum() for draw in simulated])
    numbers = np.array([len(draw.success) for draw in simulated])
    rates, probability = rate_distribution(successes, numbers)
    cumulative = np.cumsum(probability)
    tail = 0.5 * (1.0 - LEVEL)
    low, high = (float(rates[min(int(np.searchsorted(cumulative, p)), len(rates) - 1)]) for p in (tail, 1.0 - tail))
    forces = np.concatenate([draw.peak_force for draw in simulated])
    force_low, force, force_high = (float(np.quantile(forces, p)) for p in (tail, 0.5, 1.0 - tail))
    total = int(numbers.sum())
    return Prediction(float(rates @ probability), low, high, force, force_low, force_high, total)


def rate_distribution(successes: np.ndarray, numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return success rates (n,) and the probability (n,) of each, for another draw of the same posterior.

    Draws have different success rates, which follow a beta distribution. Its mean m has the prior Beta(½, ½), and the
    logarithm of its concentration a uniform prior. The successes k of n episodes of a draw follow the beta-binomial
    distribution; the result is the average of the beta distributions over the posterior of m and concentration.

    Args:
        successes: Successes of each draw, (draws,).
        numbers: Episodes of each draw, (draws,).
    """
    means = (np.arange(_GRID) + 0.5) / _GRID
    concentrations = np.logspace(-0.5, 3.0, _GRID)
    a = means[:, None] * concentrations
    b = (1.0 - means[:, None]) * concentrations
    logarithm = -0.5 * np.log(means * (1.0 - means))[:, None] + np.zeros_like(a)
    for (k, n), draws in Counter(zip(successes.tolist(), numbers.tolist(), strict=True)).items():
        logarithm += draws * (betaln(a + k, b + n - k) - betaln(a, b))
    weights = np.exp(logarithm - logarithm.max())
    weights /= weights.sum()
    edges = np.linspace(0.0, 1.0, _GRID + 1)
    cumulative = np.stack([(weights * betainc(a, b, edge)).sum() for edge in edges])
    return means, np.diff(cumulative) / (cumulative[-1] - cumulative[0])
