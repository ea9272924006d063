"""Probabilistic movement primitive: a Gaussian over weights of basis functions (Paraschos et al., NeurIPS 2013).

It describes the same demonstrations as the Gaussian mixture of `ReferenceTrajectory.from_demonstrations`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from guiderail.models.common.arrays import as_numbers, as_whole, find_asymmetric
from guiderail.models.common.errors import InputError
from guiderail.models.primitives import Demonstrations, ReferenceTrajectory
from guiderail.models.primitives.reference import checked_floor

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
        count = min(NUM_BASIS, max(steps // 4, 2)) if num_basis is None else num_basis
        count = as_whole(count, "num_basis", 2, max(steps // 2, 2))
        clock = demonstrations.times[0]
        features = basis((clock - clock[0]) / (clock[-1] - clock[0]), count)
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

    def reference(self, times: np.ndarray, floor: float | np.ndarray = 0.0) -> ReferenceTrajectory:
        """Return the reference trajectory of the means and covariances, with or without via-points.

        Args:
            times: Times (N,) of the phases from 0 to 1, strictly increasing [s].
            floor: Standard deviation, (O,) or scalar, as in `ReferenceTrajectory.from_demonstrations`.
        """
        times = as_numbers(times, "times")
        floor = checked_floor(floor, self.num_outputs)
        means, covariances = self.moments((times - times[0]) / (times[-1] - times[0]))
        return ReferenceTrajectory(times, means, covariances + np.eye(self.num_outputs) * np.square(floor))

    def _blocks(self, phases: np.ndarray) -> np.ndarray:
        """Return I ⊗ φ(s)ᵀ at phases (n,), (n, O, O·K)."""
        count = len(self.mean) // self.num_outputs
        features = basis(phases, count)
        blocks = np.einsum("op,nk->nopk", np.eye(self.num_outputs), features)
        return blocks.reshape(len(features), self.num_outputs, -1)


def blend(first: ReferenceTrajectory, second: ReferenceTrajectory, share: float | np.ndarray) -> ReferenceTrajectory:
    """Blend two references by the normalized product of their Gaussians to the powers 1 − a and a.

        Σ⁻¹ = (1 − a) Σ₁⁻¹ + a Σ₂⁻¹,    Σ⁻¹ μ = (1 − a) Σ₁⁻¹ μ₁ + a Σ₂⁻¹ μ₂

    The reference of smaller covariance dominates (Paraschos et al., 2013).

    Args:
        first: Reference.
        second: Reference with the same times and outputs.
        share: a in [0, 1], one number or (N,): 0 for the first reference, 1 for the second.

    Raises:
        InputError: If times or numbers of outputs differ, or the share is out of range.
    """
    if first.means.shape != second.means.shape or not np.allclose(first.times, second.times, rtol=0.0, atol=1e-9):
        raise InputError("only references with the same times and outputs can be blended: resample one of them")
    a = np.asarray(share, dtype=float)
    if a.shape not in ((), (first.num_steps,)) or not ((a >= 0.0) & (a <= 1.0)).all():
        raise InputError(f"the share of a blend is one number in [0, 1], or one for each of {first.num_steps} steps")
    a = np.broadcast_to(a, first.num_steps)[:, None, None]
    # With M = (1 − a) Σ₂ + a Σ₁ the covariance is Σ₁ M⁻¹ Σ₂ = Σ₂ M⁻¹ Σ₁, and a share of 0 or 1 is exact.
    M = (1.0 - a) * second.covariances + a * first.covariances
    from_first = np.linalg.solve(M, first.covariances).transpose(0, 2, 1)
    from_second = np.linalg.solve(M, second.covariances).transpose(0, 2, 1)
    means = (1.0 - a[..., 0]) * np.einsum("nop,np->no", from_second, first.means)
    means += a[..., 0] * np.einsum("nop,np->no", from_first, second.means)
    covariances = from_first @ second.covariances
    return ReferenceTrajectory(first.times, means, (covariances + covariances.transpose(0, 2, 1)) / 2)


def basis(phases: np.ndarray, count: int) -> np.ndarray:
    """Return K normalized Gaussian basis functions (n, K) at phases (n,); their spacing is one standard deviation."""
    offsets = (np.asarray(phases, dtype=float)[:, None] - np.linspace(0.0, 1.0, count)) * (count - 1)
    bumps = np.exp(-0.5 * offsets**2)
    return bumps / bumps.sum(axis=1, keepdims=True)
