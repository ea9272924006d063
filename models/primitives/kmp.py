"""Kernelized movement primitive for inputs of any dimension, with via-points (thesis, equations 2.17 and 2.18)."""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular

from guiderail.models.common.arrays import as_number, as_numbers, find_asymmetric
from guiderail.models.common.errors import InputError
from guiderail.models.primitives.features import KernelBasis
from guiderail.models.primitives.kernels import Kernel, SquaredExponential, check_kernel


@dataclass(frozen=True)
class _Point:
    input: np.ndarray
    mean: np.ndarray
    covariance: np.ndarray


class Kmp:
    """Kernelized movement primitive with E(ζ) = k*(K + λΣ)⁻¹μ and cov(ζ) = N/λ_c (k** − k*(K + λ_cΣ)⁻¹k*ᵀ).

    k* is the kernel between a query ζ and the N points, and k** the kernel at ζ itself. K, Σ and μ are the kernel, the
    covariances and the means of the points. N includes the via-points.

    `LcNsKmp` solves for a window of steps. This class uses the whole reference at once, for via-points and for
    primitives whose input is a state instead of time. The solution is stored as weights of the kernel's features, which
    are computed by a QR decomposition. The number of features is the numerical rank of K, which can be much smaller
    than N. The triangular factor of the reference is stored. When a via-point changes, only O rows per via-point are
    appended to this factor, unless a via-point far from the reference adds features.

    Args:
        inputs: Times or states, (N,) or (N, I).
        means: Means (N, O).
        covariances: Covariances (N, O, O), symmetric and positive definite.
        kernel: Kernel k; `SquaredExponential(length_scale=0.5)` by default.
        lambda_: λ, positive.
        covariance_lambda: λ_c, positive; λ by default.

    Raises:
        InputError: If λ or λ_c is out of range, a number is not finite, a covariance is not symmetric or not positive
            definite, or `check_kernel` refuses the kernel.
    """

    def __init__(
        self,
        inputs: np.ndarray,
        means: np.ndarray,
        covariances: np.ndarray,
        kernel: Kernel | None = None,
        lambda_: float = 1.0,
        covariance_lambda: float | None = None,
    ):
        inputs = _rows(inputs)
        means, covariances = as_numbers(means, "means"), as_numbers(covariances, "covariances")
        if not (np.isfinite(inputs).all() and np.isfinite(means).all()):
            raise InputError("a primitive's inputs and means must be finite: cut those samples out")
        for name, value in (("lambda_", lambda_), ("covariance_lambda", covariance_lambda)):
            if value is not None and not 0.0 < as_number(value, name) < np.inf:
                raise InputError(f"{name} must be positive, not {value}")
        self.num_inputs, self.num_outputs = inputs.shape[1], means.shape[1]
        self._reference = [
            _Point(x, m, _check_covariance(s, "reference")) for x, m, s in zip(inputs, means, covariances, strict=True)
        ]
        self._via: dict[int, _Point] = {}
        self._next_identifier = 0
        self._lambda, self._covariance_lambda = lambda_, covariance_lambda if covariance_lambda is not None else lambda_
        kernel = kernel if kernel is not None else SquaredExponential()
        check_kernel(kernel, inputs)
        self._basis = KernelBasis(kernel, inputs)
        self._factor_reference()

    def mean(self, inputs: np.ndarray) -> np.ndarray:
        """Compute means (n, O) at `inputs` (n,) or (n, I) (equation 2.17)."""
        F = self._basis.features(self._queries(inputs))
        return (F @ self._weights.reshape(-1, self.num_outputs)).reshape(-1, self.num_outputs)

    def covariance(self, inputs: np.ndarray) -> np.ndarray:
        """Compute covariances (n, O, O) at `inputs` (n,) or (n, I) (equation 2.18)."""
        queries = self._queries(inputs)
        F = self._basis.features(queries)
        unexplained = np.maximum(self._basis.residual(queries, F), 0)
        eye = np.eye(self.num_outputs)
        F_bar = np.einsum("nk,oi->noki", F, eye).reshape(len(queries) * self.num_outputs, -1)
        half = solve_triangular(self._covariance_triangle, F_bar.T, trans="T", check_finite=False)
        half = half.T.reshape(len(queries), self.num_outputs, -1)
        points = len(self._reference) + len(self._via)
        posterior = self._covariance_lambda * np.einsum("nor,nir->noi", half, half)
        return points / self._covariance_lambda * (posterior + unexplained[:, None, None] * eye)

    def add_via_point(self, input_: np.ndarray, mean: np.ndarray, covariance: np.ndarray) -> int:
        """Add a via-point.

        Args:
            input_: Input (I,).
            mean: Output (O,) that the motion passes through.
            covariance: Covariance (O, O) of that output, symmetric and positive definite.

        Returns:
            An identifier for `move_via_point` and `remove_via_point`.
        """
        identifier = self._next_identifier
        self._via[identifier] = self._check_point(input_, mean, covariance)
        self._next_identifier += 1
        self._factor_via_points()
        return identifier

    def move_via_point(self, identifier: int, input_: np.ndarray, mean: np.ndarray, covariance: np.ndarray) -> None:
        """Change input (I,), mean (O,) and covariance (O, O) of a via-point."""
        self._check_identifier(identifier)
        self._via[identifier] = self._check_point(input_, mean, covariance)
        self._factor_via_points()

    def remove_via_point(self, identifier: int) -> None:
        """Remove a via-point."""
        self._check_identifier(identifier)
        del self._via[identifier]
        self._factor_via_points()

    def _check_identifier(self, identifier: int) -> None:
        if identifier not in self._via:
            raise InputError(f"there is no via-point {identifier}: choose from {sorted(self._via)}")

    def _check_point(self, input_: np.ndarray, mean: np.ndarray, covariance: np.ndarray) -> _Point:
        point, mean = np.atleast_1d(as_numbers(input_, "a via-point's input")), as_numbers(mean, "a via-point's mean")
        if not (np.isfinite(point).all() and np.isfinite(mean).all()):
            raise InputError("a via-point must be finite")
        return _Point(point, mean, _check_covariance(as_numbers(covariance, "a covariance"), "via-point"))

    def _queries(self, inputs: np.ndarray) -> np.ndarray:
        queries = _rows(inputs)
        if not np.isfinite(queries).all():
            raise InputError("inputs must be finite")
        return queries

    def _factor_reference(self) -> None:
        size = self._basis.size * self.num_outputs
        prior = [np.sqrt(scale) * np.eye(size) for scale in (self._lambda, self._covariance_lambda)]
        zero = np.zeros(size)
        rows, targets = self._whitened(self._reference)
        self._base = _append(prior[0], zero, rows, targets)
        is_same = self._lambda == self._covariance_lambda
        self._covariance_base = self._base if is_same else _append(prior[1], zero, rows, targets)
        self._factor_via_points()

    def _factor_via_points(self) -> None:
        via = list(self._via.values())
        if via and self._basis.extend(np.array([point.input for point in via])):
            self._factor_reference()  # a via-point far from the reference adds features
            return
        rows, targets = self._whitened(via)
        triangle, right = _append(*self._base, rows, targets)
        self._weights = solve_triangular(triangle, right, check_finite=False)
        is_same = self._lambda == self._covariance_lambda
        self._covariance_triangle = triangle if is_same else _append(*self._covariance_base, rows, targets)[0]

    def _whitened(self, points: list[_Point]) -> tuple[np.ndarray, np.ndarray]:
        """Return rows Σ^(-1/2)(F ⊗ I) (n·O, r·O) and targets Σ^(-1/2) μ (n·O,)."""
        if not points:
            return np.zeros((0, self._basis.size * self.num_outputs)), np.zeros(0)
        F = self._basis.features(np.array([point.input for point in points]))
        whiten = np.linalg.inv(np.linalg.cholesky(np.array([point.covariance for point in points])))
        rows = np.einsum("nk,noi->noki", F, whiten).reshape(len(points) * self.num_outputs, -1)
        means = np.array([point.mean for point in points])
        return rows, np.einsum("noi,ni->no", whiten, means).ravel()


def _append(
    triangle: np.ndarray, right: np.ndarray, rows: np.ndarray, targets: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the triangular factor and right-hand side of a least-squares problem after rows are appended."""
    if not len(rows):
        return triangle, right
    stacked = np.vstack([np.column_stack([triangle, right]), np.column_stack([rows, targets])])
    factor = np.asarray(np.linalg.qr(stacked, mode="r"))
    size = triangle.shape[1]
    return factor[:size, :size], factor[:size, size]


def _rows(inputs: np.ndarray) -> np.ndarray:
    rows = as_numbers(inputs, "inputs")
    return rows.reshape(-1, 1) if rows.ndim < 2 else rows


def _check_covariance(covariance: np.ndarray, what: str) -> np.ndarray:
    if not np.isfinite(covariance).all():
        raise InputError(f"the {what}'s covariance must be finite")
    if find_asymmetric(covariance[None]) is not None:
        raise InputError(f"the {what}'s covariance is not symmetric")  # a Cholesky factorization reads only one half
    try:
        np.linalg.cholesky(covariance)
    except np.linalg.LinAlgError as error:
        raise InputError(f"the {what}'s covariance is not positive definite") from error
    return covariance
