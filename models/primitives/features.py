"""A kernel as explicit features, given what has already been visited."""

from dataclasses import dataclass

import numpy as np

from guiderail.models.primitives.kernels import Kernel

# The history is known to √ρ, the kernel to 1: their ratio is what a double loses digits to. Extended precision costs
# a millisecond here, once for a whole trajectory, and is what keeps sKGRL accurate at ρ = 1e-10.
_Extended = np.longdouble


@dataclass(frozen=True)
class WindowFeatures:
    """What a window's inputs alone determine: y_j = W_j h + (F_j ⊗ I) w, with weights w of unit prior.

    Attributes:
        history_map: W, (H+1, P): how the future follows the history when nothing else is known.
        features: F, (H+1, r): F Fᵀ is the kernel of the future given the history, r its numerical rank.
    """

    history_map: np.ndarray
    features: np.ndarray


def window_features(
    kernel: Kernel, history_inputs: np.ndarray, future_inputs: np.ndarray, history_noise: float
) -> WindowFeatures:
    """Conditions the kernel on the history, then factors what is left.

    The history's covariance is ρI, the same for every output, so that conditioning on it is one P×P problem for all
    outputs together, and it never meets the demonstrations' covariances in one matrix: that is where a dense
    (K + ħΣ)⁻¹ loses its accuracy.

    Args:
        kernel: k.
        history_inputs: (P,) or (P, I), may be empty.
        future_inputs: (H+1,) or (H+1, I).
        history_noise: ħρ, positive where there is a history.
    """
    past, future = history_inputs.astype(_Extended), future_inputs.astype(_Extended)
    K = kernel(future, future)
    history_map = np.zeros((len(future), len(past)), dtype=_Extended)
    if len(past):
        L = _cholesky(kernel(past, past) + _Extended(history_noise) * np.eye(len(past), dtype=_Extended))
        V = _solve_lower(L, kernel(past, future))
        history_map = _solve_lower(L[::-1, ::-1].T, V[::-1])[::-1].T
        K = K - V.T @ V
    return WindowFeatures(history_map.astype(float), _pivoted_cholesky(K).astype(float))


def _cholesky(A: np.ndarray) -> np.ndarray:
    """Lower Cholesky factor in the precision of A (LAPACK has none beyond double)."""
    L = np.zeros_like(A)
    for j in range(len(A)):
        column = A[j:, j] - L[j:, :j] @ L[j, :j]
        L[j:, j] = column / np.sqrt(column[0])
    return L


def _solve_lower(L: np.ndarray, B: np.ndarray) -> np.ndarray:
    """L⁻¹ B by forward substitution, in the precision of the arguments."""
    X = np.array(B)
    for j in range(len(L)):
        X[j] = (X[j] - L[j, :j] @ X[:j]) / L[j, j]
    return X


def _pivoted_cholesky(A: np.ndarray) -> np.ndarray:
    """F (n, r) with F Fᵀ = A up to rounding: the largest remaining diagonal first, until only rounding is left."""
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
