"""Distance of a primitive's motion from its demonstrations, which shows a wrong unit or regularization."""

import warnings

import numpy as np

from guiderail.models.common.errors import InputError
from guiderail.models.primitives.constraints import LinearConstraints
from guiderail.models.primitives.kernels import Kernel
from guiderail.models.primitives.reference import ReferenceTrajectory

MAX_DEVIATION = 10.0
"""Largest accepted RMS distance of a motion without actions from its demonstrations, in their standard deviations."""
MAX_MISS = 0.1
"""RMS distance relative to an output's range that is always accepted, because standard deviations may be tiny."""
MAX_OUTSIDE = 1.0
"""Violation of a constraint by a reference that is always accepted [unit of the output]."""
MAX_RANGES = 30.0
"""As `MAX_OUTSIDE`, relative to the largest range of an output; a wrong unit changes this ratio by factors of 1000."""
_EVALUATED = 16  # number of steps at which the deviation is measured


def measure_deviation(
    reference: ReferenceTrajectory, kernel: Kernel, lambda_: float, beta: float, horizon: int
) -> tuple[float, float]:
    """Compute the RMS distance of a primitive's motion from its reference mean, in two units.

    The motion is evaluated at a few steps, without actions, history and constraints. The arguments are those of
    `LcNsKmp`. λ and β depend on the unit of the outputs: values for meters are wrong for millimeters.

    Returns:
        The distance in standard deviations of the reference, and the largest distance of an output relative to the
        range of its mean.
    """
    steps = np.unique(np.linspace(0, reference.num_steps - 1, _EVALUATED).astype(int))
    errors = outputs_at(reference, kernel, lambda_ + beta, horizon, steps) - reference.means[steps]
    squared = squared_distances(reference.covariances[steps], errors) / reference.num_outputs
    sizes, ranges = np.sqrt(np.mean(np.square(errors), axis=0)), np.ptp(reference.means, axis=0)
    with np.errstate(divide="ignore"):
        miss = np.divide(sizes, ranges, out=np.zeros_like(sizes), where=sizes > 0.0)
    return float(np.sqrt(squared.mean())), float(miss.max())


def outputs_at(
    reference: ReferenceTrajectory, kernel: Kernel, hbar: float, horizon: int, steps: np.ndarray
) -> np.ndarray:
    """Compute the outputs (n, O) at `steps` (n,) without actions, history and constraints: k* (K + ħΣ)⁻¹ μ, ħ = λ + β.

    The window of a step begins at the step. `hbar` is ħ; the other arguments are those of `LcNsKmp`.
    """
    outputs, at = reference.num_outputs, np.arange(horizon + 1)
    window = np.minimum(steps[:, None] + at, reference.num_steps - 1)
    is_shared = kernel.stationary and reference.uniform
    inputs = [reference.inputs(at)] if is_shared else [reference.inputs(step + at) for step in steps.tolist()]
    K = np.stack([np.kron(kernel(x, x), np.eye(outputs)) for x in inputs])
    size = K.shape[1]
    A = np.tile(K, (len(steps) if is_shared else 1, 1, 1))
    blocks = A.reshape(len(steps), horizon + 1, outputs, horizon + 1, outputs)
    blocks[:, at, :, at, :] += hbar * reference.covariances[window].transpose(1, 0, 2, 3)
    means = reference.means[window].reshape(len(steps), size, 1)
    return (K[:, :outputs] @ np.linalg.solve(A, means))[:, :, 0]


def squared_distances(covariances: np.ndarray, errors: np.ndarray) -> np.ndarray:
    """Compute squared Mahalanobis distances (…, n) of errors (…, n, O) under covariances (n, O, O)."""
    whiten = np.linalg.inv(np.linalg.cholesky(covariances))
    return (np.einsum("nij,...nj->...ni", whiten, errors) ** 2).sum(axis=-1)


def describe_deviation(deviation: float, miss: float) -> str:
    """Return a message with the remedy for a deviation above one; the arguments are results of `measure_deviation`."""
    return (
        f"without actions the primitive is {deviation:.3g} standard deviations away from its demonstrations (RMS), and "
        f"{miss:.2g} of an output's range: check the unit of the outputs (defaults are for meters and seconds), or "
        "let guiderail dataset validate FILE --fit choose length_scale, lambda_ and beta"
    )


def check_deviation(
    reference: ReferenceTrajectory,
    kernel: Kernel,
    lambda_: float,
    beta: float,
    horizon: int,
    max_deviation: float = MAX_DEVIATION,
) -> float:
    """Return the deviation of `measure_deviation` [standard deviations], and warn if it exceeds one.

    The arguments are those of `measure_deviation`, and the largest accepted deviation.

    Raises:
        InputError: If the deviation exceeds `max_deviation` and the distance relative to the range exceeds `MAX_MISS`.
    """
    deviation, miss = measure_deviation(reference, kernel, lambda_, beta, horizon)
    if not deviation <= 1.0:
        advice = describe_deviation(deviation, miss)
        if not (deviation <= max_deviation or miss <= MAX_MISS):
            raise InputError(advice)
        warnings.warn(advice, UserWarning, stacklevel=3)
    return deviation


def check_constraints(
    reference: ReferenceTrajectory, constraints: LinearConstraints, max_deviation: float = MAX_DEVIATION
) -> None:
    """Check that a reference is not far outside of constraints, as happens if one of the two has a wrong unit.

    A reference at rest is accepted, because it has no range to compare with.

    Raises:
        InputError: If the mean of the reference violates a constraint by more than all of `MAX_OUTSIDE`,
            `max_deviation` (at least `MAX_DEVIATION`) standard deviations, and `MAX_RANGES` times the largest range of
            an output.
    """
    G, c = constraints.window(np.arange(reference.num_steps))
    outside = c - np.einsum("nfo,no->nf", G, reference.means)
    largest_range = float(np.ptp(reference.means, axis=0).max())
    if outside.max(initial=0.0) <= MAX_OUTSIDE or largest_range == 0.0:
        return
    deviations = np.sqrt(np.einsum("nfo,nop,nfp->nf", G, reference.covariances, G))
    least = max(MAX_OUTSIDE, MAX_RANGES * largest_range)
    is_far = outside > np.maximum(least, max(MAX_DEVIATION, max_deviation) * deviations)
    if is_far.any():
        step, row = np.unravel_index(int(np.argmax(np.where(is_far, outside, -np.inf))), outside.shape)
        raise InputError(
            f"the reference is {outside[step, row]:.3g} outside of constraint {row} at step {step}, and its means "
            f"extend over only {largest_range:.3g}: give both in one unit (defaults are for meters)"
        )
