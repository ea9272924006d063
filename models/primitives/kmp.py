"""Kernelized movement primitive for inputs of any dimension, with via-points (thesis, equations 2.17 and 2.18)."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import cho_solve, solve_triangular

from guiderail.models.common.arrays import as_numbers, find_asymmetric
from guiderail.models.common.errors import InputError
from guiderail.models.primitives.kernels import Kernel, SquaredExponential, check_kernel


class Kmp:
    """Kernelized movement primitive with E(ζ) = k*(K + λΣ)⁻¹μ and cov(ζ) = N/λ (k** − k*(K + λΣ)⁻¹k*ᵀ).

    k* is the kernel between a query ζ and the N points, and k** the kernel at ζ itself. K, Σ and μ are the kernel, the
    covariances and the means of the points.

    `LcNsKmp` solves for a window of steps. This class uses the whole reference at once, for via-points and for
    primitives whose input is a state instead of time. Its factorization takes O((N O)³) time.

    Args:
        inputs: Times or states, (N,) or (N, I).
        means: Means (N, O).
        covariances: Covariances (N, O, O), symmetric and positive definite.
        kernel: Kernel k; `SquaredExponential(length_scale=0.5)` by default.
        lambda_: λ, positive.

    Raises:
        InputError: If λ is not positive, a number is not finite, a covariance is not symmetric or not positive
            definite, or `check_kernel` refuses the kernel.
    """

    def __init__(
        self,
        inputs: ArrayLike,
        means: ArrayLike,
        covariances: ArrayLike,
        kernel: Kernel | None = None,
        lambda_: float = 1.0,
    ):
        self._inputs, self._means = _rows(inputs), as_numbers(means, "means")
        self._covariances = as_numbers(covariances, "covariances")
        if not all(np.isfinite(values).all() for values in (self._means, self._covariances)):
            raise InputError("a primitive's means and covariances must be finite: cut those samples out")
        if not 0.0 < lambda_ < np.inf:
            raise InputError(f"lambda_ must be positive, not {lambda_}")
        self._kernel: Kernel = kernel if kernel is not None else SquaredExponential()
        self._lambda = lambda_
        check_kernel(self._kernel, self._inputs)
        if (worst := find_asymmetric(self._covariances)) is not None:  # a Cholesky factorization reads only one half
            raise InputError(f"the covariance of point {worst} is not symmetric")
        points, outputs = self._means.shape
        A = np.kron(self._kernel(self._inputs, self._inputs), np.eye(outputs))
        blocks, at = A.reshape(points, outputs, points, outputs), np.arange(points)
        blocks[at, :, at, :] += lambda_ * self._covariances
        try:
            np.linalg.cholesky(self._covariances)
            self._factor = np.linalg.cholesky(A)
        except np.linalg.LinAlgError as error:
            raise InputError("the covariances must be positive definite: add a small variance") from error
        self._weights = cho_solve((self._factor, True), self._means.ravel()).reshape(points, outputs)

    def mean(self, inputs: ArrayLike) -> np.ndarray:
        """Compute means (n, O) at `inputs` (n,) or (n, I) (equation 2.17)."""
        return self._kernel(_rows(inputs), self._inputs) @ self._weights

    def covariance(self, inputs: ArrayLike) -> np.ndarray:
        """Compute covariances (n, O, O) at `inputs` (n,) or (n, I) (equation 2.18)."""
        queries, (points, outputs) = _rows(inputs), self._means.shape
        k = np.kron(self._kernel(self._inputs, queries), np.eye(outputs))
        half = solve_triangular(self._factor, k, lower=True, check_finite=False).reshape(-1, len(queries), outputs)
        prior = np.array([self._kernel(query[None], query[None])[0, 0] for query in queries])
        explained = np.einsum("rno,rni->noi", half, half)
        return points / self._lambda * (prior[:, None, None] * np.eye(outputs) - explained)

    def through(self, input_: ArrayLike, mean: ArrayLike, covariance: ArrayLike) -> Kmp:
        """Return a primitive with one more point, such as a via-point with a small covariance.

        Args:
            input_: Input (I,).
            mean: Output (O,) that the motion passes through.
            covariance: Covariance (O, O) of that output, symmetric and positive definite.

        Raises:
            InputError: As the constructor.
        """
        return Kmp(
            np.concatenate([self._inputs, _rows(np.atleast_2d(as_numbers(input_, "a via-point's input")))]),
            np.vstack([self._means, as_numbers(mean, "a via-point's mean")]),
            np.concatenate([self._covariances, as_numbers(covariance, "a via-point's covariance")[None]]),
            self._kernel,
            self._lambda,
        )


def _rows(inputs: ArrayLike) -> np.ndarray:
    """Return inputs as rows (n, I), in their own memory; raise an InputError unless they are finite."""
    rows = as_numbers(inputs, "inputs")
    if not np.isfinite(rows).all():
        raise InputError("inputs must be finite")
    return rows.reshape(-1, 1) if rows.ndim < 2 else rows
