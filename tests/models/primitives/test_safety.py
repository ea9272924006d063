"""Commands are checked against the constraints, independently of the solver's status."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from guiderail.models.primitives import (
    LcNsKmp,
    LinearConstraints,
    Matern52,
    ReferenceTrajectory,
    SquaredExponential,
    UnsolvableError,
)
from guiderail.models.primitives import window as window_module
from guiderail.models.primitives.window import StepFactor, Window, window_features
from oracles.problems import random_problem

SEEDS = st.integers(0, 2**32 - 1)


def primitive(constraints, steps=30, deviation=0.1, **changes):
    """Return a primitive of two outputs near zero, with constraints that become active."""
    t = 0.02 * np.arange(steps)
    reference = ReferenceTrajectory(t, np.zeros((steps, 2)), np.tile(deviation**2 * np.eye(2), (steps, 1, 1)))
    return LcNsKmp(reference, **{"horizon": 8, "constraints": constraints, **changes})


UNIT_BOX = LinearConstraints.box([-1.0, -1.0], [1.0, 1.0])
SOLVE = window_module.solve_least_norm


@given(st.floats(0, 1) | st.sampled_from([0.5, 1 - 1e-6, 1 - 1e-8, 1 - 5e-9]), SEEDS)
def test_command_outside_the_constraints_is_refused(share, seed):
    """A command is refused if the solver returns only a share of the correction."""
    p, rng = primitive(UNIT_BOX), np.random.default_rng(seed)
    action = 1e4 * rng.uniform(0.5, 1, 2) * rng.choice([-1, 1], 2)
    violation = (1 - share) * (np.abs(primitive(None).predict(3, action).output).max() - 1)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            window_module, "solve_least_norm", lambda *problem: (share * SOLVE(*problem)[0], SOLVE(*problem)[1])
        )
        if violation > 1e-8:
            with pytest.raises(UnsolvableError, match="violation"):
                p.predict(3, action)
        else:
            try:
                output = p.predict(3, action).output
            except UnsolvableError:
                assert violation > 1e-10
            else:
                assert UNIT_BOX.violation(output) <= 1e-9


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_command_that_is_not_finite_is_refused(monkeypatch, value):
    solve = lambda rows, lower, upper: (np.full(rows.shape[1], value), np.zeros(len(rows)))  # noqa: E731
    monkeypatch.setattr(window_module, "solve_least_norm", solve)
    with pytest.raises(UnsolvableError), np.errstate(invalid="ignore"):
        primitive(UNIT_BOX).predict(3, np.array([1e5, 0.0]))


def test_infeasible_window_raises_unsolvable_error():
    """Constraints that demand a jump between two steps are infeasible for a smooth kernel."""
    lower, upper = np.full((30, 2), -1e3), np.full((30, 2), 1e3)
    lower[11], upper[12] = 500.0, -500.0
    p = primitive(LinearConstraints.box(lower, upper), kernel=SquaredExponential(np.sqrt(5e4)))
    with pytest.raises(UnsolvableError):
        p.predict(8, np.zeros(2))
    assert np.abs(p.predict(0, np.zeros(2)).output).max() < 1e-9
    assert np.abs(p.predict(20, np.zeros(2)).output).max() < 1e-9


@given(SEEDS)
def test_windows_between_parallel_planes_solve_problem_4_5(seed):
    """The window equals the dense solution with the same multipliers and satisfies the KKT conditions."""
    problem = random_problem(seed, box=True)
    scale = np.abs(problem.primitive.reference.means).max(axis=0)
    prediction = problem.solve()
    G, c = problem.constraints()
    alpha = prediction.multipliers
    assert alpha.shape == c.shape
    assert (alpha >= 0).all()
    expected = problem.dense().corrected(G, alpha)
    np.testing.assert_allclose((prediction.trajectory - expected) / scale, 0, atol=1e-7)
    slack = np.einsum("nfo,no->nf", G, prediction.trajectory) - c
    assert slack.min() >= -1e-8
    assert (alpha * slack).max() <= 1e-8 * max(alpha.max(), 1e-300)
    assert prediction.constrained == bool(alpha.any())
    np.testing.assert_allclose(prediction.output, prediction.trajectory[0], rtol=0, atol=1e-12)


def test_box_sides_have_separate_multipliers():
    for side in (0, 1):
        for sign, row in ((1.0, 2 * side + 1), (-1.0, 2 * side)):
            action = np.zeros(2)
            action[side] = sign * 1e4
            prediction = primitive(UNIT_BOX).predict(5, action)
            assert prediction.output[side] == pytest.approx(sign)
            assert prediction.multipliers[0, row] > 0
            assert prediction.multipliers[0, np.arange(4) != row].max() == 0


def test_repeated_and_opposite_constraints_are_satisfied():
    """Some rows are repeated, and some are opposite, at all or only at some of the steps."""
    G = np.array([[1.0, 0], [-1, 0], [-1, 0], [1, 0], [0, 1], [0, -1], [0.0, 0.0]])
    c = np.array([-0.4, -0.7, -0.3, -0.9, -0.5, -0.2, -1.0])
    for varying in (False, True):
        rows, bounds = np.tile(G, (30, 1, 1)), np.tile(c, (30, 1))
        if varying:
            rows[10, 1] = [-0.5, -0.5]
        constraints = LinearConstraints(rows, bounds) if varying else LinearConstraints(G, c)
        p = primitive(constraints)
        for action in 1e5 * np.array([[1, 1], [-1, 1], [1, -1], [-1, -1]]):
            output = p.predict(10, action).output
            assert (rows[10] @ output >= bounds[10] - 1e-9).all()
            assert np.abs(output).max() > 0.1


@given(SEEDS)
def test_command_scales_with_the_unit_of_the_outputs(seed):
    """In millimeters instead of meters, a command is 1000 times as large."""
    rng = np.random.default_rng(seed)
    t = 0.02 * np.arange(30)
    means = np.cumsum(0.01 * rng.standard_normal((30, 2)), axis=0)
    covariances = np.tile(0.01 * np.eye(2), (30, 1, 1))
    box = (means.min(axis=0) - 0.01, means.max(axis=0) + 0.01)
    action = 100 * rng.standard_normal(2)
    past = means[2:5]

    def output(unit):
        # λ and β scale with the inverse square of the output unit.
        p = LcNsKmp(
            ReferenceTrajectory(t, unit * means, unit**2 * covariances),
            lambda_=6 / unit**2,
            beta=6 / unit**2,
            horizon=8,
            history=3,
            history_variance=1e-6 * unit**2,
            constraints=LinearConstraints.box(unit * box[0], unit * box[1]),
        )
        return p.predict(5, unit * action, unit * past).output

    np.testing.assert_allclose(output(1000.0), 1000 * output(1.0), rtol=1e-6, atol=1e-6)


def test_bounds_may_leave_a_single_point():
    p = primitive(LinearConstraints.box([0.25, -1.0], [0.25, 1.0]), horizon=0)
    for action in (np.zeros(2), np.array([1e4, 1e4])):
        prediction = p.predict(4, action)
        assert prediction.output[0] == pytest.approx(0.25, abs=1e-9)
        assert prediction.constrained


def test_window_at_the_end_extrapolates_the_clock():
    """Steps past the end have the constraints and the mean of the last step."""
    steps = 30
    lower, upper = np.full((steps, 2), -1.0), np.full((steps, 2), 1.0)
    upper[-1] = -0.5
    p = primitive(LinearConstraints.box(lower, upper))
    for step in (29, 30, 1000):
        prediction = p.predict(step, np.array([1e4, 0.0]))
        assert prediction.output[0] == pytest.approx(-0.5, abs=1e-9)
        assert prediction.trajectory.shape == (9, 2)
        assert (prediction.trajectory <= -0.5 + 1e-9).all()
        np.testing.assert_array_equal(prediction.output, p.predict(29, np.array([1e4, 0.0])).output)
    assert p.predict(0, np.array([1e4, 0.0])).output[0] == pytest.approx(1.0, abs=1e-9)


def test_linear_response_equals_the_unconstrained_prediction():
    p = primitive(LinearConstraints.box([-1e3, -1e3], [1e3, 1e3]), history=3, history_variance=1e-4)
    rng = np.random.default_rng(0)
    past, action = 0.1 * rng.standard_normal((3, 2)), rng.standard_normal(2)
    for step in (0, 7, 29, 40):
        from_history, from_action, offset = p.linear_response(step)
        assert (from_history.shape, from_action.shape, offset.shape) == ((2, 6), (2, 2), (2,))
        expected = from_history @ past.ravel() + from_action @ action + offset
        np.testing.assert_allclose(p.predict(step, action, past).output, expected, rtol=0, atol=1e-13)


class NonstationaryKernel(SquaredExponential):
    """Squared-exponential kernel, scaled by its inputs."""

    stationary = False

    def __call__(self, a, b):
        return super().__call__(a, b) * np.multiply.outer(1 + a, 1 + b)


@pytest.mark.parametrize("kernel", [SquaredExponential(0.5), Matern52(0.5), NonstationaryKernel(2.0)])
@pytest.mark.parametrize("is_uniform", [True, False])
@pytest.mark.parametrize("history", [0, 3])
def test_features_are_those_of_the_inputs_of_each_window(kernel, is_uniform, history):
    """Before the first step the clock is extrapolated; only a uniform clock and a stationary kernel share features."""
    t = 0.1 * np.arange(12) if is_uniform else np.cumsum(np.linspace(0.05, 0.2, 12))
    means = np.column_stack([np.sin(t), np.cos(t)])
    reference = ReferenceTrajectory(t, means, np.tile(1e-2 * np.eye(2), (12, 1, 1)))
    assert reference.uniform == is_uniform
    p = LcNsKmp(reference, kernel, horizon=4, history=history, history_variance=1e-4)
    past, action = means[4 : 4 + history] + 0.05, np.ones(2)
    for step in (1, 7):
        at = np.arange(step, step + 5)
        before = reference.inputs(np.arange(step - history, step))
        features = window_features(kernel, before, reference.inputs(at), 12.0 * 1e-4)
        window = Window(means[at], reference.covariances[at], np.zeros((5, 0, 2)), np.zeros((5, 0)))
        factor = StepFactor(window, features, p.lambda_, p.beta)
        expected = factor.output_map @ np.concatenate([past.ravel(), action]) + factor.output_offset
        found = p.predict(step, action, past if history else None).output
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)


def test_cache_counts_bytes_and_drops_the_oldest(monkeypatch):
    unlimited = primitive(None)
    expected = unlimited.predict(0).output
    size, factor = unlimited.cached_bytes, unlimited._cache[0]
    names = "output_map output_offset constraint_map lower upper constraint_rows correction_map"
    arrays = [getattr(factor, name) for name in names.split()] + [factor._window.means, factor._window.covariances]
    assert size >= sum(array.nbytes for array in arrays)
    unlimited.predict(0)
    assert unlimited.cached_bytes == size
    for step in range(30):
        unlimited.linear_response(step)
    assert unlimited.cached_bytes == 30 * size
    for limit, kept in ((3 * size, [7, 8, 9]), (1, [9])):
        monkeypatch.setattr("guiderail.models.primitives.lc_ns_kmp._CACHE_BYTES", limit)
        p = primitive(None)
        for n in range(10):
            p.predict(n)
        assert list(p._cache) == kept
        np.testing.assert_array_equal(p.predict(0).output, expected)
