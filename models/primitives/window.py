"""One window of an LC-NS-KMP: explicit features of the kernel, factored optimization problem, and predictions.

`LcNsKmp` uses it. packages/cpp exports the maps of `StepFactor` (`arrays.py`) and solves with them (`primitive.hpp`).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import solve_triangular

from guiderail.models.common.arrays import as_numbers, find_asymmetric
from guiderail.models.common.errors import InputError
from guiderail.models.primitives.constraints import TOLERANCE
from guiderail.models.primitives.kernels import Kernel
from guiderail.models.primitives.qp import UnsolvableError, solve_least_norm

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


# Smallest singular value of the unit constraint rows, relative to the largest; smaller values are rounding errors.
_NEGLIGIBLE = 1e-13
_OPPOSITE = 4 * float(np.finfo(float).eps)  # largest entry of the sum of two unit rows that count as opposite


@dataclass(frozen=True)
class Window:
    """Reference and constraints G y ≥ c at the executed point, which is the first, and at the H points after it."""

    means: np.ndarray  # reference means (H+1, O)
    covariances: np.ndarray  # reference covariances (H+1, O, O), positive definite
    G: np.ndarray  # constraint matrices (H+1, F, O)
    c: np.ndarray  # right-hand sides of the constraints (H+1, F)

    @classmethod
    def checked(cls, means: ArrayLike, covariances: ArrayLike, G: np.ndarray, c: np.ndarray) -> "Window":
        """Return the window of given means and covariances.

        Raises:
            InputError: If means or covariances are not finite, their shape does not match the constraints, or a
                covariance is not symmetric.
        """
        means, covariances = as_numbers(means, "means"), as_numbers(covariances, "covariances")
        steps, _, outputs = G.shape
        if means.shape != (steps, outputs) or covariances.shape != (steps, outputs, outputs):
            raise InputError(
                f"means and covariances must have shapes {(steps, outputs)} and {(steps, outputs, outputs)}"
            )
        if not (np.isfinite(means).all() and np.isfinite(covariances).all()):
            raise InputError("means and covariances must be finite")
        worst = find_asymmetric(covariances)
        if worst is not None:  # a Cholesky factorization reads only one half
            raise InputError(f"the covariance of point {worst} of a window is not symmetric")
        return cls(means, covariances, G, c)


@dataclass(frozen=True)
class _Solution:
    """Solution of the unconstrained window as a function of x = [history, null-space action].

    The window is y = L (latent_mean + latent_map x) + direct_map history; a change δ of the latent vector adds L δ.
    """

    whiten: np.ndarray  # Σ^(-1/2), (H+1, O, O)
    Lw: np.ndarray  # Σ^(-1/2) L, ((H+1) O, rO)
    L: np.ndarray  # factor L of the posterior covariance L Lᵀ, ((H+1) O, rO)
    latent_mean: np.ndarray  # latent vector for x = 0, (rO,)
    latent_map: np.ndarray  # map from x to the latent vector, (rO, PO+O)
    direct_map: np.ndarray  # map from the history to the window, ((H+1) O, PO)

    def rows(self, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the map (n, PO+O) and the offset (n,) from x to the rows `at` of y."""
        map_ = self.L[at] @ self.latent_map
        map_[:, : self.direct_map.shape[1]] += self.direct_map[at]
        return map_, self.L[at] @ self.latent_mean


