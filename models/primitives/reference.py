"""Reference trajectory: the mean and covariance of demonstrations over time (thesis, sections 2.2.3 to 2.2.5).

`mixture` fits the Gaussian mixture and regresses it on time.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from guiderail.models.common.arrays import as_numbers, find_asymmetric
from guiderail.models.common.errors import InputError
from guiderail.models.primitives.demonstrations import Demonstrations, num_periods
from guiderail.models.primitives.kernels import Kernel, check_kernel
from guiderail.models.primitives.mixture import fit_mixture, regress, thinned

_SINGULAR = 1e-13  # largest eigenvalue of a correlation matrix that is singular in double precision
VIA_POINT_VARIANCE = 1e-4  # variance of a via-point, relative to the kernel's; contradicting via-points are averaged


class ReferenceTrajectory:
    """Means and covariances of O outputs at N instants, T_r = {μ̂_n, Σ̂_n} (thesis, 2.2.7).

    Args:
        times: Times (N,), strictly increasing, at least two [s or phase].
        means: Means (N, O) [unit of the output].
        covariances: Covariances (N, O, O) [unit²].

    Raises:
        InputError: If shapes do not match, a number is not finite, times do not increase, or a covariance is not
            symmetric or not positive definite.

    Attributes:
        times, means, covariances: Copies of the arguments, read-only; the covariances are exactly symmetric.
        uniform: True if all time steps are equal up to rounding.
    """

    def __init__(self, times: np.ndarray, means: np.ndarray, covariances: np.ndarray):
        self.times, self.means = as_numbers(times, "times"), as_numbers(means, "means")
        self.covariances = as_numbers(covariances, "covariances")
        if self.times.ndim != 1 or len(self.times) < 2:
            raise InputError(f"a reference trajectory needs at least two times of shape (N,), not {self.times.shape}")
        n, outputs = len(self.times), self.means.shape[-1]
        if self.means.shape != (n, outputs) or self.covariances.shape != (n, outputs, outputs):
            raise InputError(
                f"{n} times need means ({n}, O) and covariances ({n}, O, O), not {self.means.shape} and "
                f"{self.covariances.shape}"
            )
        for name, values in (("times", self.times), ("means", self.means), ("covariances", self.covariances)):
            if not np.isfinite(values).all():
                raise InputError(f"the reference's {name} must be finite")
        if not (np.diff(self.times) > 0).all():
            raise InputError("the reference's times must increase strictly")
        self._check_covariances()
        for values in (self.times, self.means, self.covariances):
            values.setflags(write=False)  # environments of a process share these arrays
        step = (self.times[-1] - self.times[0]) / (n - 1)
        grid = self.times[0] + step * np.arange(n)
        self.uniform = bool(np.abs(self.times - grid).max() <= 1e-12 * np.abs(self.times).max())

    @classmethod
    def straight(
        cls, start: Sequence[float], end: Sequence[float], std: float, *, num_steps: int, period: float
    ) -> ReferenceTrajectory:
        """Return a motion at constant speed from `start` (O,) to `end` (O,), with the standard deviation `std`.

        It has `num_steps` steps of `period` [s].
        """
        variance = np.tile(std**2 * np.eye(len(start)), (num_steps, 1, 1))
        return cls(period * np.arange(num_steps), np.linspace(start, end, num_steps), variance)

    @classmethod
    def from_demonstrations(
        cls,
        demonstrations: Demonstrations,
        components: int | None = None,
        seed: int = 0,
        floor: float | np.ndarray = 0.0,
        prior_std: float | Sequence[float] | np.ndarray | None = None,
        mixture_steps: int | None = None,
    ) -> ReferenceTrajectory:
        """Fit a Gaussian mixture of (time, output) and regress it on time (equation 2.12 and GMR).

        The covariance of a single demonstration only contains motions that the mixture averages out, such as a circling
        search. `prior_std` adds the variance that further demonstrations would have.

        Args:
            demonstrations: Demonstrations, resampled to one uniform clock of N steps if they do not have it already.
            components: Number of components C of the mixture; chosen by the Bayesian information criterion by default.
            seed: Seed of the mixture's initialization.
            floor: Standard deviation, (O,) or scalar, whose square is added to every variance [unit of the output]. If
                demonstrations differ by less than the resolution of a sensor or a controller, give this resolution.
            prior_std: Standard deviations (O,) of a single demonstration, a scalar, or rows as in `interpolate_prior`;
                required for one demonstration, refused for several.
            mixture_steps: Largest number of steps, evenly chosen, to which the mixture is fitted; all by default. It is
                regressed on all steps.

        Raises:
            InputError: If an argument is out of range, `prior_std` is missing or superfluous, or a covariance is
                singular.
        """
        number = demonstrations.num_demonstrations
        if prior_std is None and number == 1:
            raise InputError(
                "a single demonstration has no variance: give prior_std, the standard deviation of each output"
            )
        if prior_std is not None and number > 1:
            raise InputError(
                f"prior_std is for a single demonstration, and there are {number}, which have a variance of their own: "
                "leave prior_std out, or use one demonstration"
            )
        demonstrations = demonstrations.resampled()
        times, outputs = demonstrations.times[0], np.stack(demonstrations.outputs)
        floor, at = checked_floor(floor, outputs.shape[-1]), thinned(len(times), mixture_steps)
        means, covariances = regress(fit_mixture(times[at], outputs[:, at], components, seed), times)
        covariances = covariances + np.diag(floor**2)
        if prior_std is not None:
            covariances += np.eye(len(floor)) * (interpolate_prior(prior_std, len(times), len(floor)) ** 2)[:, None]
        return cls(times, means, covariances)

    @property
    def num_steps(self) -> int:
        """Number of steps N."""
        return len(self.times)

    @property
    def num_outputs(self) -> int:
        """Number of outputs O."""
        return self.means.shape[1]

    @property
    def standard_deviations(self) -> np.ndarray:
        """Standard deviations (N, O) [unit of the output]."""
        return np.sqrt(np.einsum("noo->no", self.covariances))

    def inputs(self, steps: np.ndarray) -> np.ndarray:
        """Return the times (n,) [s or phase] of steps (n,).

        The clock is extrapolated before the first and after the last step.
        """
        last = self.num_steps - 1
        inside = self.times[np.clip(steps, 0, last)]
        before = np.minimum(steps, 0) * (self.times[1] - self.times[0])
        after = np.maximum(steps - last, 0) * (self.times[-1] - self.times[-2])
        return inside + before + after

    def resampled(self, period: float) -> ReferenceTrajectory:
        """Return this trajectory with a `period` [s] between steps.

        Means and covariances are interpolated linearly over the clock. The new duration includes a mean time step after
        the last time. The number of steps is this duration divided by the period, rounded.

        Raises:
            InputError: If the period is not positive, or fewer than two or more than `MAX_STEPS` steps remain.
        """
        if not 0.0 < period < np.inf:
            raise InputError(f"a period must be positive, not {period} s")
        step = (self.times[-1] - self.times[0]) / (self.num_steps - 1)
        duration = self.num_steps * step
        number = num_periods(duration, period)
        clock = period * np.arange(number)
        nodes = np.arange(self.num_steps) if self.uniform else (self.times - self.times[0]) / step
        at = np.clip(clock / step, 0.0, self.num_steps - 1)
        columns = np.hstack([self.means, self.covariances.reshape(self.num_steps, -1)])
        resampled = np.column_stack([np.interp(at, nodes, column) for column in columns.T])
        outputs = self.num_outputs
        covariances = resampled[:, outputs:].reshape(number, outputs, outputs)
        return ReferenceTrajectory(self.times[0] + clock, resampled[:, :outputs], covariances)

    def _check_covariances(self) -> None:
        """Make the covariances exactly symmetric; raise an InputError if one is asymmetric or singular."""
        worst = find_asymmetric(self.covariances)
        if worst is not None:
            raise InputError(f"the covariance at step {worst} is not symmetric")
        self.covariances = (self.covariances + self.covariances.transpose(0, 2, 1)) / 2
        # Singularity is tested on correlations: outputs may have very different units.
        deviations = np.sqrt(np.maximum(np.einsum("noo->no", self.covariances), 0))
        singular = (deviations <= 0).any(axis=1)
        scaled = self.covariances / np.where(singular[:, None, None], 1, deviations[:, :, None] * deviations[:, None])
        singular |= np.linalg.eigvalsh(scaled)[:, 0] <= _SINGULAR
        if singular.any():
            raise InputError(
                f"the covariance at step {int(np.argmax(singular))} is singular or not positive definite; add a small "
                "variance to its diagonal (from_demonstrations has floor= for that)"
            )


def checked_floor(floor: float | np.ndarray, num_outputs: int) -> np.ndarray:
    """Return a floor of standard deviations (O,)."""
    checked = as_numbers(floor, "floor")
    if checked.shape not in ((), (1,), (num_outputs,)) or not (np.isfinite(checked) & (checked >= 0)).all():
        raise InputError(f"floor is one standard deviation, or {num_outputs}, none negative, not {checked}")
    return np.broadcast_to(checked, num_outputs)


def interpolate_prior(prior_std: float | Sequence[float] | np.ndarray, num_steps: int, num_outputs: int) -> np.ndarray:
    """Return the standard deviations (N, O) of a single demonstration over its steps [unit of the output].

    Args:
        prior_std: One number, O numbers, or rows of a phase and O numbers, concatenated. The phase is a fraction of the
            duration, from 0 to 1. Between two rows, the standard deviations are interpolated linearly.
        num_steps: Number of steps N.
        num_outputs: Number of outputs O.

    Raises:
        InputError: If a value is not a number, the number of values is wrong, phases do not increase or are not in
            [0, 1], or a standard deviation is not positive and finite.
    """
    numbers = np.ravel(as_numbers(prior_std, "prior_std"))
    size = 1 + num_outputs
    if len(numbers) in (1, num_outputs):
        rows = np.append(0.0, np.broadcast_to(numbers, num_outputs))[None]
    elif len(numbers) and len(numbers) % size == 0:
        rows = numbers.reshape(-1, size)
    else:
        raise InputError(
            f"prior_std is {num_outputs} standard deviations, or rows of a phase and {num_outputs} of them, not "
            f"{len(numbers)} numbers"
        )
    phases, deviations = rows[:, 0], rows[:, 1:]
    if not (np.isfinite(rows).all() and (deviations > 0).all()):
        raise InputError("prior_std is a standard deviation: give positive numbers")
    if phases[0] < 0 or phases[-1] > 1 or (np.diff(phases) <= 0).any():
        raise InputError(f"the phases of prior_std must increase and lie from 0 to 1, not {phases.tolist()}")
    at = np.linspace(0.0, 1.0, num_steps)
    return np.column_stack([np.interp(at, phases, column) for column in deviations.T])


def pass_through(reference: ReferenceTrajectory, points: Sequence[float], kernel: Kernel) -> ReferenceTrajectory:
    """Displace the mean of a reference so that it passes through via-points; the covariances do not change.

    The displacement is the mean of a Gaussian process, which is zero far from all via-points.

    Args:
        reference: Reference of the demonstrations.
        points: Step and output of each via-point, 1 + O numbers, concatenated.
        kernel: Covariance function of the process.

    Raises:
        InputError: If `points` are not rows of a step and O finite numbers, there is no such step, or `check_kernel`
            refuses the kernel.
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
    check_kernel(kernel, times)
    K = kernel(times[at], times[at]) + VIA_POINT_VARIANCE * np.eye(len(at))
    displacement = kernel(times, times[at]) @ np.linalg.solve(K, rows[:, 1:] - reference.means[at])
    return ReferenceTrajectory(times, reference.means + displacement, reference.covariances)
