"""Demonstrations that somebody corrected: their mean through further points, as smooth as the kernel.

Corrections are added to the mean, and constraints are still kept by whoever executes it: a point that is not allowed is
approached as far as it is.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from guiderail.models.errors import InputError
from guiderail.models.primitives.kernels import SquaredExponential
from guiderail.models.primitives.reference import ReferenceTrajectory

EXACTNESS = 1e-4  # variance of a via-point, as a part of the kernel's own: how far several that disagree are averaged


def through(reference: ReferenceTrajectory, points: Sequence[float], inverse_length: float) -> ReferenceTrajectory:
    """The reference with a mean that passes through via-points; its covariances stay.

    The displacement between via-points is the mean of a Gaussian process that is zero far from all of them.

    Args:
        reference: what was demonstrated.
        points: for each via-point its step and its output, 1 + O numbers, one after another.
        inverse_length: of the squared exponential kernel [1/input²].

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
    kernel, times = SquaredExponential(inverse_length), reference.times
    K = kernel(times[at], times[at]) + EXACTNESS * np.eye(len(at))
    displacement = kernel(times, times[at]) @ np.linalg.solve(K, rows[:, 1:] - reference.means[at])
    return ReferenceTrajectory(times, reference.means + displacement, reference.covariances)
