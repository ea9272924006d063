"""A batch of predictions equals single predictions, and slack constraints are found on both sides of a bound."""

import numpy as np
import pytest

from guiderail.models.common.errors import InputError
from guiderail.models.primitives import LcNsKmp, LinearConstraints, ReferenceTrajectory, UnsolvableError

STEPS = 30


def primitive(history=4, outputs=3, upper=0.9):
    t = np.linspace(0.0, 1.0, STEPS)
    means = np.column_stack([np.sin((o + 1) * t) for o in range(outputs)])
    reference = ReferenceTrajectory(t, means, np.tile(0.01 * np.eye(outputs), (STEPS, 1, 1)))
    constraints = LinearConstraints.box(np.full(outputs, -0.2), np.full(outputs, upper)) if upper else None
    return LcNsKmp(reference, history=history, horizon=8, constraints=constraints)


def arguments(p, batch, scale=3.0, seed=0):
    """Return random steps, actions with the standard deviation `scale`, and histories near the reference."""
    rng = np.random.default_rng(seed)
    steps = rng.integers(0, STEPS + 5, batch)
    histories = np.array([p.reference.means[np.clip(np.arange(n - p.history, n), 0, STEPS - 1)] for n in steps])
    histories += 0.01 * rng.normal(size=histories.shape)
    return steps, scale * rng.normal(size=(batch, p.num_outputs)), histories if p.history else None


@pytest.mark.parametrize("history", [0, 4])
@pytest.mark.parametrize("upper", [None, 0.9])
def test_batch_equals_single_predictions(history, upper):
    p = primitive(history, upper=upper)
    steps, actions, histories = arguments(p, 300)
    batch = p.predict_batch(steps, actions, histories)
    for i, step in enumerate(steps):
        single = p.predict(step, actions[i], None if histories is None else histories[i])
        np.testing.assert_allclose(batch.outputs[i], single.output, rtol=0, atol=1e-12)
        assert batch.is_constrained[i] == single.constrained
    assert batch.is_solved.all()
    assert batch.is_constrained.any() == (upper is not None)


@pytest.mark.parametrize("history", [0, 4])
def test_large_batch_at_one_step_equals_single_predictions(history):
    p = primitive(history, upper=1.05)
    _, actions, histories = arguments(p, 1000, scale=300.0 if history else 30.0)
    batch = p.predict_batch(7, actions, histories)
    assert 0.05 < batch.is_constrained.mean() < 0.95
    for i in range(0, 1000, 13):
        single = p.predict(7, actions[i], None if histories is None else histories[i])
        np.testing.assert_allclose(batch.outputs[i], single.output, rtol=0, atol=1e-12)
        assert batch.is_constrained[i] == single.constrained


@pytest.mark.parametrize("distance", [1e-14, 1e-12, 1e-9, 1e-6, 1e-3])
def test_slack_is_found_in_double_precision_near_a_bound(distance):
    p = primitive()
    _, actions, histories = arguments(p, 600, scale=0.01)
    factor = p._factor(3)
    x, _ = p._stack_batch(3, actions, histories)
    free = x @ factor.constraint_map.T
    factor.upper[:] = np.inf
    factor.lower[:] = -np.inf
    factor.upper[4] = free[100, 4] + distance * max(1.0, abs(free[100, 4]))
    np.testing.assert_array_equal(factor.find_slack(x), (free <= factor.upper).all(axis=1))
    assert factor.find_slack(x)[100]
    factor.upper[4] = free[100, 4] - distance * max(1.0, abs(free[100, 4]))
    np.testing.assert_array_equal(factor.find_slack(x), (free <= factor.upper).all(axis=1))
    assert not factor.find_slack(x)[100]
    factor.lower[4], factor.upper[4] = factor.upper[4], np.inf
    np.testing.assert_array_equal(factor.find_slack(x), (free >= factor.lower).all(axis=1))


def test_values_beyond_single_precision_are_not_slack():
    p = primitive(history=0)
    actions = np.zeros((400, 3))
    actions[5] = 1e300
    assert not p._factor(0).find_slack(actions)[5]
    assert p._factor(0).find_slack(actions).sum() == 399


def test_every_output_of_a_batch_satisfies_the_constraints():
    p = primitive()
    steps, actions, histories = arguments(p, 400, scale=1e4)
    batch = p.predict_batch(steps, actions, histories)
    assert batch.is_constrained.mean() > 0.9
    assert max(p.constraints.violation(y) for y in batch.outputs) <= 1e-9


def test_only_the_unsolved_prediction_is_nan(monkeypatch):
    p = primitive(history=0)
    actions = np.array([[0.0, 0.0, 0.0], [1e4, 0.0, 0.0]])

    def fail(*_):
        raise UnsolvableError("no solution")

    monkeypatch.setattr("guiderail.models.primitives.window.solve_least_norm", fail)
    batch = p.predict_batch([2, 2], actions)
    np.testing.assert_array_equal(batch.is_solved, [True, False])
    assert np.isnan(batch.outputs[1]).all()
    np.testing.assert_allclose(batch.outputs[0], p.predict(2).output, atol=1e-12)


def test_actions_are_zero_and_steps_shared_by_default():
    p = primitive(history=0)
    np.testing.assert_allclose(p.predict_batch([0, 3]).outputs[1], p.predict(3).output, atol=1e-12)
    assert p.predict_batch(3, np.zeros((0, 3))).outputs.shape == (0, 3)


@pytest.mark.parametrize(
    ("steps", "actions", "histories", "message"),
    [
        ([-1], np.zeros((1, 3)), np.zeros((1, 4, 3)), "at least 0"),
        ([0.5], np.zeros((1, 3)), np.zeros((1, 4, 3)), "at least 0"),
        ([[0]], np.zeros((1, 3)), np.zeros((1, 4, 3)), "at least 0"),
        ([0], np.zeros((1, 3)), np.zeros((1, 3, 3)), r"shape \(1, 4, 3\)"),
        ([0], np.zeros((1, 3)), None, r"shape \(1, 4, 3\)"),
        ([0], np.full((1, 3), np.nan), np.zeros((1, 4, 3)), "finite"),
        ([0], np.zeros((1, 3)), np.full((1, 4, 3), np.inf), "finite"),
    ],
)
def test_predict_batch_refuses_invalid_arguments(steps, actions, histories, message):
    with pytest.raises(InputError, match=message):
        primitive().predict_batch(steps, actions, histories)


@pytest.mark.parametrize(("size", "is_accepted"), [(1e150, True), (1e155, False), (-1e300, False)])
def test_actions_are_refused_when_their_squares_overflow(size, is_accepted):
    p = primitive(upper=None)
    action, history = np.array([0.0, size, 0.0]), p.reference.means[:4]
    for predict in (
        lambda: p.predict(4, action, history).output,
        lambda: p.predict_batch([4, 4], np.array([np.zeros(3), action]), np.array([history] * 2)).outputs[1],
    ):
        if is_accepted:
            assert np.isfinite(predict()).all()
        else:
            with pytest.raises(InputError, match="must be finite, also when squared"):
                predict()


def test_history_is_refused_by_a_primitive_without_history():
    with pytest.raises(InputError, match="no history"):
        primitive(history=0).predict_batch([0], np.zeros((1, 3)), np.zeros((1, 4, 3)))
