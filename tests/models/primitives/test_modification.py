"""Modified windows and trajectories match the printed equations 4.17 and 4.18."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from guiderail.models.common.errors import InputError
from guiderail.models.primitives import (
    LcNsKmp,
    LinearConstraints,
    ReferenceTrajectory,
    SquaredExponential,
    UnsolvableError,
)
from guiderail.models.primitives.qp import SOLVERS
from oracles.problems import random_problem

SEEDS = st.integers(0, 2**32 - 1)


def spread(rng, first, horizon, most=4):
    """Sample steps of a window in any order, at least 12 apart: closer ones may make the kernel matrix singular."""
    places = np.arange(first, first + horizon + 1, 12)
    return rng.permutation(places)[: rng.integers(1, most + 1)]


def check(problem, found, expected, constraints):
    """Check that the window equals the dense one with the same multipliers and satisfies the KKT conditions."""
    scale = np.abs(problem.primitive.reference.means).max(axis=0)
    G, c = constraints
    assert found.multipliers.shape == c.shape
    assert (found.multipliers >= 0).all()
    difference = (found.trajectory - expected.corrected(G, found.multipliers)) / scale
    np.testing.assert_allclose(difference, 0, atol=1e-6 * max(1.0, np.abs(found.trajectory / scale).max()))
    slack = np.einsum("nfo,no->nf", G, found.trajectory) - c
    assert slack.min(initial=0.0) >= -1e-9
    if c.size:
        assert (found.multipliers * slack).max() <= 1e-7 * max(found.multipliers.max(), 1e-300)
    assert found.constrained == bool(found.multipliers.any())


@given(SEEDS)
def test_modified_window_matches_equation_4_18(seed):
    problem = random_problem(seed, box=bool(seed % 2))
    p, rng = problem.primitive, np.random.default_rng(seed)
    at = spread(rng, problem.step, p.horizon)
    actions = np.outer(rng.standard_normal(len(at)), problem.action)
    result = p.modified_window(problem.step, at, actions, problem.history)
    np.testing.assert_array_equal(result.steps, problem.step + np.arange(p.horizon + 1))
    check(problem, result, problem.dense(actions=actions, at=at), problem.constraints())


@pytest.mark.parametrize("seed", range(6))
def test_modified_trajectory_is_one_problem_over_all_steps(seed):
    problem = random_problem(seed, box=bool(seed % 2))
    p, rng = problem.primitive, np.random.default_rng(seed)
    problem.history = np.tile(p.reference.means[0], (p.history, 1)) if p.history else None
    last = p.num_steps - 1
    at = spread(rng, 0, last)
    actions = np.outer(rng.standard_normal(len(at)), problem.action)
    result = p.modified_trajectory(at, actions, problem.history)
    np.testing.assert_array_equal(result.steps, np.arange(p.num_steps))
    constraints = p.constraints.window(np.arange(p.num_steps))
    check(problem, result, problem.dense(step=0, horizon=last, actions=actions, at=at), constraints)


@given(SEEDS)
def test_modified_window_with_one_action_equals_predict(seed):
    problem = random_problem(seed)
    scale = np.abs(problem.primitive.reference.means).max(axis=0)
    one = problem.primitive.modified_window(problem.step, [problem.step], problem.action, problem.history)
    prediction = problem.solve()
    size = max(1.0, np.abs(prediction.trajectory / scale).max())
    np.testing.assert_allclose((one.trajectory - prediction.trajectory) / scale, 0, atol=1e-8 * size)
    assert one.constrained == prediction.constrained
    none = problem.primitive.modified_window(problem.step, [], np.zeros((0, len(scale))), problem.history)
    still = problem.primitive.predict(problem.step, None, problem.history)
    np.testing.assert_allclose((none.trajectory - still.trajectory) / scale, 0, atol=1e-12)


def plain(steps=40, deviation=0.1, **changes):
    t = 0.05 * np.arange(steps)
    means = np.column_stack([np.sin(t), t])
    reference = ReferenceTrajectory(t, means, np.tile(deviation**2 * np.eye(2), (steps, 1, 1)))
    return LcNsKmp(reference, **{"horizon": 15, **changes})


def test_modified_window_accepts_a_whole_number_of_any_type():
    p = plain()
    expected = p.modified_window(3, [4], [[1.0, 2.0]])
    for step in (3.0, np.int64(3)):
        result = p.modified_window(step, [4], [[1.0, 2.0]])
        np.testing.assert_array_equal(result.trajectory, expected.trajectory)
    for step in (-1, 2.5, np.nan):
        with pytest.raises(InputError):
            p.modified_window(step, [4], [[1.0, 2.0]])


def test_actions_add_up_without_active_constraints():
    p = plain(history=3, history_variance=1e-4)
    past = p.reference.means[7:10]
    a, b = np.array([30.0, -5.0]), np.array([-10.0, 20.0])
    still = p.modified_window(10, [10, 20], np.zeros((2, 2)), past).trajectory
    both = p.modified_window(10, [10, 20], [a, b], past).trajectory - still
    first = p.modified_window(10, [10, 20], [a, 0 * b], past).trajectory - still
    second = p.modified_window(10, [20, 10], [b, 0 * a], past).trajectory - still
    np.testing.assert_allclose(both, first + second, atol=1e-12)
    assert np.abs(first).max() > 1e-3


def test_actions_at_every_point_are_not_interpolated():
    """K̲ equals K and cancels: the result is β Σ A ξ̂, however rough the actions are."""
    p = plain(kernel=SquaredExponential(0.4))
    rng = np.random.default_rng(0)
    order = rng.permutation(40)
    actions = rng.standard_normal((40, 2))
    result = p.modified_trajectory(order, actions[order]).trajectory - p.modified_trajectory([], []).trajectory
    t = p.reference.times
    K, hbar, sigma = p.kernel(t, t), p.lambda_ + p.beta, 0.1**2
    expected = p.beta * sigma * np.linalg.solve(K + hbar * sigma * np.eye(40), actions)
    np.testing.assert_allclose(result, expected, atol=1e-10)


def test_motion_follows_actions_where_covariance_is_large():
    """The displacement approaches β/ħ of the action as the covariance grows."""
    p = plain(deviation=1e4, lambda_=0.06, beta=5.94)
    at, actions = [5, 18, 33], np.array([[1.0, 2.0], [-1.0, 0.5], [0.0, -2.0]])
    result = p.modified_trajectory(at, actions).trajectory[at]
    np.testing.assert_allclose(result, 0.99 * actions, atol=1e-3)
    narrow = plain(deviation=1e-3)
    moved = narrow.modified_trajectory(at, actions).trajectory - narrow.modified_trajectory([], []).trajectory
    assert np.abs(moved).max() < 1e-3


@settings(max_examples=settings().max_examples // 2)  # each takes a tenth of a second
@given(SEEDS)
def test_modified_trajectory_satisfies_all_constraints(seed):
    """Bounds that differ from step to step hold under extreme actions at any points."""
    rng = np.random.default_rng(seed)
    t = 0.05 * np.arange(40)
    means = np.column_stack([np.sin(t), t])
    width = 0.05 + 0.1 * rng.uniform() * (1 + np.sin(t + rng.uniform(0, 6)))[:, None]
    box = LinearConstraints.box(means - width, means + width)
    p = plain(constraints=box, solver="daqp")
    at = rng.permutation(np.arange(0, 40, 10))[: rng.integers(1, 5)]
    result = p.modified_trajectory(at, 10 ** rng.uniform(0, 4) * rng.standard_normal((len(at), 2)))
    assert (np.abs(result.trajectory - means) <= width + 1e-9).all()


def test_trajectory_outside_the_constraints_is_refused():
    SOLVERS["lazy"] = lambda rows, lower, upper: (np.zeros(rows.shape[1]), np.zeros(len(rows)))
    try:
        p = plain(constraints=LinearConstraints.box([-np.inf, -np.inf], [0.5, np.inf]), solver="lazy")
    finally:
        del SOLVERS["lazy"]
    with pytest.raises(UnsolvableError, match="violation"):
        p.modified_trajectory([20], [[0.0, 0.0]])
    with pytest.raises(UnsolvableError, match="violation"):
        p.modified_window(5, [5], [[0.0, 0.0]])
    p.predict(0)  # its own window is below the bound at the executed point


def test_window_past_the_end_is_the_last_one():
    p = plain()
    for step in (39, 45):
        result = p.modified_window(step, [39, 50], np.ones((2, 2)))
        assert result.steps.tolist() == list(range(39, 55))
        np.testing.assert_array_equal(result.trajectory, p.modified_window(39, [50, 39], np.ones((2, 2))).trajectory)


@pytest.mark.parametrize(
    ("at", "actions", "message"),
    [
        ([9], [[1.0, 1.0]], "among 10 … 25"),
        ([26], [[1.0, 1.0]], "among 10 … 25"),
        ([10.5], [[1.0, 1.0]], "among 10 … 25"),
        ([np.nan], [[1.0, 1.0]], "among 10 … 25"),
        ([[10]], [[1.0, 1.0]], "among 10 … 25"),
        (10, [[1.0, 1.0]], "among 10 … 25"),
        ([10, 10], [[1.0, 1.0]] * 2, "different steps"),
        ([10, 20], [[1.0, 1.0]], "shape"),
        ([10], [[1.0, 1.0, 1.0]], "shape"),
        ([10], [[np.inf, 1.0]], "finite"),
        ([10], [["a", "b"]], "numbers"),
        ([10], [[1j, 1.0]], "numbers"),
        (np.arange(10, 25), np.ones((15, 2)), "cannot separate them"),
    ],
)
def test_modified_window_refuses_invalid_actions(at, actions, message):
    with pytest.raises(InputError, match=message):
        plain().modified_window(10, at, actions)


def test_modified_window_refuses_invalid_history_and_step():
    with pytest.raises(InputError, match="history"):
        plain(history=2).modified_trajectory([0], [[1.0, 1.0]])
    with pytest.raises(InputError, match="no history"):
        plain().modified_window(0, [0], [[1.0, 1.0]], np.zeros((2, 2)))
    with pytest.raises(InputError, match="counts from 0"):
        plain().modified_window(-1, [0], [[1.0, 1.0]])
