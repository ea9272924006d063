"""Commands are checked against the constraints, independently of the solver's status."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from guiderail.models.common.errors import InputError
from guiderail.models.primitives import (
    LcNsKmp,
    LinearConstraints,
    Matern52,
    ReferenceTrajectory,
    SquaredExponential,
    UnsolvableError,
)
from guiderail.models.primitives.qp import SOLVERS
from oracles.problems import random_problem

SEEDS = st.integers(0, 2**32 - 1)


def primitive(constraints, steps=30, deviation=0.1, **changes):
    """Return a primitive of two outputs near zero, with constraints that become active."""
    t = 0.02 * np.arange(steps)
    reference = ReferenceTrajectory(t, np.zeros((steps, 2)), np.tile(deviation**2 * np.eye(2), (steps, 1, 1)))
    return LcNsKmp(reference, **{"horizon": 8, "constraints": constraints, **changes})


UNIT_BOX = LinearConstraints.box([-1.0, -1.0], [1.0, 1.0])


@given(st.floats(0, 1) | st.sampled_from([0.5, 1 - 1e-6, 1 - 1e-8, 1 - 5e-9]), SEEDS)
def test_command_outside_the_constraints_is_refused(share, seed):
    """A command is refused if the solver returns only a share of the correction."""

    def solve_partially(rows, lower, upper):
        v, multipliers = SOLVERS["daqp"](rows, lower, upper)
        return share * v, multipliers

    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(SOLVERS, "partial", solve_partially)
        p = primitive(UNIT_BOX, solver="partial")
    rng = np.random.default_rng(seed)
    action = 1e4 * rng.uniform(0.5, 1, 2) * rng.choice([-1, 1], 2)
    unconstrained = primitive(None).predict(3, action).output
    violation = (1 - share) * (np.abs(unconstrained).max() - 1)
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
    monkeypatch.setitem(SOLVERS, "not finite", solve)
    p = primitive(UNIT_BOX, solver="not finite")
    with pytest.raises(UnsolvableError), np.errstate(invalid="ignore"):
        p.predict(3, np.array([1e5, 0.0]))


@pytest.mark.parametrize("solver", SOLVERS)
def test_infeasible_window_raises_unsolvable_error(solver):
    """Constraints that demand a jump between two steps are infeasible for a smooth kernel."""
    lower, upper = np.full((30, 2), -1e3), np.full((30, 2), 1e3)
    lower[11], upper[12] = 500.0, -500.0
    p = primitive(LinearConstraints.box(lower, upper), kernel=SquaredExponential(np.sqrt(5e4)), solver=solver)
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


def test_features_differ_per_window_on_an_uneven_clock():
    """With an uneven clock or a nonstationary kernel, every window has its own features."""
    t = np.cumsum(np.linspace(0.01, 0.1, 30))
    means = np.column_stack([np.sin(t), np.cos(t)])
    reference = ReferenceTrajectory(t, means, np.tile(1e-4 * np.eye(2), (30, 1, 1)))
    assert not reference.uniform
    p = LcNsKmp(reference, horizon=5)
    in_order = [p.predict(n).output for n in (0, 20)]
    reordered = LcNsKmp(reference, horizon=5)
    np.testing.assert_array_equal([reordered.predict(n).output for n in (20, 0)][::-1], in_order)
    direct = p.predict_at(t[20:26], means[20:26], reference.covariances[20:26]).output
    np.testing.assert_allclose(in_order[1], direct, rtol=0, atol=1e-12)


class NonstationaryKernel(SquaredExponential):
    """Squared-exponential kernel, scaled by its inputs."""

    stationary = False

    def __call__(self, a, b):
        return super().__call__(a, b) * np.multiply.outer(1 + a, 1 + b)


def test_features_differ_per_window_for_nonstationary_kernels():
    t = 0.02 * np.arange(30)
    means = np.column_stack([np.sin(t), np.cos(t)])
    reference = ReferenceTrajectory(t, means, np.tile(1e-2 * np.eye(2), (30, 1, 1)))
    p = LcNsKmp(reference, NonstationaryKernel(2.0), horizon=5)
    p.predict(0)
    direct = p.predict_at(t[20:26], means[20:26], reference.covariances[20:26]).output
    np.testing.assert_allclose(p.predict(20).output, direct, rtol=0, atol=1e-12)


@pytest.mark.parametrize("kernel", [SquaredExponential(0.5), Matern52(0.5)])
def test_history_inputs_are_on_the_clock(kernel):
    """The result equals that of `predict_at` with the times of the history as inputs."""
    t = 0.1 * np.arange(12)
    means = np.column_stack([np.sin(t), np.cos(t)])
    covariances = np.tile(1e-2 * np.eye(2), (12, 1, 1))
    p = LcNsKmp(ReferenceTrajectory(t, means, covariances), kernel, horizon=4, history=3, history_variance=1e-4)
    past = means[4:7] + 0.05
    direct = p.predict_at(t[7:12], means[7:12], covariances[7:12], np.ones(2), past, t[4:7])
    prediction = p.predict(7, np.ones(2), past)
    np.testing.assert_allclose(prediction.output, direct.output, rtol=0, atol=1e-12)
    # Before the first step the clock is extrapolated.
    early = p.predict(1, np.ones(2), past).output
    direct = p.predict_at(t[1:6], means[1:6], covariances[1:6], np.ones(2), past, np.array([-0.2, -0.1, 0.0])).output
    np.testing.assert_allclose(early, direct, rtol=0, atol=1e-12)


def test_predict_at_refuses_invalid_arguments():
    p = primitive(UNIT_BOX)
    t, means, covariances = np.linspace(0, 1, 4), np.zeros((4, 2)), np.tile(np.eye(2), (4, 1, 1))
    p.predict_at(t, means, covariances)
    for inputs, m, s, message in (
        (t, means, covariances * np.nan, "finite"),
        (t, means + np.inf, covariances, "finite"),
        (t * np.nan, means, covariances, "finite"),
    ):
        with pytest.raises(InputError, match=message):
            p.predict_at(inputs, m, s)
    stepwise = primitive(LinearConstraints.box(np.full((30, 2), -1.0), np.full((30, 2), 1.0)))
    with pytest.raises(InputError, match="need a clock"):
        stepwise.predict_at(t, means, covariances)


def test_linear_response_equals_the_unconstrained_prediction():
    p = primitive(LinearConstraints.box([-1e3, -1e3], [1e3, 1e3]), history=3, history_variance=1e-4)
    rng = np.random.default_rng(0)
    past, action = 0.1 * rng.standard_normal((3, 2)), rng.standard_normal(2)
    for step in (0, 7, 29, 40):
        from_history, from_action, offset = p.linear_response(step)
        assert (from_history.shape, from_action.shape, offset.shape) == ((2, 6), (2, 2), (2,))
        expected = from_history @ past.ravel() + from_action @ action + offset
        np.testing.assert_allclose(p.predict(step, action, past).output, expected, rtol=0, atol=1e-13)


def test_cache_counts_bytes_and_drops_the_oldest():
    unlimited = primitive(None)
    unlimited.predict(0)
    size = unlimited.cached_bytes
    factor = unlimited._cache[0]
    names = "output_map output_offset constraint_map lower upper constraint_rows correction_map"
    arrays = [getattr(factor, name) for name in names.split()] + [factor._window.means, factor._window.covariances]
    assert size >= sum(array.nbytes for array in arrays)
    unlimited.predict(0)
    assert unlimited.cached_bytes == size
    p = primitive(None, cache_bytes=3 * size)
    for n in range(10):
        p.predict(n)
        assert p.cached_bytes <= 3 * size
    assert list(p._cache) == [7, 8, 9]
    assert p.cached_bytes == 3 * size
    tiny = primitive(None, cache_bytes=1)
    tiny.predict(0)
    tiny.predict(1)
    assert list(tiny._cache) == [1]
    assert unlimited.factor_all() == 30 * size
