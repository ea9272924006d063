"""Gaussian mixtures of demonstrations, and regression on them (thesis, sections 2.2.3 and 2.2.4).

scikit-learn fits the mixture; what stands here is what it doesn't know: that the first column is time.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from guiderail.models.common.errors import InputError

# Importing it takes over a second, which who only reads a file need not wait for.
if TYPE_CHECKING:
    from sklearn.mixture import GaussianMixture

# Variance added to every component, relative to the data's own: what keeps EM alive where demonstrations coincide.
_REGULARIZATION = 1e-6
_MOST_COMPONENTS = 20


@dataclass(frozen=True)
class Mixture:
    """A joint Gaussian mixture of (time, outputs), in units of the data's own standard deviations.

    Attributes:
        weights: (C,), of the components.
        means: (C, 1 + O).
        covariances: (C, 1 + O, 1 + O).
        center: (1 + O,), the data's mean [s, unit of the output].
        scale: (1 + O,), its standard deviations.
    """

    weights: np.ndarray
    means: np.ndarray
    covariances: np.ndarray
    center: np.ndarray
    scale: np.ndarray


def fit_mixture(times: np.ndarray, outputs: np.ndarray, components: int | None, seed: int) -> Mixture:
    """Fits C components to M demonstrations by expectation maximization, started from C equal slices of time.

    Started from slices the components stay in order along the motion; started at random, a few of them share a wide
    region and blur a narrow one.

    Args:
        times: (N,), the common clock.
        outputs: (M, N, O).
        components: C; unless given, the number of least Bayesian information criterion among 1 to 20, of which no
            more are tried once two have not been better than the best before.
        seed: of scikit-learn's generator.

    Raises:
        InputError: if there are fewer points than components need.
    """
    _, center, scale = _scaled(times, outputs)
    most = min(_MOST_COMPONENTS, len(times) // 2)
    candidates = [components] if components is not None else range(1, most + 1)
    best, _ = min(_fits(times, outputs, candidates, seed).values(), key=lambda fit: fit[1])
    return Mixture(best.weights_, best.means_, best.covariances_, center, scale)


def _check_components(times: np.ndarray, candidates: Sequence[int]) -> None:
    for count in candidates:
        if not 1 <= count <= len(times) // 2:
            raise InputError(f"components must be between 1 and half the number of steps, {len(times) // 2}: {count}")


def information_criteria(
    times: np.ndarray, outputs: np.ndarray, candidates: Sequence[int], seed: int
) -> dict[int, float]:
    """The Bayesian information criterion of a mixture of each number of components; less is better.

    Args:
        times, outputs, seed: as in `fit_mixture`.
        candidates: increasing numbers; it stops where two more have not been better than the best before.

    Raises:
        InputError: if there are fewer points than components need.
    """
    return {count: criterion for count, (_, criterion) in _fits(times, outputs, candidates, seed).items()}


def _fits(
    times: np.ndarray, outputs: np.ndarray, candidates: Sequence[int], seed: int
) -> dict[int, tuple[GaussianMixture, float]]:
    """Fits and their criteria, until two more have not been better than the best before."""
    _check_components(times, candidates)
    data, _, _ = _scaled(times, outputs)
    slices = _slices(times, outputs)
    found: dict[int, tuple[GaussianMixture, float]] = {}
    for count in candidates:
        fit = _fit(data, slices, count, seed)
        found[count] = fit, float(fit.bic(data))
        criteria = [criterion for _, criterion in found.values()]
        if len(criteria) > 2 and min(criteria[-2:]) > min(criteria[:-2]):
            break
    return found


def regress(mixture: Mixture, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Gaussian mixture regression on time: means (N, O) and covariances (N, O, O) at `times` (N,).

    Each component is a line and a constant covariance there; together they have the mixture's mean and covariance,
    weighted by how likely the time is under each.
    """
    early = (times[:, None] - mixture.center[0]) / mixture.scale[0] - mixture.means[:, 0]  # (N, C)
    variance, across = mixture.covariances[:, 0, 0], mixture.covariances[:, 1:, 0]
    log = np.log(mixture.weights) - 0.5 * (np.log(variance) + early**2 / variance)
    likely = np.exp(log - log.max(axis=1, keepdims=True))  # far from every component some of them are still likeliest
    likely /= likely.sum(axis=1, keepdims=True)
    slopes = across / variance[:, None]
    lines = mixture.means[:, 1:] + early[..., None] * slopes  # (N, C, O)
    within = mixture.covariances[:, 1:, 1:] - slopes[:, :, None] * across[:, None, :]
    means = np.einsum("nc,nco->no", likely, lines)
    apart = lines - means[:, None, :]
    covariances = np.einsum("nc,cop->nop", likely, within) + np.einsum("nc,nco,ncp->nop", likely, apart, apart)
    covariances = (covariances + covariances.transpose(0, 2, 1)) / 2
    scale = mixture.scale[1:]
    return means * scale + mixture.center[1:], covariances * scale[:, None] * scale


def _scaled(times: np.ndarray, outputs: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Samples (M·N, 1 + O) of time and outputs in units of their own standard deviations, with centre and scale."""
    data = np.column_stack([np.tile(times, len(outputs)), outputs.reshape(-1, outputs.shape[-1])])
    center, deviation = data.mean(axis=0), data.std(axis=0)
    # What an output that never moves differs by is how its mean is rounded.
    moves = deviation > 1e-12 * np.abs(data).max(axis=0)
    scale = np.where(moves, deviation, 1.0)
    return (data - center) / scale, center, scale


def _slices(times: np.ndarray, outputs: np.ndarray) -> np.ndarray:
    """Where in the motion each sample is, from 0 to below 1."""
    return np.tile(np.arange(len(times)), len(outputs)) / len(times)


def _fit(data: np.ndarray, slices: np.ndarray, components: int, seed: int) -> GaussianMixture:
    from sklearn.exceptions import ConvergenceWarning
    from sklearn.mixture import GaussianMixture

    label = np.minimum((slices * components).astype(int), components - 1)
    parts = [data[label == c] for c in range(components)]
    floor = 10 * _REGULARIZATION * np.eye(data.shape[1])
    mixture = GaussianMixture(
        components,
        reg_covar=_REGULARIZATION,
        max_iter=300,
        random_state=seed,
        weights_init=np.full(components, 1 / components),
        means_init=np.array([part.mean(axis=0) for part in parts]),
        precisions_init=np.array([np.linalg.inv(np.cov(part.T) + floor) for part in parts]),
    )
    with warnings.catch_warnings():
        # EM started near its optimum stops within the tolerance that matters here long before scikit-learn's.
        warnings.simplefilter("ignore", ConvergenceWarning)
        return mixture.fit(data)
