"""Modified trajectories match equations 4.17 and 4.18."""

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
from oracles.problems import random_problem

SEEDS = st.integers(0, 2**32 - 1)


def sample_steps(rng, first, horizon, max_steps=4):
    """Sample steps of a window in random order, at least 12 apart, so that the kernel matrix is regular."""
    candidates = np.arange(first, first + horizon + 1, 12)
    return rng.permutation(candidates)[: rng.integers(1, max_steps + 1)]


def check_window(problem, window, dense, constraints):
    """Check that a window equals the dense solution with the same multipliers and satisfies the KKT conditions."""
    scale = np.abs(problem.primitive.reference.means).max(axis=0)
    G, c = constraints
    assert window.multipliers.shape == c.shape
    assert (window.multipliers >= 0).all()
    difference = (window.trajectory - dense.corrected(G, window.multipliers)) / scale
    np.testing.assert_allclose(difference, 0, atol=1e-6 * max(1.0, np.abs(window.trajectory / scale).max()))
    slack = np.einsum("nfo,no->nf", G, window.trajectory) - c
    assert slack.min(initial=0.0) >= -1e-9
    if c.size:
        assert (window.multipliers * slack).max() <= 1e-7 * max(window.multipliers.max(), 1e-300)
    assert window.constrained == bool(window.multipliers.any())


@pytest.mark.parametrize("seed", range(3))
def test_modified_trajectory_solves_one_problem_over_all_steps(seed):
    problem = random_problem(seed, box=bool(seed % 2))
    p, rng = problem.primitive, np.random.default_rng(seed)
    problem.history = np.tile(p.reference.means[0], (p.history, 1)) if p.history else None
    last = p.num_steps - 1
    at = sample_steps(rng, 0, last)
    actions = np.outer(rng.standard_normal(len(at)), problem.action)
    result = p.modified_trajectory(at, actions, problem.history)
    constraints = p.constraints.window(np.arange(p.num_steps))
    check_window(problem, result, problem.dense(step=0, horizon=last, actions=actions, at=at), constraints)


def test_motion_with_one_action_equals_the_window_of_predict():
    p = make_primitive(horizon=39, history=3, history_variance=1e-4)
    past = p.reference.means[[0, 0, 0]]
    for action in (np.zeros(2), np.array([30.0, -5.0])):
        expected = p.predict(0, action, past).trajectory
        np.testing.assert_allclose(p.modified_trajectory([0], action, past).trajectory, expected, atol=1e-10)
    np.testing.assert_allclose(p.modified_trajectory([], [], past).trajectory, p.predict(0, None, past).trajectory)


def make_primitive(steps=40, deviation=0.1, **changes):
    t = 0.05 * np.arange(steps)
    means = np.column_stack([np.sin(t), t])
    reference = ReferenceTrajectory(t, means, np.tile(deviation**2 * np.eye(2), (steps, 1, 1)))
    return LcNsKmp(reference, **{"horizon": 15, **changes})


def test_actions_add_up_without_active_constraints():
    p = make_primitive(history=3, history_variance=1e-4)
    past = p.reference.means[[0, 0, 0]]
    a, b = np.array([30.0, -5.0]), np.array([-10.0, 20.0])
    without_action = p.modified_trajectory([10, 20], np.zeros((2, 2)), past).trajectory
    both = p.modified_trajectory([10, 20], [a, b], past).trajectory - without_action
    first = p.modified_trajectory([10, 20], [a, 0 * b], past).trajectory - without_action
    second = p.modified_trajectory([20, 10], [b, 0 * a], past).trajectory - without_action
    np.testing.assert_allclose(both, first + second, atol=1e-12)
    assert np.abs(first).max() > 1e-3


def test_actions_at_every_point_are_not_interpolated():
    """K̲ equals K and cancels: the result is β Σ A ξ̂, even if the actions are not smooth."""
    p = make_primitive(kernel=SquaredExponential(0.4))
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
    p = make_primitive(deviation=1e4, lambda_=0.06, beta=5.94)
    at, actions = [5, 18, 33], np.array([[1.0, 2.0], [-1.0, 0.5], [0.0, -2.0]])
    result = p.modified_trajectory(at, actions).trajectory[at]
    np.testing.assert_allclose(result, 0.99 * actions, atol=1e-3)
    p = make_primitive(deviation=1e-3)
    displacement = p.modified_trajectory(at, actions).trajectory - p.modified_trajectory([], []).trajectory
    assert np.abs(displacement).max() < 1e-3


@settings(max_examples=settings().max_examples // 2)  # an example takes 0.1 s
@given(SEEDS)
def test_modified_trajectory_satisfies_all_constraints(seed):
    """Bounds that differ between steps are satisfied with large actions at random steps."""
    rng = np.random.default_rng(seed)
    t = 0.05 * np.arange(40)
    means = np.column_stack([np.sin(t), t])
    width = 0.05 + 0.1 * rng.uniform() * (1 + np.sin(t + rng.uniform(0, 6)))[:, None]
    box = LinearConstraints.box(means - width, means + width)
    p = make_primitive(constraints=box)
    at = rng.permutation(np.arange(0, 40, 10))[: rng.integers(1, 5)]
    result = p.modified_trajectory(at, 10 ** rng.uniform(0, 4) * rng.standard_normal((len(at), 2)))
    assert (np.abs(result.trajectory - means) <= width + 1e-9).all()


def test_trajectory_outside_the_constraints_is_refused(monkeypatch):
    zero = lambda rows, lower, upper: (np.zeros(rows.shape[1]), np.zeros(len(rows)))  # noqa: E731
    monkeypatch.setattr("guiderail.models.primitives.window.solve_least_norm", zero)
    p = make_primitive(constraints=LinearConstraints.box([-np.inf, -np.inf], [0.5, np.inf]))
    with pytest.raises(UnsolvableError, match="violation"):
        p.modified_trajectory([20], [[0.0, 0.0]])


@pytest.mark.parametrize(
    ("at", "actions", "message"),
    [
        ([-1], [[1.0, 1.0]], "among 0 … 39"),
        ([40], [[1.0, 1.0]], "among 0 … 39"),
        ([10.5], [[1.0, 1.0]], "among 0 … 39"),
        ([np.nan], [[1.0, 1.0]], "among 0 … 39"),
        ([10], [[np.inf, 1.0]], "finite"),
        (np.arange(10, 25), np.ones((15, 2)), "cannot separate them"),
    ],
)
def test_modified_trajectory_refuses_invalid_actions(at, actions, message):
    with pytest.raises(InputError, match=message):
        make_primitive().modified_trajectory(at, actions)


@pytest.mark.parametrize(("history", "past"), [(2, None), (0, np.zeros((2, 2)))])
def test_modified_trajectory_refuses_another_history(history, past):
    with pytest.raises(InputError, match="history"):
        make_primitive(history=history).modified_trajectory([0], [[1.0, 1.0]], past)
