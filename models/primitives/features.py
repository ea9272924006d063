"""Explicit features of a kernel, conditioned on a history."""

from dataclasses import dataclass

import numpy as np

from guiderail.models.common.errors import InputError
from guiderail.models.primitives.kernels import Kernel

# If the history's standard deviation √ρ is far below the kernel's, which is 1, conditioning loses digits in double
# precision. In extended precision sKGRL is accurate at ρ = 1e-10, for a millisecond more per trajectory.
_Extended = np.longdouble
# Smallest ratio of a point's variance, given the previous points, to its prior variance. Below this ratio, the point
# cannot have an action of its own.
_MIN_INDEPENDENCE = 1e-9


@dataclass(frozen=True)
class WindowFeatures:
    """Prior distribution of the outputs y_j in a window given the history h: y_j = W_j h + (F_j ⊗ I) w.

    The weights w are standard normal. W and F depend on the inputs of history and window, and not on any outputs.
    """

    history_map: np.ndarray  # W (H+1, P), the map from the history to the prior mean of the future
    features: np.ndarray  # F (H+1, r), where F Fᵀ is the kernel of the future given the history, of numerical rank r


def window_features(
    kernel: Kernel, history_inputs: np.ndarray, future_inputs: np.ndarray, history_noise: float
) -> WindowFeatures:
    """Condition the kernel on the history and factor the conditional kernel.

    The history's covariance is ρI for every output, so that all outputs share one P×P problem. The history is not part
    of the demonstrations' matrix, because a dense (K + ħΣ)⁻¹ of both would lose accuracy.

    Args:
        kernel: Kernel.
        history_inputs: Inputs of the history, (P,) or (P, I), possibly none.
        future_inputs: Inputs of the window, (H+1,) or (H+1, I).
        history_noise: ħρ with ħ = λ + β and the variance ρ of the history, positive if there is a history.
    """
    history_map, K = _conditioned(kernel, history_inputs, future_inputs, history_noise)
    return WindowFeatures(history_map.astype(float), _pivoted_cholesky(K).astype(float))


def window_interpolation(
    kernel: Kernel, history_inputs: np.ndarray, future_inputs: np.ndarray, history_noise: float, points: np.ndarray
) -> np.ndarray:
    """Compute the map (H+1, J) from actions at J different points of the window to all its points, given the history.

    The map is K̂ K̲⁻¹ (thesis, equation 4.17). K̂ is the kernel between the window and the J points, conditioned on the
    history. K̲ is the kernel between the J points, not conditioned. `points` (J,) are indices into the window; the other
    arguments are those of `window_features`.

    Raises:
        InputError: As `window_features`, or if points are so close to each other that K̲ is singular.
    """
    if len(points) == len(future_inputs) and not len(history_inputs):
        return np.eye(len(points))[:, points]  # actions at all points: nothing to interpolate
    _, K = _conditioned(kernel, history_inputs, future_inputs, history_noise)
    at = future_inputs[points].astype(_Extended)
    among = kernel(at, at)
    with np.errstate(invalid="ignore", divide="ignore"):  # a singular matrix is refused below
        L = _cholesky(among)
    if not (np.diagonal(L) ** 2 >= _MIN_INDEPENDENCE * np.diagonal(among)).all():
        raise InputError(
            "null-space actions are so close to each other that this kernel cannot separate them: leave some out, or, "
            "for a primitive without a history, give one at every point"
        )
    return _solve_lower(L[::-1, ::-1].T, _solve_lower(L, K[points])[::-1])[::-1].T.astype(float)


def _conditioned(
    kernel: Kernel, history_inputs: np.ndarray, future_inputs: np.ndarray, history_noise: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the map from the history to the future, and the kernel given the history, in extended precision."""
    past, future = history_inputs.astype(_Extended), future_inputs.astype(_Extended)
    K = kernel(future, future)
    history_map = np.zeros((len(future), len(past)), dtype=_Extended)
    if len(past):
        with np.errstate(invalid="ignore", divide="ignore"):  # a singular matrix is refused below
            L = _cholesky(kernel(past, past) + _Extended(history_noise) * np.eye(len(past), dtype=_Extended))
        if not (np.diagonal(L) > 0).all():
            raise InputError(
                f"the variance of a history of {len(past)} outputs is too small compared with rounding errors: raise "
                "history_variance, or shorten the history"
            )
        V = _solve_lower(L, kernel(past, future))
        history_map = _solve_lower(L[::-1, ::-1].T, V[::-1])[::-1].T
        K = K - V.T @ V
    return history_map, K


def _cholesky(A: np.ndarray) -> np.ndarray:
    """Compute the lower Cholesky factor in the precision of A (LAPACK is limited to double precision)."""
    L = np.zeros_like(A)
    for j in range(len(A)):
        column = A[j:, j] - L[j:, :j] @ L[j, :j]
        L[j:, j] = column / np.sqrt(column[0])
    return L


def _solve_lower(L: np.ndarray, B: np.ndarray) -> np.ndarray:
    """Compute L⁻¹ B by forward substitution, in the precision of the arguments."""
    X = np.array(B)
    for j in range(len(L)):
        X[j] = (X[j] - L[j, :j] @ X[:j]) / L[j, j]
    return X


def _pivoted_cholesky(A: np.ndarray) -> np.ndarray:
    """Compute F (n, r) with F Fᵀ = A up to rounding, pivoting on the largest remaining diagonal element."""
    residual = np.array(A.diagonal())
    tolerance = 10 * len(A) * np.finfo(A.dtype).eps
    columns: list[np.ndarray] = []
    for _ in range(len(A)):
        pivot = int(np.argmax(residual))
        if residual[pivot] <= tolerance:
            break
        F = np.array(columns)
        column = A[pivot] - (F[:, pivot] @ F if columns else 0)
        column = column / np.sqrt(residual[pivot])
        columns.append(column)
        residual = residual - column**2
        residual[pivot] = 0
    return np.array(columns, dtype=A.dtype).reshape(-1, len(A)).T
