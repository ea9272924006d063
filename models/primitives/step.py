"""One step of an LC-NS-KMP: everything that depends on the window alone, computed once."""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular

from guiderail.models.primitives.features import WindowFeatures
from guiderail.models.primitives.least_norm import Solver, solve_least_norm

# Directions of the constraint rows (of unit length) below this are rounding: they would only make the QP larger.
_NEGLIGIBLE = 1e-13


@dataclass(frozen=True)
class Window:
    """What is known about the executed point (the first) and the horizon behind it.

    Attributes:
        means: (H+1, O).
        covariances: (H+1, O, O), positive definite.
        G, c: (H+1, F, O) and (H+1, F), constraints G y ≥ c.
    """

    means: np.ndarray
    covariances: np.ndarray
    G: np.ndarray
    c: np.ndarray


class StepFactor:
    """The factored problem 4.5 of one window, in terms of x = [history, null-space action].

    With y = W̄h + F̄w for weights w of unit prior, problem 4.5 is a regularized least-squares problem in w; its QR
    factor gives S = (Σ⁻¹ + ħK⁻¹)⁻¹ = L Lᵀ directly, without ever forming Σ⁻¹ or K⁻¹ (equation 4.12, read in weights).
    The window is then linear in x, and the executed point and the constrained directions are rows of it.
    """

    def __init__(self, window: Window, features: WindowFeatures, lambda_: float, beta: float):
        self._means, self._features, self._hbar, self._beta = window.means, features, lambda_ + beta, beta
        steps, outputs = window.means.shape
        self._shape = (steps, outputs)

        # Columns of F̄ = F ⊗ I are ordered (feature, output); rows (step, output).
        chol = np.linalg.cholesky(window.covariances)
        chol_inv = np.linalg.inv(chol)
        F, W = features.features, features.history_map
        rank, past = F.shape[1], W.shape[1]
        whitened = np.einsum("jk,joi->joki", F, chol_inv).reshape(steps * outputs, rank * outputs)
        R = np.linalg.qr(np.vstack([whitened, np.sqrt(self._hbar) * np.eye(rank * outputs)]), mode="r")
        # Lw = Σ^(-1/2) L. L follows from the features, not from Σ^(1/2) Lw: the former is exact where Σ is tiny.
        F_bar = np.einsum("jk,oi->joki", F, np.eye(outputs)).reshape(steps * outputs, rank * outputs)
        L = solve_triangular(R, F_bar.T, trans="T", check_finite=False).T
        Lw = solve_triangular(R, whitened.T, trans="T", check_finite=False).T
        self._L = L

        # Data terms: weights of the mean, L Lᵀ Σ⁻¹ μ, and of the history, W̄ − L Lᵀ Σ⁻¹ W̄.
        whitened_means = np.einsum("joi,ji->jo", chol_inv, window.means).reshape(-1)
        whitened_map = np.einsum("jp,joi->jopi", W, chol_inv).reshape(steps * outputs, past * outputs)
        W_bar = np.einsum("jp,oi->jopi", W, np.eye(outputs)).reshape(steps * outputs, past * outputs)
        self._latent_mean = Lw.T @ whitened_means
        self._latent_map = np.concatenate([-Lw.T @ whitened_map, beta * L[:outputs].T], axis=1)
        self._direct_map = W_bar

        self.output_map, self.output_offset = self._rows(np.arange(outputs))
        self._build_constraints(window)

    def _rows(self, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The map (n, PO+O) and the offset (n,) that give these rows of the free window from x."""
        map_ = self._L[rows] @ self._latent_map
        map_[:, : self._direct_map.shape[1]] += self._direct_map[rows]
        return map_, self._L[rows] @ self._latent_mean

    def _build_constraints(self, window: Window) -> None:
        steps, outputs = self._shape
        num = window.G.shape[1]
        self._num_constraints = num
        self._rows_of_constraints = _pair_opposites(window.G)
        directions, first, second = self._rows_of_constraints
        D = window.G[:, directions].reshape(-1, outputs)
        at = np.repeat(np.arange(steps), len(directions))
        lower = np.where(first >= 0, window.c[:, first], -np.inf)
        upper = np.where(second >= 0, -window.c[:, second], np.inf)
        self.lower, self.upper = lower.reshape(-1), upper.reshape(-1)

        y_map, y_offset = self._rows(np.arange(steps * outputs))
        y_map, L = y_map.reshape(steps, outputs, -1), self._L.reshape(steps, outputs, -1)
        self.constraint_map = np.ascontiguousarray(np.einsum("mo,mox->mx", D, y_map[at]))
        offset = np.einsum("mo,mo->m", D, y_offset.reshape(steps, outputs)[at])
        self.lower, self.upper = self.lower - offset, self.upper - offset

        A = np.einsum("mo,mor->mr", D, L[at])
        size = np.linalg.norm(A, axis=1)
        self._scale = 1 / np.where(size > 0, size, 1)
        A = A * self._scale[:, None]
        if len(A):
            U, s, Vt = np.linalg.svd(A, full_matrices=False)
            keep = s > _NEGLIGIBLE * s[0] if s[0] > 0 else np.zeros(len(s), dtype=bool)
            self._basis = Vt[keep].T
            self.constraint_rows = np.ascontiguousarray(U[:, keep] * s[keep])
        else:
            self._basis, self.constraint_rows = np.zeros((A.shape[1], 0)), A[:, :0]
        self.correction_map = self._L[:outputs] @ self._basis

    def correct(self, free: np.ndarray, solver: Solver) -> tuple[np.ndarray, np.ndarray]:
        """The least-norm correction v of a window whose constrained directions come out as `free` (m,).

        Returns:
            v (r,), such that the executed point moves by `correction_map @ v`, and α (H+1, F) ≥ 0.

        Raises:
            UnsolvableError: if the solver finds none.
        """
        v, signed = solve_least_norm(
            self.constraint_rows, (self.lower - free) * self._scale, (self.upper - free) * self._scale, solver
        )
        return v, self._multipliers(signed * self._scale)

    def _multipliers(self, signed: np.ndarray) -> np.ndarray:
        steps, _ = self._shape
        directions, first, second = self._rows_of_constraints
        signed = signed.reshape(steps, len(directions))
        alpha = np.zeros((steps, self._num_constraints))
        alpha[:, first[first >= 0]] = np.maximum(-signed[:, first >= 0], 0)
        alpha[:, second[second >= 0]] = np.maximum(signed[:, second >= 0], 0)
        return alpha

    def trajectory(self, x: np.ndarray, v: np.ndarray | None) -> np.ndarray:
        """The whole window (H+1, O), corrected by v if given."""
        latent = self._latent_mean + self._latent_map @ x
        if v is not None:
            latent = latent + self._basis @ v
        y = self._L @ latent + self._direct_map @ x[: self._direct_map.shape[1]]
        return y.reshape(self._shape)

    @property
    def multipliers_shape(self) -> tuple[int, int]:
        """(H+1, F)."""
        return self._shape[0], self._num_constraints

    @property
    def nbytes(self) -> int:
        """What keeping this step costs [bytes]."""
        return sum(value.nbytes for value in vars(self).values() if isinstance(value, np.ndarray))


def _pair_opposites(G: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Which rows of G (n, F, O) are each other's negative at every step: a box then costs one row a side pair.

    Returns:
        For each direction: the row of G that it is, the row whose bound is its lower bound, and the row whose bound is
        its upper bound (−1: none).
    """
    directions, first, second = [], [], []
    taken: set[int] = set()
    for f in range(G.shape[1]):
        if f in taken:
            continue
        opposite = next(
            (k for k in range(f + 1, G.shape[1]) if k not in taken and np.array_equal(G[:, k], -G[:, f])), -1
        )
        taken |= {f, opposite}
        directions.append(f)
        first.append(f)
        second.append(opposite)
    return np.array(directions, dtype=int), np.array(first, dtype=int), np.array(second, dtype=int)
