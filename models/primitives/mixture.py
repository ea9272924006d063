"""Gaussian mixture of time and outputs, and its regression on time (thesis, sections 2.2.3 and 2.2.4).

scikit-learn fits the mixture; this module adds the initialization and the regression.
"""

from __future__ import annotations

import hashlib
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from guiderail.models.common.arrays import as_whole

# Importing scikit-learn takes over a second, and reading a file does not need it.
if TYPE_CHECKING:
    from sklearn.mixture import GaussianMixture

# Mixtures of the demonstrations in the package, written by `python -m research.generate mixtures`. With them, training
# on these demonstrations does not import scikit-learn, starts 0.7 s earlier and needs 70 MiB less memory. Run it after
# a change of the fit, of a demonstration in the package or of a task's COMPONENTS; a test compares the stored mixtures.
STORED_PATH = Path(__file__).with_name("mixtures.npz")
# Variance added to every component, relative to the data's variance. EM needs it where demonstrations coincide.
_REGULARIZATION = 1e-6
_MAX_COMPONENTS = 20  # largest number of components that is tried by default


@dataclass(frozen=True)
class Mixture:
    """Joint Gaussian mixture of (time, outputs), standardized by `center` and `scale`."""

    weights: np.ndarray  # weights of the components (C,)
    means: np.ndarray  # means (C, 1 + O)
    covariances: np.ndarray  # covariances (C, 1 + O, 1 + O)
    center: np.ndarray  # mean of the data (1 + O,) [s, unit of the output]
    scale: np.ndarray  # standard deviations of the data (1 + O,) [s, unit of the output]


FIELDS = [field.name for field in fields(Mixture)]


@cache
def _stored() -> dict[str, Mixture]:
    """Return the mixtures in the package by `digest`."""
    with np.load(STORED_PATH, allow_pickle=False) as file:
        return {key: Mixture(*(file[f"{key}/{name}"] for name in FIELDS)) for key in {k.split("/")[0] for k in file}}


def digest(times: np.ndarray, outputs: np.ndarray, components: int | None, seed: int) -> str:
    """Return the digest of the arguments of `fit_mixture`, the key of a stored mixture."""
    data = np.concatenate([times, outputs.ravel()]).astype(float).tobytes()
    return hashlib.blake2b(data + f"{outputs.shape} {components} {seed}".encode(), digest_size=16).hexdigest()


def fit_mixture(times: np.ndarray, outputs: np.ndarray, components: int | None, seed: int) -> Mixture:
    """Return the stored mixture of M demonstrations, or fit it.

    The arguments and errors are those of `fit_new_mixture`.
    """
    stored = _stored().get(digest(times, outputs, components, seed))
    return fit_new_mixture(times, outputs, components, seed) if stored is None else stored


