"""Solutions satisfy the KKT conditions of the quadratic program."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from guiderail.models.primitives import UnsolvableError
from guiderail.models.primitives.qp import _identity, solve_least_norm

VIOLATION = 1e-12  # largest violation of a bound, relative to the problem's size
DISTANCE = 1e-10  # largest distance of v from the optimum, relative to the problem's size


@st.composite
def problems(draw):
    """Draw rows of unit length with one-sided, two-sided and equal bounds, and a scale."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    size, rows = draw(st.integers(1, 8)), draw(st.integers(1, 8))
    A = rng.standard_normal((rows, size))
    A /= np.linalg.norm(A, axis=1)[:, None]
    inside = A @ rng.standard_normal(size)
    width = rng.choice([0.0, 0.1, 1.0], (2, rows)) if rows <= size else rng.uniform(0.01, 1.0, (2, rows))
    lower, upper = inside - width[0], inside + width[1]
    open_ = rng.uniform(size=rows)
    lower, upper = np.where(open_ < 0.3, -np.inf, lower), np.where(open_ > 0.7, np.inf, upper)
    if not (lower > 0).any() and not (upper < 0).any():
        lower[0], upper[0] = abs(inside[0]) + 0.1, np.inf  # otherwise v = 0 is the solution
        A[0] = np.eye(size)[0]
        lower[1:], upper[1:] = -np.inf, np.inf
    scale = draw(st.sampled_from([1.0, 1e-7, 1e5]))
    return A, scale * lower, scale * upper


@given(problem=problems())
def test_solution_satisfies_the_kkt_conditions(problem):
    A, lower, upper = problem
    size = max(lower.max(), -upper.min())
    v, multipliers = solve_least_norm(A, lower, upper)
    assert np.maximum(lower - A @ v, A @ v - upper).max() <= VIOLATION * size
    tolerance = 10 * DISTANCE * max(size, np.linalg.norm(v))
    # Stationarity is v = −Aᵀ multipliers. Multipliers are negative only at lower and positive only at upper bounds.
    np.testing.assert_allclose(v, -A.T @ multipliers, rtol=0, atol=100 * tolerance)
    pushes_up = multipliers < -100 * tolerance
    pushes_down = multipliers > 100 * tolerance
    assert ((A @ v - lower)[pushes_up] <= 100 * tolerance).all()
    assert ((upper - A @ v)[pushes_down] <= 100 * tolerance).all()
    assert pushes_up.any() or pushes_down.any() or np.linalg.norm(v) <= 1e4 * tolerance


def test_single_bound_is_met_by_the_shortest_correction():
    row = np.array([[0.6, 0.8]])
    for lower, upper, expected in ((2.0, np.inf, 2.0), (-np.inf, -3.0, -3.0), (2.0, 2.5, 2.0), (-9.0, -3.0, -3.0)):
        v, multipliers = solve_least_norm(row, np.array([lower]), np.array([upper]))
        np.testing.assert_allclose(v, expected * row[0], atol=1e-6)
        np.testing.assert_allclose(multipliers, [-expected], atol=1e-6)


@given(seed=st.integers(0, 2**32 - 1), gap=st.sampled_from([1e-3, 0.1, 10.0]))
def test_infeasible_problem_raises_unsolvable_error(seed, gap):
    rng = np.random.default_rng(seed)
    row = rng.standard_normal(4)
    row /= np.linalg.norm(row)
    # A direction whose lower bound exceeds its upper bound, or three directions that cannot all be positive.
    A, lower, upper = np.array([row, row]), np.array([gap, -np.inf]), np.array([np.inf, 0.0])
    if seed % 2:
        angles = np.array([0, 2, 4]) * np.pi / 3
        A = np.column_stack([np.cos(angles), np.sin(angles)])
        lower, upper = np.full(3, gap), np.full(3, np.inf)
    with pytest.raises(UnsolvableError, match="ended with"):
        solve_least_norm(A, lower, upper)


def test_solver_prints_nothing(capfd):
    solve_least_norm(np.eye(3), np.ones(3), np.full(3, 2.0))
    assert capfd.readouterr() == ("", "")


def test_daqp_solves_a_degenerate_problem_of_many_bounds():
    """A thousand nearly parallel rows are degenerate, like the constraints of a long horizon."""
    angles = np.linspace(0, 1e-4, 1000)
    A = np.column_stack([np.cos(angles), np.sin(angles)])
    v, _ = solve_least_norm(A, np.ones(1000), np.full(1000, np.inf))
    assert (A @ v >= 1 - 1e-12).all()
    assert np.linalg.norm(v) <= 1 + 1e-8


def test_identity_matrix_is_cached_for_each_size(monkeypatch):
    expected = _identity(3)
    monkeypatch.delattr(np, "eye")
    assert _identity(3) is expected
