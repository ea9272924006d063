"""Probabilistic movement primitive: a Gaussian over weights of basis functions (Paraschos et al., NeurIPS 2013)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from guiderail.models.common.arrays import as_numbers, as_whole, find_asymmetric
from guiderail.models.common.errors import InputError
from guiderail.models.primitives.demonstrations import Demonstrations

NUM_BASIS = 60  # default number of basis functions for motions of at least four times as many steps
RIDGE = 1e-8  # regularization of the weights, relative to the largest eigenvalue of the features


@dataclass(frozen=True)
class ProMp:
    """Distribution of motions y(s) = (I ⊗ φ(s)ᵀ) w + ε over the phase s, with w ~ N(μ_w, Σ_w) and ε ~ N(0, Σ_y).

    φ(s) are K normalized Gaussian basis functions at equal distances from phase 0 to 1.

    Attributes:
        mean: μ_w (O·K,), the K weights of the first output, then those of the second, … [unit of the output].
        covariance: Σ_w (O·K, O·K), positive semidefinite; its rank is less than the number of demonstrations.
        noise: Σ_y (O, O), covariance of the residuals of the least-squares fit.
    """

    mean: np.ndarray
    covariance: np.ndarray
    noise: np.ndarray

    @classmethod
    def fit(cls, demonstrations: Demonstrations, num_basis: int | None = None) -> ProMp:
        """Fit the weights of each demonstration by least squares, and a Gaussian to them by maximum likelihood.

        Args:
            demonstrations: Demonstrations on one clock (`Demonstrations.resampled`).
            num_basis: K; by default `NUM_BASIS`, but at most a fourth of the number of steps, and at least 2.

        Raises:
            InputError: If the clocks differ, or K is not a whole number from 2 to half the number of steps (2 is always
                accepted).
        """
        steps = len(demonstrations.times[0])
        if any(not np.array_equal(t, demonstrations.times[0]) for t in demonstrations.times):
            raise InputError("a ProMP needs demonstrations on one clock: use resampled()")
        count = min(NUM_BASIS, max(steps // 4, 2)) if num_basis is None else as_whole(num_basis, "num_basis")
        if not 2 <= count <= max(steps // 2, 2):
            raise InputError(f"basis functions must be between 2 and half the number of steps, {steps // 2}: {count}")
        clock = demonstrations.times[0]
        features = _features((clock - clock[0]) / (clock[-1] - clock[0]), count)
        outputs = np.stack(demonstrations.outputs)
        gram = features.T @ features
        gram += RIDGE * np.linalg.eigvalsh(gram)[-1] * np.eye(count)
        weights = np.linalg.solve(gram, features.T @ outputs)  # (M, K, O)
        residuals = (outputs - features @ weights).reshape(-1, outputs.shape[-1])
        flat = weights.transpose(0, 2, 1).reshape(len(outputs), -1)
        apart = flat - flat.mean(axis=0)
        return cls(flat.mean(axis=0), apart.T @ apart / len(flat), residuals.T @ residuals / len(residuals))

    @property
    def num_outputs(self) -> int:
        """Number of outputs O."""
        return len(self.noise)

    def conditioned(self, phase: float, output: np.ndarray, covariance: np.ndarray) -> ProMp:
        """Return the motions that pass through a via-point, by Gaussian conditioning of the weights.

        The motion changes along the demonstrated variations only. The covariance Σ_y of the noise does not change.

        Args:
            phase: Phase of the via-point, in [0, 1].
            output: Output (O,) to pass through.
            covariance: Covariance (O, O) of that output, symmetric and positive definite.

        Raises:
            InputError: If the phase is out of range, a number is not finite, or the covariance is not symmetric or not
                positive definite.
        """
        output, covariance = as_numbers(output, "a via-point"), as_numbers(covariance, "a via-point's covariance")
        if not 0.0 <= phase <= 1.0:
            raise InputError(f"a via-point's phase is in [0, 1], not {phase}")
        if not (np.isfinite(output).all() and np.isfinite(covariance).all() and np.linalg.eigvalsh(covariance)[0] > 0):
            raise InputError("a via-point must be finite, and its covariance positive definite")
        if find_asymmetric(covariance[None]) is not None:
            raise InputError("a via-point's covariance is not symmetric")
        blocks = self._blocks(np.array([phase]))[0]
        across = self.covariance @ blocks.T
        gain = np.linalg.solve(covariance + blocks @ across, across.T).T
        posterior = self.covariance - gain @ across.T
        return replace(
            self, mean=self.mean + gain @ (output - blocks @ self.mean), covariance=(posterior + posterior.T) / 2
        )

    def moments(self, phases: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Compute means (n, O) and covariances (n, O, O) of the outputs at phases (n,)."""
        blocks = self._blocks(phases)
        covariances = blocks @ self.covariance @ blocks.transpose(0, 2, 1) + self.noise
        return blocks @ self.mean, (covariances + covariances.transpose(0, 2, 1)) / 2

    def _blocks(self, phases: np.ndarray) -> np.ndarray:
        """Return I ⊗ φ(s)ᵀ at phases (n,), (n, O, O·K)."""
        count = len(self.mean) // self.num_outputs
        features = _features(phases, count)
        blocks = np.einsum("op,nk->nopk", np.eye(self.num_outputs), features)
        return blocks.reshape(len(features), self.num_outputs, -1)


def _features(phases: np.ndarray, count: int) -> np.ndarray:
    """Return normalized Gaussian basis functions (n, K) at phases (n,); their spacing is one standard deviation."""
    offsets = (np.asarray(phases, dtype=float)[:, None] - np.linspace(0.0, 1.0, count)) * (count - 1)
    bumps = np.exp(-0.5 * offsets**2)
    return bumps / bumps.sum(axis=1, keepdims=True)