class StepFactor:
    """Factored problem 4.5 of the thesis for one window; its solution depends on x = [history, null-space action].

    With y = W̄h + F̄w for standard normal weights w, problem 4.5 is a regularized least-squares problem in w. The QR
    factor of this problem gives S = (Σ⁻¹ + ħK⁻¹)⁻¹ = L Lᵀ, with ħ = λ + β and K = F̄F̄ᵀ, without forming Σ⁻¹ or K⁻¹
    (equation 4.12 for weights). The window is affine in x. Only the maps from x to the executed point and to the
    constrained directions are stored; the rest of the window is computed again on request.

    Args:
        window: Reference and constraints.
        features: Features of the kernel at the window's inputs, conditioned on the history.
        lambda_: Regularization λ of problem 4.5.
        beta: Weight β of a null-space action.

    Attributes:
        output_map, output_offset: Map (O, PO+O) and offset (O,) from x to the executed point.
        constraint_map: Map (m, PO+O) from x to the constrained directions, each scaled so that a correction of norm one
            changes it by at most one.
        lower, upper: Bounds (m,) of the constrained directions, minus their offset and scaled in the same way.
        constraint_rows: Map (m, r) from a correction v to the constrained directions, rows of unit norm; a row is zero
            if no correction changes its direction. Set by `factor_corrections`.
        correction_map: Map (O, r) from a correction v to the executed point. Set by `factor_corrections`.
    """

    def __init__(self, window: Window, features: WindowFeatures, lambda_: float, beta: float):
        self._window, self._features, self._hbar, self._beta = window, features, lambda_ + beta, beta
        outputs = window.means.shape[1]
        solution = self._solve()
        self.output_map, self.output_offset = solution.rows(np.arange(outputs))
        self._factor_constraints(solution)

    def _solve(self) -> _Solution:
        steps, outputs = self._window.means.shape
        # Columns of F̄ = F ⊗ I are ordered (feature, output); rows (step, output).
        F, W = self._features.features, self._features.history_map
        rank, past = F.shape[1], W.shape[1]
        try:
            whiten = np.linalg.inv(np.linalg.cholesky(self._window.covariances))
        except np.linalg.LinAlgError as error:
            raise InputError("the covariances of a window must be positive definite: add a small variance") from error
        whitened = np.einsum("jk,joi->joki", F, whiten).reshape(steps * outputs, rank * outputs)
        R = np.linalg.qr(np.vstack([whitened, np.sqrt(self._hbar) * np.eye(rank * outputs)]), mode="r")
        eye = np.eye(outputs)
        F_bar = np.einsum("jk,oi->joki", F, eye).reshape(steps * outputs, rank * outputs)
        # L is computed from the features, because Σ^(1/2) Lw would lose digits where Σ is tiny.
        L = solve_triangular(R, F_bar.T, trans="T", check_finite=False).T
        Lw = solve_triangular(R, whitened.T, trans="T", check_finite=False).T
        # Data terms: L Lᵀ Σ⁻¹ μ of the means, and W̄ − L Lᵀ Σ⁻¹ W̄ of the history.
        whitened_means = np.einsum("joi,ji->jo", whiten, self._window.means).ravel()
        whitened_map = np.einsum("jp,joi->jopi", W, whiten).reshape(steps * outputs, past * outputs)
        return _Solution(
            whiten=whiten,
            Lw=Lw,
            L=L,
            latent_mean=Lw.T @ whitened_means,
            latent_map=np.concatenate([-Lw.T @ whitened_map, self._beta * L[:outputs].T], axis=1),
            direct_map=np.einsum("jp,oi->jopi", W, eye).reshape(steps * outputs, past * outputs),
        )

    _uncorrected: tuple[np.ndarray, np.ndarray] | None

    def _factor_constraints(self, solution: _Solution) -> None:
        window = self._window
        steps, outputs = window.means.shape
        self._directions, self._opposites = directions, opposites = _pair_opposites(window.G)
        D = window.G[:, directions].reshape(-1, outputs)
        lower, upper = window.c[:, directions], np.where(opposites >= 0, -window.c[:, opposites], np.inf)

        y_map, y_offset = solution.rows(np.arange(steps * outputs))
        at = np.repeat(np.arange(steps), len(directions))
        A = np.einsum("mo,mor->mr", D, solution.L.reshape(steps, outputs, -1)[at])
        size = np.linalg.norm(A, axis=1)
        self._scale = 1 / np.where(size > 0, size, 1)
        A = A * self._scale[:, None]
        offset = np.einsum("mo,mo->m", D, y_offset.reshape(steps, outputs)[at])
        self.lower, self.upper = ((bound.ravel() - offset) * self._scale for bound in (lower, upper))
        y_map = y_map.reshape(steps, outputs, -1)[at]
        self.constraint_map = np.ascontiguousarray(np.einsum("mo,mox,m->mx", D, y_map, self._scale))
        self._uncorrected = A, solution.L[:outputs]

    def factor_corrections(self) -> None:
        """Factor the corrections of the window, unless this was done; `correct` also calls it."""
        if self._uncorrected is None:
            return
        (A, L), self._uncorrected = self._uncorrected, None
        if len(A):
            U, s, Vt = np.linalg.svd(A, full_matrices=False)
            keep = s > _NEGLIGIBLE * s.max(initial=0.0)  # a kernel without features has no singular values
            self._basis = np.ascontiguousarray(Vt[keep].T)
            self.constraint_rows = np.ascontiguousarray(U[:, keep] * s[keep])
        else:
            self._basis, self.constraint_rows = np.zeros((A.shape[1], 0)), A[:, :0]
        self.correction_map = L @ self._basis

    def correct(self, free: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Compute the least-norm correction of a window, given its constrained directions `constraint_map @ x` (m,).

        Returns:
            The correction v (r,), which moves the executed point by `correction_map @ v`, and the multipliers (m,).

        Raises:
            UnsolvableError: If the solver finds no solution.
        """
        self.factor_corrections()
        lower, upper = self.lower - free, self.upper - free
        try:
            return solve_least_norm(self.constraint_rows, lower, upper)
        except UnsolvableError:
            # If a correction hardly moves the output, rounding errors can make the scaled bounds contradict each other.
            loose = 0.5 * TOLERANCE * self._scale
            return solve_least_norm(self.constraint_rows, lower - loose, upper + loose)

    def output_sizes(self) -> np.ndarray:
        """Return the largest displacement (O,) of the executed point by a correction of norm one."""
        return np.linalg.norm(self._solve().L[: self._window.means.shape[1]], axis=1)

    def multipliers(self, signed: np.ndarray) -> np.ndarray:
        """Return α (H+1, F) ≥ 0 for signed multipliers (m,), positive at an upper and negative at a lower bound."""
        signed = (signed * self._scale).reshape(-1, len(self._directions))
        alpha, has_opposite = np.zeros(self.multipliers_shape), self._opposites >= 0
        alpha[:, self._directions] = np.maximum(-signed, 0)
        alpha[:, self._opposites[has_opposite]] = np.maximum(signed[:, has_opposite], 0)
        return alpha

    def violation(self, output: np.ndarray) -> float:
        """Return max(c − G y) of an output (O,) at the executed point, which must have a constraint."""
        return float((self._window.c[0] - self._window.G[0] @ output).max())

    def trajectory(self, x: np.ndarray, v: np.ndarray | None) -> np.ndarray:
        """Return the whole window (H+1, O), corrected by v unless v is None."""
        solution = self._solve()
        latent = solution.latent_mean + solution.latent_map @ x
        if v is not None:
            latent = latent + self._basis @ v
        y = solution.L @ latent + solution.direct_map @ x[: solution.direct_map.shape[1]]
        return y.reshape(self._window.means.shape)

    def modified(self, x: np.ndarray, action: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
        """Compute the window under null-space actions at several points (equation 4.18, multipliers of 4.17).

        Args:
            x: History, and zeros in place of the null-space action (PO+O,); `action` replaces the null-space action.
            action: Actions interpolated to every point of the window, K̂ K̲⁻¹ ξ̂ given the history, (H+1, O).

        Returns:
            The window (H+1, O), and the solver's multipliers (m,) or None if every constraint is slack.

        Raises:
            UnsolvableError: If the solver finds no correction.
        """
        solution = self._solve()
        # β/ħ (K̂ − K A K̂) K̲⁻¹ ξ̂ with A = (K + ħΣ)⁻¹: the projection of the actions into the null space of the
        # demonstrations.
        whitened = np.einsum("joi,ji->jo", solution.whiten, action).ravel()
        projected = action - (solution.L @ (solution.Lw.T @ whitened)).reshape(action.shape)
        pull = self._beta / self._hbar * projected
        latent = solution.latent_mean + solution.latent_map @ x
        y = (solution.L @ latent + solution.direct_map @ x[: solution.direct_map.shape[1]]).reshape(action.shape) + pull
        along = np.einsum("jmo,jo->jm", self._window.G[:, self._directions], pull).ravel() * self._scale
        free = self.constraint_map @ x + along
        if (free >= self.lower).all() and (free <= self.upper).all():
            return y, None
        v, signed = self.correct(free)
        return y + (solution.L @ (self._basis @ v)).reshape(action.shape), signed

    def max_violation(self, trajectory: np.ndarray) -> float:
        """Return max(c − G y) over a whole window (H+1, O); −inf without constraints."""
        missing = self._window.c - np.einsum("nfo,no->nf", self._window.G, trajectory)
        return float(missing.max(initial=-np.inf))

    @property
    def multipliers_shape(self) -> tuple[int, int]:
        """Shape (H+1, F) of `multipliers`."""
        return self._window.c.shape

    @property
    def nbytes(self) -> int:
        """Memory of the stored arrays [bytes] except kernel features and constraints, which steps usually share."""
        arrays = (*vars(self).values(), self._window.means, self._window.covariances)
        return sum(value.nbytes for value in arrays if isinstance(value, np.ndarray))


def _pair_opposites(G: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pair the rows of G (n, F, O) that are opposite at every step, like the two sides of a box.

    The comparison has a tolerance, because normalization rounds rows of different scales differently.

    Returns:
        For each direction, the index of its row of G with the lower bound, and the index of the opposite row with the
        upper bound, −1 if there is none.
    """
    directions, opposites = [], []
    paired: set[int] = set()
    for f in range(G.shape[1]):
        if f in paired:
            continue
        opposite = next(
            (k for k in range(f + 1, G.shape[1]) if k not in paired and np.abs(G[:, k] + G[:, f]).max() <= _OPPOSITE),
            -1,
        )
        paired |= {f, opposite}
        directions.append(f)
        opposites.append(opposite)
    return np.array(directions, dtype=int), np.array(opposites, dtype=int)


@dataclass(slots=True, eq=False)
class Prediction:
    """Output of a primitive at one step.

    Attributes:
        output: Output to execute (O,).
        factor: Factored problem of the step's window.
        x: History and null-space action of the prediction ((P + 1) O,).
        correction: Smallest correction v (r,) with which the window satisfies the constraints; None if none is needed.
            It moves output i by at most ‖v‖ times `LcNsKmp.output_sizes`[i].
        signed_multipliers: Multipliers (m,) of `LcNsKmp.free_constraints`, positive at an upper and negative at a lower
            bound; None without a correction.
    """

    output: np.ndarray
    factor: StepFactor
    x: np.ndarray
    correction: np.ndarray | None = None
    signed_multipliers: np.ndarray | None = None

    @property
    def constrained(self) -> bool:
        """True if a constraint of the window is active."""
        return self.correction is not None

    @property
    def multipliers(self) -> np.ndarray:
        """Multipliers α (H+1, F) ≥ 0, zero where a constraint is slack; computed at each access."""
        if self.signed_multipliers is None:
            return np.zeros(self.factor.multipliers_shape)
        return self.factor.multipliers(self.signed_multipliers)

    @property
    def trajectory(self) -> np.ndarray:
        """Modified window (H+1, O); computed at each access."""
        return self.factor.trajectory(self.x, self.correction)


@dataclass(frozen=True)
class Modification:
    """Motion that is modified by null-space actions at several of its points.

    Attributes:
        trajectory: Outputs (N, O), within the constraints.
        multipliers: Multipliers α (N, F) ≥ 0, zero where a constraint is slack.
    """

    trajectory: np.ndarray
    multipliers: np.ndarray

    @property
    def constrained(self) -> bool:
        """True if a constraint is active."""
        return bool(self.multipliers.any())
