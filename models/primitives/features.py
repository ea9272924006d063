"""A kernel as explicit features, given what has already been visited."""

from dataclasses import dataclass

import numpy as np

from guiderail.models.common.errors import InputError
from guiderail.models.primitives.kernels import Kernel

# The history is known to √ρ, the kernel to 1: their ratio is what a double loses digits to. Extended precision costs
# a millisecond here, once for a whole trajectory, and is what keeps sKGRL accurate at ρ = 1e-10.
_Extended = np.longdouble
# A point of which the others leave less than this share of the kernel's variance can't be wished for on its own.
_TIED = 1e-9


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

    Raises:
        InputError: if that is too small for so long a history.
    """
    history_map, K = _conditioned(kernel, history_inputs, future_inputs, history_noise)
    return WindowFeatures(history_map.astype(float), _pivoted_cholesky(K).astype(float))


def window_interpolation(
    kernel: Kernel, history_inputs: np.ndarray, future_inputs: np.ndarray, history_noise: float, points: np.ndarray
) -> np.ndarray:
    """(H+1, J): what a wish at some of the future points means at all of them, given that the history stays.

    It is K̂ K̲⁻¹ of equation 4.17 with the history conditioned on. The kernel decides what is between the points.

    Args:
        kernel, history_inputs, future_inputs, history_noise: as in `window_features`.
        points: (J,), different indices of the future inputs.

    Raises:
        InputError: if points are so near to each other that the kernel ties them together, and K̲ is singular.
    """
    if len(points) == len(future_inputs) and not len(history_inputs):
        return np.eye(len(points))[:, points]  # wished for everywhere, nothing is in between
    _, K = _conditioned(kernel, history_inputs, future_inputs, history_noise)
    at = future_inputs[points].astype(_Extended)
    among = kernel(at, at)
    with np.errstate(invalid="ignore", divide="ignore"):  # of a singular matrix, which is refused
        L = _cholesky(among)
    if not (np.diagonal(L) ** 2 >= _TIED * np.diagonal(among)).all():
        raise InputError(
            "null-space actions are so near to each other that this kernel ties them together: leave some out, or "
            "give a primitive without a history one at every point"
        )
    return _solve_lower(L[::-1, ::-1].T, _solve_lower(L, K[points])[::-1])[::-1].T.astype(float)


def _conditioned(
    kernel: Kernel, history_inputs: np.ndarray, future_inputs: np.ndarray, history_noise: float
) -> tuple[np.ndarray, np.ndarray]:
    """The future's map from the history and its kernel given the history, both in extended precision."""
    past, future = history_inputs.astype(_Extended), future_inputs.astype(_Extended)
    K = kernel(future, future)
    history_map = np.zeros((len(future), len(past)), dtype=_Extended)
    if len(past):
        with np.errstate(invalid="ignore", divide="ignore"):  # of a singular matrix, which is refused
            L = _cholesky(kernel(past, past) + _Extended(history_noise) * np.eye(len(past), dtype=_Extended))
        if not (np.diagonal(L) > 0).all():
            raise InputError(
                f"a history of {len(past)} outputs is too long for so small a variance, as rounding hides it: raise "
                "history_variance, or shorten the history"
            )
        V = _solve_lower(L, kernel(past, future))
        history_map = _solve_lower(L[::-1, ::-1].T, V[::-1])[::-1].T
        K = K - V.T @ V
    return history_map, K


class KernelBasis:
    """Explicit features f(ζ) of a kernel, f(ζ)ᵀ f(ζ') = k(ζ, ζ'), on as few of its inputs as span the others."""

    def __init__(self, kernel: Kernel, inputs: np.ndarray):
        """
        Args:
            kernel: k.
            inputs: (N, I), which the features must represent to rounding.
        """
        self._kernel = kernel
        self._pivots = np.zeros((0, inputs.shape[1]))
        self._triangle = np.zeros((0, 0), dtype=_Extended)
        self.extend(inputs)

    @property
    def size(self) -> int:
        """r, the number of features."""
        return len(self._pivots)

    def features(self, inputs: np.ndarray) -> np.ndarray:
        """(n, r) at `inputs` (n, I)."""
        return self._extended_features(inputs).astype(float)

    def residual(self, inputs: np.ndarray, features: np.ndarray) -> np.ndarray:
        """k(ζ, ζ) − ‖f(ζ)‖² (n,): what the features don't see of inputs (n, I)."""
        prior = np.array([self._kernel(x[None], x[None])[0, 0] for x in inputs])
        return prior - (features**2).sum(axis=1)

    def extend(self, inputs: np.ndarray) -> bool:
        """Adds features until `inputs` (n, I) are represented; True if any were needed."""
        inputs = inputs.astype(_Extended)
        F = self._extended_features(inputs)
        residual = np.array([self._kernel(x[None], x[None])[0, 0] for x in inputs]) - (F**2).sum(axis=1)
        # Not to rounding, as in a window: a feature of size 1e-7 would multiply weights that no data determines.
        tolerance = 1e-15
        before = self.size
        while len(inputs) and residual.max() > tolerance:
            pivot = int(np.argmax(residual))
            column = (self._kernel(inputs, inputs[pivot : pivot + 1])[:, 0] - F @ F[pivot]) / np.sqrt(residual[pivot])
            grown = np.zeros((self.size + 1, self.size + 1), dtype=_Extended)
            grown[:-1, :-1], grown[-1, :-1], grown[-1, -1] = self._triangle, F[pivot], column[pivot]
            self._triangle = grown
            self._pivots = np.vstack([self._pivots, inputs[pivot].astype(float)])
            F = np.column_stack([F, column])
            residual = residual - column**2
            residual[pivot] = 0
        return self.size > before

    def _extended_features(self, inputs: np.ndarray) -> np.ndarray:
        pivots, inputs = self._pivots.astype(_Extended), inputs.astype(_Extended)
        if not len(pivots):
            return np.zeros((len(inputs), 0), dtype=_Extended)
        return _solve_lower(self._triangle, self._kernel(pivots, inputs)).T


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
