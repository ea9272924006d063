"""Quadratic program of a constrained primitive in least-norm form, and its solvers.

In the dual of equation 4.20, min ½αᵀHα − dᵀα with α ≥ 0 and H = ḠᵀSḠ, the Hessian is rank-deficient and badly scaled
(largest eigenvalue 6e-6 for a connector): a first-order solver misses the bound by up to millimeters. With S = L Lᵀ and
the unconstrained window y, the same problem is min ½‖v‖² subject to Ḡᵀ(y + L v) ≥ C̄. Its Hessian is the identity. Its
constraints can be scaled to unit rows, so that a solver's tolerance is a tolerance on the output itself.

The package `qpsolvers` is not used. Its constraints are one-sided, which doubles the rows (DAQP takes 1.8 times as
long). It does not retry with another tolerance or a margin, and it does not check an inaccurate result.
"""

from collections.abc import Callable
from contextlib import suppress
from functools import cache

import numpy as np

from guiderail.models.common.errors import InputError, import_extra

RELAXATIONS = (0.0, 1e-10, 1e-9)
"""Relaxations of the bounds, tried in turn until the solver succeeds, relative to the largest required correction.

Equal lower and upper bounds, such as those of an output that must not move, are equations to a solver. Rounding errors
make many such equations contradict each other. The caller checks the result against the bounds.
"""

Solver = Callable[[np.ndarray, np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]


class UnsolvableError(RuntimeError):
    """Failure to find a solution within tolerance; the caller must repeat its last safe command."""


def _daqp(rows: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    import daqp

    size = rows.shape[1]
    problem = _identity(size), np.zeros(size), rows, upper, lower, np.zeros(len(rows), dtype=np.int32)
    # A degenerate problem can cycle at a tight tolerance: retry with a looser one.
    for tolerance in (1e-12, 1e-10):
        v, _, flag, info = daqp.solve(*problem, primal_tol=tolerance)
        if flag >= 1:
            return v, info["lam"]
    raise UnsolvableError(f"DAQP ended with flag {flag}")


def _piqp(rows: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    piqp = import_extra("piqp")
    size = rows.shape[1]
    solver = piqp.DenseSolver()
    solver.settings.verbose = False
    solver.settings.eps_abs = solver.settings.eps_rel = 1e-13
    solver.setup(_identity(size), np.zeros(size), None, None, rows, lower, upper, None, None)
    status = solver.solve()
    # A result at the iteration limit may still be accurate enough.
    inside = status.name == "PIQP_MAX_ITER_REACHED" and _is_inside(rows @ solver.result.x, lower, upper)
    if not (inside or status.name == "PIQP_SOLVED"):
        raise UnsolvableError(f"PIQP ended with {status.name}")
    return solver.result.x, solver.result.z_u - solver.result.z_l


def _osqp(rows: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    osqp = import_extra("osqp")
    from scipy import sparse

    size = rows.shape[1]
    # A first-order solver satisfies a bound up to its tolerance: with a margin it satisfies the bound itself.
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
    # An inaccurate result, or one at the iteration limit, may still be accurate enough.
    status = result.info.status_val
    if status != 1 and not (status in (2, 7) and _is_inside(rows @ result.x, lower, upper)):
        raise UnsolvableError(f"OSQP ended with '{result.info.status}'")
    return result.x, result.y


def _is_inside(values: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> bool:
    """Return True if values are within bounds up to 1e-6; the caller checks the command itself against the bounds."""
    return bool((values >= lower - 1e-6).all() and (values <= upper + 1e-6).all())


SOLVERS: dict[str, Solver] = {"daqp": _daqp, "piqp": _piqp, "osqp": _osqp}


def find_solver(name: str) -> Solver:
    """Return a solver by its name.

    Raises:
        InputError: If there is no such solver.
    """
    if name not in SOLVERS:
        raise InputError(f"there is no solver '{name}': choose one of {', '.join(SOLVERS)}")
    return SOLVERS[name]


def solve_least_norm(
    rows: np.ndarray, lower: np.ndarray, upper: np.ndarray, solver: Solver = _daqp
) -> tuple[np.ndarray, np.ndarray]:
    """Solve min ½‖v‖² subject to lower ≤ rows v ≤ upper.

    Args:
        rows: Constraint rows (m, r), of unit length (or zero).
        lower: Lower bounds (m,), −inf for none; at least one bound excludes v = 0.
        upper: Upper bounds (m,), inf for none.
        solver: One of `SOLVERS`.

    Returns:
        v (r,), and the multipliers (m,) with v = −rowsᵀ multipliers: positive at an active upper bound, negative at an
        active lower bound.

    Raises:
        UnsolvableError: If the solver finds no solution.
    """
    # The problem is homogeneous: at unit scale the solver's absolute tolerance is relative to the correction.
    scale = max(lower.max(), -upper.min())
    lower, upper = lower / scale, upper / scale
    *first, last = RELAXATIONS
    for relaxation in first:
        with suppress(UnsolvableError):
            v, multipliers = solver(rows, lower - relaxation, upper + relaxation)
            return scale * v, scale * multipliers
    v, multipliers = solver(rows, lower - last, upper + last)
    return scale * v, scale * multipliers


_identity = cache(np.eye)  # shared: building one for each QP costs as much as solving it
