"""The quadratic program of a constrained primitive in least-norm form, and who solves it.

Of the dual of equation 4.20, min ½αᵀHα − dᵀα with α ≥ 0 and H = ḠᵀSḠ, the Hessian is rank-deficient and badly scaled
(largest eigenvalue 6e-6 for a connector), which costs a first-order solver the very millimetres it is there to guard.
With S = L Lᵀ the same problem is min ½‖v‖² subject to Ḡᵀ(y + L v) ≥ C̄: an identity Hessian, and rows that can be scaled
to unit length, so that a solver's tolerance is one on the output itself.
"""

from collections.abc import Callable
from contextlib import suppress

import numpy as np

from guiderail.models.common.errors import InputError

OPENED = (1e-10, 1e-9)
"""Parts of the greatest correction that bounds are opened by, in turn, until a solver finds something between them."""

Solver = Callable[[np.ndarray, np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]


class UnsolvableError(RuntimeError):
    """No solution within the solver's tolerance: the caller must fall back to its last safe command."""


def _daqp(rows: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    import daqp

    size = rows.shape[1]
    problem = _identity(size), np.zeros(size), rows, upper, lower, np.zeros(len(rows), dtype=np.int32)
    # The tighter the tolerance the nearer a degenerate problem is to cycling: ask for less only then.
    for tolerance in (1e-12, 1e-10):
        v, _, flag, info = daqp.solve(*problem, primal_tol=tolerance)
        if flag >= 1:
            return v, info["lam"]
    raise UnsolvableError(f"DAQP ended with flag {flag}")


def _piqp(rows: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    try:
        import piqp
    except ImportError as error:
        raise InputError("the solver 'piqp' is not installed: pip install 'guiderail[piqp]'") from error
    size = rows.shape[1]
    solver = piqp.DenseSolver()
    solver.settings.verbose = False
    solver.settings.eps_abs = solver.settings.eps_rel = 1e-13
    solver.setup(_identity(size), np.zeros(size), None, None, rows, lower, upper, None, None)
    status = solver.solve()
    # Out of iterations it may still be good enough.
    inside = status.name == "PIQP_MAX_ITER_REACHED" and _is_inside(rows @ solver.result.x, lower, upper)
    if not (inside or status.name == "PIQP_SOLVED"):
        raise UnsolvableError(f"PIQP ended with {status.name}")
    return solver.result.x, solver.result.z_u - solver.result.z_l


def _osqp(rows: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    import osqp
    from scipy import sparse

    size = rows.shape[1]
    # A first-order solver meets a bound up to its tolerance: asked for a little more than the bound, it keeps it.
    margin = np.minimum(1e-8, (upper - lower) / 4)
    solver = osqp.OSQP()
    solver.setup(
        sparse.eye(size, format="csc"),
        np.zeros(size),
        sparse.csc_matrix(rows),
        lower + margin,
        upper - margin,
        verbose=False,
        eps_abs=1e-9,
        eps_rel=1e-9,
        polishing=True,
        max_iter=20_000,
    )
    result = solver.solve(raise_error=False)
    # Inaccurate, or out of iterations, it may still be good enough.
    solved = result.info.status_val == 1
    if not solved and not (result.info.status_val in (2, 7) and _is_inside(rows @ result.x, lower, upper)):
        raise UnsolvableError(f"OSQP ended with '{result.info.status}'")
    return result.x, result.y


def _is_inside(values: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> bool:
    """Nearly: whoever asked checks the command itself against the bound."""
    return bool((values >= lower - 1e-6).all() and (values <= upper + 1e-6).all())


SOLVERS: dict[str, Solver] = {"daqp": _daqp, "piqp": _piqp, "osqp": _osqp}


def find_solver(name: str) -> Solver:
    """The solver of that name.

    Raises:
        InputError: if there is none.
    """
    if name not in SOLVERS:
        raise InputError(f"there is no solver '{name}': choose one of {', '.join(SOLVERS)}")
    return SOLVERS[name]


def solve_least_norm(
    rows: np.ndarray, lower: np.ndarray, upper: np.ndarray, solver: Solver = _daqp
) -> tuple[np.ndarray, np.ndarray]:
    """min ½‖v‖² subject to lower ≤ rows v ≤ upper.

    Args:
        rows: (m, r), rows of unit length (or zero).
        lower, upper: (m,), ±inf where there is no bound; at least one of them excludes v = 0.
        solver: one of `SOLVERS`.

    Returns:
        v (r,), and the multipliers (m,): v = −rowsᵀ multipliers, positive where `upper` is active, negative where
        `lower` is.

    Raises:
        UnsolvableError: if the solver finds no solution.
    """
    # The problem is homogeneous: at unit scale the solver's absolute tolerance is a relative one.
    scale = max(lower.max(), -upper.min())
    lower, upper = lower / scale, upper / scale
    try:
        v, multipliers = solver(rows, lower, upper)
    except UnsolvableError:
        v, multipliers = _solve_opened(rows, lower, upper, solver)
    return scale * v, scale * multipliers


def _solve_opened(
    rows: np.ndarray, lower: np.ndarray, upper: np.ndarray, solver: Solver
) -> tuple[np.ndarray, np.ndarray]:
    """The same between bounds that are a little further apart.

    Many rows of bounds that leave a point and no room, as of an output that may not move, are equations to a solver
    that contradict each other in their last digits. Whoever asked checks what comes of it against the bounds.
    """
    *tried, last = OPENED
    for opened in tried:
        with suppress(UnsolvableError):
            return solver(rows, lower - opened, upper + opened)
    return solver(rows, lower - last, upper + last)


_identities: dict[int, np.ndarray] = {}


def _identity(size: int) -> np.ndarray:
    """A shared identity: a QP of every control step needs one, and making it costs as much as solving."""
    return _identities.setdefault(size, np.eye(size))
