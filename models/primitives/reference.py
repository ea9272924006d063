"""The reference trajectory: what demonstrations have in common, and how sure they are of it (thesis, 2.2.3-2.2.5)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from guiderail.models.common.arrays import numbers
from guiderail.models.common.errors import InputError
from guiderail.models.primitives.demonstrations import Demonstrations
from guiderail.models.primitives.kernels import Kernel
from guiderail.models.primitives.mixture import fit_mixture, regress

# Below this, relative to a covariance's own largest variance, a direction is singular in double precision.
_SINGULAR = 1e-13


class ReferenceTrajectory:
    """Means and covariances of O outputs at N instants: T_r = {μ̂_n, Σ̂_n} (thesis, 2.2.7).

    Attributes:
        times: (N,), increasing.
        means: (N, O).
        covariances: (N, O, O), symmetric positive definite.
    """

    def __init__(self, times: np.ndarray, means: np.ndarray, covariances: np.ndarray):
        """
        Args:
            times: (N,), strictly increasing [s or phase], at least two.
            means: (N, O) [unit of the output].
            covariances: (N, O, O) [unit²].

        Raises:
            InputError: if shapes don't fit, a number is not finite, times don't increase, or a covariance is not
                symmetric or not positive definite.
        """
        self.times, self.means = numbers(times, "times"), numbers(means, "means")
        self.covariances = numbers(covariances, "covariances")
        if self.times.ndim != 1 or len(self.times) < 2:
            raise InputError(f"a reference trajectory needs at least two times of shape (N,), not {self.times.shape}")
        n = len(self.times)
        if self.means.ndim != 2 or len(self.means) != n or self.means.shape[1] < 1:
            raise InputError(f"means must have shape ({n}, O), as there are {n} times, not {self.means.shape}")
        outputs = self.means.shape[1]
        if self.covariances.shape != (n, outputs, outputs):
            raise InputError(f"covariances must have shape ({n}, {outputs}, {outputs}), not {self.covariances.shape}")
        for name, values in (("times", self.times), ("means", self.means), ("covariances", self.covariances)):
            if not np.isfinite(values).all():
                raise InputError(f"the reference's {name} must be finite")
        if not (np.diff(self.times) > 0).all():
            raise InputError("the reference's times must increase strictly")
        self._check_covariances()
        for values in (self.times, self.means, self.covariances):
            values.setflags(write=False)  # skills and environments of a process share it
        step = (self.times[-1] - self.times[0]) / (n - 1)
        grid = self.times[0] + step * np.arange(n)
        #: True if all time steps are the same up to rounding.
        self.uniform = bool(np.abs(self.times - grid).max() <= 1e-12 * np.abs(self.times).max())

    @classmethod
    def from_demonstrations(
        cls,
        demonstrations: Demonstrations,
        components: int | None = None,
        seed: int = 0,
        num_steps: int | None = None,
        floor: float | np.ndarray = 0.0,
    ) -> ReferenceTrajectory:
        """A Gaussian mixture of (time, output), regressed on time (equation 2.12 and GMR).

        Args:
            demonstrations: M of them; resampled onto one clock where theirs differ.
            components: C; chosen by the Bayesian information criterion unless given.
            seed: of the mixture's initialization.
            num_steps: N; as many as the longest demonstration has unless given.
            floor: a standard deviation [unit of the output], (O,) or scalar, that is added to every covariance: what a
                sensor resolves or a controller holds, where demonstrations agree better than that.

        Raises:
            InputError: if an argument is out of range, or the demonstrations leave a covariance singular.
        """
        demonstrations = demonstrations.resampled(num_steps)
        times, outputs = demonstrations.times[0], np.stack(demonstrations.outputs)
        floor = np.broadcast_to(np.asarray(floor, dtype=float), outputs.shape[-1:])
        if not (np.isfinite(floor).all() and (floor >= 0).all()):
            raise InputError(f"floor is a standard deviation and must not be negative: {floor}")
        mixture = fit_mixture(times, outputs, components, seed)
        means, covariances = regress(mixture, times)
        return cls(times, means, covariances + np.diag(floor**2))

    @property
    def num_steps(self) -> int:
        """N."""
        return len(self.times)

    @property
    def num_outputs(self) -> int:
        """O."""
        return self.means.shape[1]

    @property
    def standard_deviations(self) -> np.ndarray:
        """(N, O) [unit of the output]."""
        return np.sqrt(np.einsum("noo->no", self.covariances))

    def inputs(self, steps: np.ndarray) -> np.ndarray:
        """Times (n,) [s] at any steps (n,): before the first and after the last, the clock goes on as it does there."""
        last = self.num_steps - 1
        inside = self.times[np.clip(steps, 0, last)]
        before = np.minimum(steps, 0) * (self.times[1] - self.times[0])
        after = np.maximum(steps - last, 0) * (self.times[-1] - self.times[-2])
        return inside + before + after

    def _check_covariances(self) -> None:
        asymmetry = np.abs(self.covariances - self.covariances.transpose(0, 2, 1)).max(axis=(1, 2))
        size = np.abs(self.covariances).max(axis=(1, 2))
        worst = int(np.argmax(asymmetry - 1e-9 * size))
        if asymmetry[worst] > 1e-9 * size[worst]:
            raise InputError(f"the covariance at step {worst} is not symmetric")
        self.covariances = (self.covariances + self.covariances.transpose(0, 2, 1)) / 2
        # Outputs may have very different units; correlation has none, and is what singular means.
        deviations = np.sqrt(np.maximum(np.einsum("noo->no", self.covariances), 0))
        bad = (deviations <= 0).any(axis=1)
        scaled = self.covariances / np.where(bad[:, None, None], 1, deviations[:, :, None] * deviations[:, None, :])
        bad |= np.linalg.eigvalsh(scaled)[:, 0] <= _SINGULAR
        if bad.any():
            raise InputError(
                f"the covariance at step {int(np.argmax(bad))} is singular or not positive definite; add a small "
                "variance to its diagonal (from_demonstrations has floor= for that)"
            )


EXACTNESS = 1e-4  # variance of a via-point, as a part of the kernel's own: how far several that disagree are averaged


def pass_through(reference: ReferenceTrajectory, points: Sequence[float], kernel: Kernel) -> ReferenceTrajectory:
    """The reference with a mean that passes through via-points; its covariances stay.

    The displacement between via-points is the mean of a Gaussian process that is zero far from all of them.

    Args:
        reference: what was demonstrated.
        points: for each via-point its step and its output, 1 + O numbers, one after another.
        kernel: Covariance of the process.

    Raises:
        InputError: if these are not rows of a step and O finite numbers, or there is no such step.
    """
    size = 1 + reference.num_outputs
    if len(points) % size or not np.isfinite(points).all():
        raise InputError(f"via-points are rows of a step and {size - 1} finite numbers, not {len(points)} numbers")
    rows = np.array(points, dtype=float).reshape(-1, size)
    if not len(rows):
        return reference
    steps = rows[:, 0]
    if (steps % 1 != 0).any() or steps.min() < 0 or steps.max() >= reference.num_steps:
        raise InputError(f"a via-point's step is a whole number from 0 to {reference.num_steps - 1}")
    at = steps.astype(int)
    times = reference.times
    K = kernel(times[at], times[at]) + EXACTNESS * np.eye(len(at))
    displacement = kernel(times, times[at]) @ np.linalg.solve(K, rows[:, 1:] - reference.means[at])
    return ReferenceTrajectory(times, reference.means + displacement, reference.covariances)
