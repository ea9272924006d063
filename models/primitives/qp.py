"""Quadratic program of a constrained primitive in least-norm form.

In the dual of equation 4.20, min ½αᵀHα − dᵀα with α ≥ 0 and H = ḠᵀSḠ, the Hessian is rank-deficient and badly scaled
(largest eigenvalue 6e-6 for a connector): a first-order solver misses the bound by up to millimeters. With S = L Lᵀ and
the unconstrained window y, the same problem is min ½‖v‖² subject to Ḡᵀ(y + L v) ≥ C̄. Its Hessian is the identity. Its
constraints can be scaled to unit rows, so that a solver's tolerance is a tolerance on the output itself.

DAQP solves it an order of magnitude faster than PIQP and OSQP (`python -m research.benchmarks primitive`). The package
`qpsolvers` is not used: its constraints are one-sided, which doubles the rows (DAQP takes 1.8 times as long).
"""

from contextlib import suppress
from functools import cache

import numpy as np

RELAXATIONS = (0.0, 1e-10, 1e-9)
"""Relaxations of the bounds, tried in turn until the solver succeeds, relative to the largest required correction.

Equal lower and upper bounds, such as those of an output that must not move, are equations to a solver. Rounding errors
make many such equations contradict each other. The caller checks the result against the bounds.
"""


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


def solve_least_norm(rows: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Solve min ½‖v‖² subject to lower ≤ rows v ≤ upper.

    Args:
        rows: Constraint rows (m, r), of unit length (or zero).
        lower: Lower bounds (m,), −inf for none; at least one bound excludes v = 0.
        upper: Upper bounds (m,), inf for none.

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
            v, multipliers = _daqp(rows, lower - relaxation, upper + relaxation)
            return scale * v, scale * multipliers
    v, multipliers = _daqp(rows, lower - last, upper + last)
    return scale * v, scale * multipliers


_identity = cache(np.eye)  # shared: building one for each QP costs as much as solving it