def fit_new_mixture(times: np.ndarray, outputs: np.ndarray, components: int | None, seed: int) -> Mixture:
    """Fit C components to M demonstrations by expectation maximization, initialized with C equal slices of time.

    With this initialization the components remain in order along the motion. With a random initialization, several
    components share a wide region while a narrow region is blurred.

    Args:
        times: Common clock (N,) [s].
        outputs: Outputs (M, N, O).
        components: Number of components C, from 1 to half the number of steps. By default the number with the least
            Bayesian information criterion, at most 20; the search stops after two consecutive numbers that are worse
            than the best earlier one.
        seed: Seed of scikit-learn's generator, from 0 to 2^32 − 1.
    """
    _, center, scale = _standardize(times, outputs)
    candidates = [components] if components is not None else range(1, min(_MAX_COMPONENTS, len(times) // 2) + 1)
    best, _ = min(_fit_candidates(times, outputs, candidates, seed).values(), key=lambda fit: fit[1])
    return Mixture(best.weights_, best.means_, best.covariances_, center, scale)


def thinned(num_steps: int, most: int | None) -> np.ndarray:
    """Return the indices of at most `most` of the steps, evenly spaced with the first and the last; all if None."""
    if most is None or num_steps <= most:
        return np.arange(num_steps)
    return np.unique(np.linspace(0, num_steps - 1, most).round().astype(int))


def information_criteria(
    times: np.ndarray, outputs: np.ndarray, candidates: Sequence[int], seed: int
) -> dict[int, float]:
    """Compute the Bayesian information criterion of mixtures by number of components; less is better.

    `candidates` are increasing; the search stops after two consecutive numbers that are worse than the best earlier
    one. The other arguments and the errors are those of `fit_mixture`.
    """
    return {count: criterion for count, (_, criterion) in _fit_candidates(times, outputs, candidates, seed).items()}


def _fit_candidates(
    times: np.ndarray, outputs: np.ndarray, candidates: Sequence[int], seed: int
) -> dict[int, tuple[GaussianMixture, float]]:
    """Return mixtures and their criteria by number of components; see `information_criteria`."""
    seed, most = as_whole(seed, "seed"), len(times) // 2
    candidates = [as_whole(count, "the number of components", 1, most) for count in candidates]
    data, _, _ = _standardize(times, outputs)
    phase = np.tile(np.arange(len(times)), len(outputs)) / len(times)  # phase of each sample, from 0 to below 1
    fits: dict[int, tuple[GaussianMixture, float]] = {}
    for count in candidates:
        mixture = _fit(data, phase, count, seed)
        fits[count] = mixture, float(mixture.bic(data))
        criteria = [criterion for _, criterion in fits.values()]
        if len(criteria) > 2 and min(criteria[-2:]) > min(criteria[:-2]):
            break
    return fits


def regress(mixture: Mixture, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute Gaussian mixture regression on times (N,) [s].

    Conditioned on time, each component has a mean that is linear in time and a constant covariance. The components are
    weighted by the likelihood of the time. The results are means (N, O) and covariances (N, O, O) of the mixture.
    """
    offset = (times[:, None] - mixture.center[0]) / mixture.scale[0] - mixture.means[:, 0]  # (N, C)
    variance, across = mixture.covariances[:, 0, 0], mixture.covariances[:, 1:, 0]
    log = np.log(mixture.weights) - 0.5 * (np.log(variance) + offset**2 / variance)
    weights = np.exp(log - log.max(axis=1, keepdims=True))  # scaled to avoid underflow far from every component
    weights /= weights.sum(axis=1, keepdims=True)
    slopes = across / variance[:, None]
    lines = mixture.means[:, 1:] + offset[..., None] * slopes  # (N, C, O)
    within = mixture.covariances[:, 1:, 1:] - slopes[:, :, None] * across[:, None, :]
    means = np.einsum("nc,nco->no", weights, lines)
    apart = lines - means[:, None, :]
    covariances = np.einsum("nc,cop->nop", weights, within) + np.einsum("nc,nco,ncp->nop", weights, apart, apart)
    covariances = (covariances + covariances.transpose(0, 2, 1)) / 2
    scale = mixture.scale[1:]
    return means * scale + mixture.center[1:], covariances * scale[:, None] * scale


def _standardize(times: np.ndarray, outputs: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return samples (M·N, 1 + O) of time and outputs, standardized, with their center and scale (1 + O,)."""
    data = np.column_stack([np.tile(times, len(outputs)), outputs.reshape(-1, outputs.shape[-1])])
    center, deviation = data.mean(axis=0), data.std(axis=0)
    # The standard deviation of a constant output is only a rounding error.
    varies = deviation > 1e-12 * np.abs(data).max(axis=0)
    scale = np.where(varies, deviation, 1.0)
    return (data - center) / scale, center, scale


def _fit(data: np.ndarray, phase: np.ndarray, components: int, seed: int) -> GaussianMixture:
    from sklearn.exceptions import ConvergenceWarning
    from sklearn.mixture import GaussianMixture

    label = np.minimum((phase * components).astype(int), components - 1)
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
        # EM starts near its optimum, and is accurate enough long before scikit-learn's tolerance is reached.
        warnings.simplefilter("ignore", ConvergenceWarning)
        return mixture.fit(data)
