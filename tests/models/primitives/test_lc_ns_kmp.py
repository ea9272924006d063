"""LcNsKmp solves problem 4.5 and refuses invalid arguments."""

import gc
import warnings
from functools import cache
from pathlib import Path

import numpy as np
import piqp
import pytest

from guiderail.models.common.errors import InputError
from guiderail.models.primitives import (
    Demonstrations,
    LcNsKmp,
    LinearConstraints,
    Matern52,
    ReferenceTrajectory,
    SquaredExponential,
    pose_demonstrations,
)
from guiderail.models.primitives.deviation import MAX_DEVIATION, MAX_MISS, measure_deviation, outputs_at
from guiderail.models.primitives.lc_ns_kmp import get_shared_primitive
from oracles.dense import Extended
from oracles.problems import Problem, random_problem

REAL_DATA = Path(__file__).parents[4] / "shared" / "data" / "dlr_sara_ring_loading.npz"


def scale_of(problem):
    return np.abs(problem.primitive.reference.means).max(axis=0)


def relative_error(problem, prediction, dense) -> float:
    """Return the largest difference from the dense window at the same multipliers, in scales of the outputs."""
    G, _ = problem.constraints()
    expected = dense.corrected(G, prediction.multipliers)
    return float((np.abs(prediction.trajectory - expected) / scale_of(problem)).max())


def kkt_residual(problem, prediction) -> float:
    """Return the largest violation, negative multiplier, or product of a relative multiplier and its slack."""
    G, c = problem.constraints()
    if not c.size:
        return 0.0
    alpha = prediction.multipliers
    slack = np.einsum("nfo,no->nf", G, prediction.trajectory) - c
    largest = max(float(alpha.max()), 1e-300)
    return max(float((-slack).max()), float((-alpha).max()) / largest, float((alpha * slack).max()) / largest)


@pytest.mark.parametrize("seed", range(15))
def test_predict_solves_problem_4_5(seed):
    problem = random_problem(seed)
    prediction = problem.solve()
    assert relative_error(problem, prediction, problem.dense()) < 1e-8
    assert kkt_residual(problem, prediction) < 1e-8
    np.testing.assert_allclose(prediction.output, prediction.trajectory[0], rtol=0, atol=1e-12)


@pytest.mark.parametrize("seed", range(8))
def test_predict_is_at_least_as_accurate_as_dense_cholesky(seed):
    problem = random_problem(seed, history_variance=1e-8, history_noise=1e-3)
    prediction = problem.solve()
    dense = problem.dense()
    error = relative_error(problem, prediction, dense)
    assert error < 1e-5
    assert kkt_residual(problem, prediction) < 1e-8
    G, _ = problem.constraints()
    in_doubles = problem.dense(np.float64).corrected(G, prediction.multipliers)
    exact = dense.corrected(G, prediction.multipliers)
    assert error <= max(float((np.abs(in_doubles - exact) / scale_of(problem)).max()), 1e-12)


@pytest.mark.parametrize("seed", range(6))
def test_predict_agrees_with_a_qp_over_kernel_weights(seed):
    """Solve problem 4.5 directly, over weights of the kernel's features, by an interior-point method.

    With a short length scale the kernel matrix is well conditioned: a solver in doubles is accurate to 1e-8.
    """
    problem = random_problem(seed, history_variance=1e-2, length_scale=np.sqrt(0.5 / 1500))
    p, P, num_outputs = problem.primitive, problem.primitive.history, problem.primitive.num_outputs
    n, H = problem.step, p.horizon
    t = p.reference.inputs(np.arange(n - P, n + H + 1))
    indices = np.minimum(np.arange(n, n + H + 1), p.num_steps - 1)
    scale = scale_of(problem)
    means = p.reference.means[indices] / scale
    weights = np.linalg.inv(p.reference.covariances[indices] / (scale[:, None] * scale))
    if P:
        means = np.vstack([problem.history / scale, means])
        weights = np.concatenate([np.tile(np.diag(scale**2) / p.history_variance, (P, 1, 1)), weights])
    Phi = np.kron(np.linalg.cholesky(p.kernel(t, t)), np.eye(num_outputs))
    blocks = np.zeros((len(t) * num_outputs, len(t) * num_outputs))
    for i, block in enumerate(weights):
        blocks[i * num_outputs : (i + 1) * num_outputs, i * num_outputs : (i + 1) * num_outputs] = block
    executed = Phi[P * num_outputs : (P + 1) * num_outputs]
    # Dividing an output by its scale s multiplies its terms λ/2 ‖w‖² and β/2 ‖w − φ ξ̂‖² by s².
    quadratic = Phi.T @ blocks @ Phi + (p.lambda_ + p.beta) * np.diag(np.tile(scale**2, len(t)))
    linear = -(Phi.T @ blocks @ means.ravel() + p.beta * executed.T @ (problem.action * scale))
    G, c = problem.constraints()
    rows = np.einsum("nfo,nox->nfx", G * scale, Phi[P * num_outputs :].reshape(H + 1, num_outputs, -1)).reshape(
        -1, Phi.shape[1]
    )
    # With the unconstrained minimum as origin and the Hessian as unit matrix, the problem is well scaled.
    free = np.linalg.solve(quadratic, -linear)
    unit = np.linalg.inv(np.linalg.cholesky(quadratic)).T
    rows, bounds = rows @ unit, c.ravel() - rows @ free
    size = np.maximum(np.linalg.norm(rows, axis=1), 1e-300)
    solver = piqp.DenseSolver()
    solver.settings.verbose = False
    solver.settings.eps_abs = solver.settings.eps_rel = 1e-13
    solver.settings.eps_duality_gap_abs = solver.settings.eps_duality_gap_rel = 1e-13
    solver.setup(np.eye(len(free)), 0.0 * free, None, None, rows / size[:, None], bounds / size, None, None, None)
    assert solver.solve().name == "PIQP_SOLVED"
    expected = (Phi[P * num_outputs :] @ (free + unit @ solver.result.x)).reshape(H + 1, num_outputs)
    np.testing.assert_allclose(problem.solve().trajectory / scale, expected, rtol=0, atol=1e-8)


@cache
def ring_loading() -> ReferenceTrajectory:
    """Return four kinesthetic demonstrations of a robot arm that loads a bearing ring."""
    with np.load(REAL_DATA) as file:
        demonstrations = pose_demonstrations(
            list(file["time"]), list(file["position"]), list(file["quaternion_wxyz"]), orientation="rotation_vector"
        )
    return ReferenceTrajectory.from_demonstrations(demonstrations.resampled(200), components=10)


def real_problem(history, seed) -> Problem:
    """Return a problem with recorded demonstrations; positions must stay above their mean minus 2 cm."""
    reference = ring_loading()
    inside = reference.means.mean(axis=0)
    rng = np.random.default_rng(seed)
    primitive = LcNsKmp(
        reference,
        kernel=SquaredExponential(np.sqrt(0.025)),
        history=history,
        history_variance=1e-6,
        constraints=LinearConstraints(np.eye(6)[:3], inside[:3] - 0.02),
    )
    step = int(rng.integers(0, 200))
    past = None
    if history:
        past = reference.means[np.maximum(np.arange(step - history, step), 0)]
        past = past + 1e-4 * rng.standard_normal(past.shape)
    return Problem(primitive, step, rng.standard_normal(6) * 100, past, np.sqrt(0.025))


@pytest.mark.skipif(not REAL_DATA.exists(), reason="the recordings are not part of the repository")
@pytest.mark.parametrize("history", [0, 10])
@pytest.mark.parametrize("seed", range(4))
def test_predict_solves_problem_4_5_on_real_demonstrations(history, seed):
    problem = real_problem(history, seed)
    prediction = problem.solve()
    assert relative_error(problem, prediction, problem.dense()) < 1e-8
    assert kkt_residual(problem, prediction) < 1e-8


def arguments_of(p: LcNsKmp) -> dict:
    names = "reference kernel lambda_ beta horizon history history_variance constraints"
    return {name: getattr(p, name) for name in names.split()}


def test_special_cases_equal_kmp_and_ns_kmp():
    """KMP (2.17) has β = 0 and no constraints; NS-KMP (4.4) has no constraints."""
    problem = random_problem(3)
    p, n = problem.primitive, problem.step
    arguments = {**arguments_of(p), "history": 0, "constraints": None, "lambda_": p.lambda_ + p.beta, "beta": 0.0}
    t = p.reference.inputs(np.arange(n, n + p.horizon + 1)).astype(Extended)
    indices = np.minimum(np.arange(n, n + p.horizon + 1), p.num_steps - 1)
    K = np.kron(p.kernel(t, t), np.eye(p.num_outputs))
    sigma = np.zeros(K.shape)
    for i, block in enumerate(p.reference.covariances[indices]):
        at = slice(i * p.num_outputs, (i + 1) * p.num_outputs)
        sigma[at, at] = block
    A = np.linalg.inv((K + (p.lambda_ + p.beta) * sigma).astype(float))
    kmp = (K[: p.num_outputs] @ A @ p.reference.means[indices].ravel()).astype(float)
    np.testing.assert_allclose(LcNsKmp(**arguments).predict(n).output, kmp, rtol=0, atol=1e-7)
    # With β = 0 the action has no effect; otherwise the soft null-space projector maps it to a displacement.
    np.testing.assert_array_equal(
        LcNsKmp(**arguments).predict(n, problem.action).output, LcNsKmp(**arguments).predict(n).output
    )
    ns_kmp = LcNsKmp(**{**arguments_of(p), "history": 0, "constraints": None})
    displacement = ns_kmp.predict(n, problem.action).output - ns_kmp.predict(n).output
    e = slice(0, p.num_outputs)
    projector = p.beta / (p.lambda_ + p.beta) * (np.eye(p.num_outputs) - (K[e] @ A @ K[:, e]).astype(float))
    np.testing.assert_allclose(displacement, projector @ problem.action, rtol=1e-4, atol=1e-9)


def small(**changes) -> dict:
    """Return the arguments of a simple primitive: two outputs, twenty steps, x ≤ 0.5."""
    t = np.linspace(0, 1, 20)
    means = np.column_stack([t, np.sin(t)])
    covariances = np.tile(0.01 * np.eye(2), (20, 1, 1))
    reference = ReferenceTrajectory(t, means, covariances)
    return {
        "reference": reference,
        "horizon": 8,
        "constraints": LinearConstraints.box([-np.inf, -np.inf], [0.5, np.inf]),
        **changes,
    }


def test_constraints_are_satisfied_after_a_violating_history():
    p = LcNsKmp(**small(history=3))
    violating_history = np.tile([0.8, 0.2], (3, 1))
    prediction = p.predict(8, np.zeros(2), violating_history)
    assert prediction.constrained
    assert p.constraints.violation(prediction.output) <= 1e-9
    assert (prediction.trajectory[:, 0] <= 0.5 + 1e-9).all()


@pytest.mark.parametrize(("history", "history_variance"), [(0, 1e-4), (1, 1e-10), (10, 1e-4), (10, 1e-10)])
@pytest.mark.parametrize("period", [0.02, 0.001])
def test_bounds_are_satisfied_under_extreme_actions(period, history, history_variance):
    """The actions in the closed loop are far larger than usual gains: constant, alternating and random."""
    t = period * np.arange(60)
    covariances = np.tile(np.diag([1e-6, 1e-2]), (60, 1, 1))
    reference = ReferenceTrajectory(t, np.column_stack([t, np.sin(t)]), covariances)
    p = LcNsKmp(
        reference,
        history=history,
        history_variance=history_variance,
        constraints=LinearConstraints.box([-0.002, -0.1], [t[-1] / 2, 0.1]),
    )
    rng = np.random.default_rng(0)
    for kind in range(3):
        past = np.zeros((history, 2)) if history else None
        for n in range(60):
            sign = (1, (-1) ** n, rng.choice([-1, 1]))[kind]
            output = p.predict(n, sign * 1e6 * np.ones(2), past).output
            assert p.constraints.violation(output) <= 1e-9
            if history:
                past = np.vstack([past[1:], output])


@pytest.mark.parametrize(
    "variances", [(1e-12, 1.0), (1.0, 1e-12), (1e-12, 1e-12), "alternating", "demonstrations that coincide"]
)
@pytest.mark.parametrize(("period", "history"), [(0.02, 0), (0.001, 1), (0.001, 10)])
def test_bounds_are_satisfied_in_badly_scaled_problems(variances, period, history):
    """Variances range from 1e-12 to 1, with ρ = 1e-10 and periods down to 1 ms."""
    t = period * np.arange(60)
    means = np.column_stack([t, np.sin(40 * t)])
    if variances == "demonstrations that coincide":
        reference = ReferenceTrajectory.from_demonstrations(Demonstrations(t, [means] * 3), components=5)
    else:
        diagonal = np.tile(variances if variances != "alternating" else (1.0, 1e-12), (60, 1))
        if variances == "alternating":
            diagonal[::2] = 1e-12
        reference = ReferenceTrajectory(t, means, diagonal[:, :, None] * np.eye(2))
    p = LcNsKmp(
        reference,
        history=history,
        history_variance=1e-10,
        constraints=LinearConstraints.box([-0.002, -0.5], [t[-1] / 2, 0.5]),
        max_deviation=np.inf,
    )
    rng = np.random.default_rng(0)
    past = np.zeros((history, 2)) if history else None
    for n in range(60):
        output = p.predict(n, 1e4 * rng.choice([-1, 1], 2), past).output
        assert p.constraints.violation(output) <= 1e-9
        past = np.vstack([past[1:], output]) if history else None


def test_constraints_of_each_step_apply_at_that_step():
    t = np.linspace(0, 1, 20)
    upper = np.where(t[:, None] < 0.5, 10.0, 0.3) * np.ones(2)
    p = LcNsKmp(**small(constraints=LinearConstraints.box(np.full((20, 2), -10.0), upper)))
    assert p.predict(2).output[0] < 0.2
    assert p.predict(15).output[0] <= 0.3 + 1e-9
    assert p.constraints.violation(np.array([0.4, 0.0]), 2) < 0 < p.constraints.violation(np.array([0.4, 0.0]), 15)


def test_predict_repeats_the_last_mean_at_the_end():
    p = LcNsKmp(**small(constraints=None))
    np.testing.assert_array_equal(p.predict(19).output, p.predict(10_000).output)
    np.testing.assert_allclose(p.predict(19).output, p.reference.means[-1], atol=0.06)


def test_predict_continues_the_history():
    """For ρ → 0 the first point of the window continues a history that is 0.05 away from the mean."""
    p = LcNsKmp(**small(history=5, history_variance=1e-8, constraints=None))
    offset_history = p.reference.means[5:10] + np.array([0.05, 0])
    output = p.predict(10, np.zeros(2), offset_history).output
    assert abs(output[0] - (p.reference.means[10, 0] + 0.05)) < 0.005


def test_constructor_refuses_a_history_variance_below_rounding():
    t = 0.01 * np.arange(100)
    reference = ReferenceTrajectory(t, t[:, None], np.full((100, 1, 1), 1e-4))
    with pytest.raises(InputError, match="raise history_variance, or shorten the history"):
        LcNsKmp(reference, history=60, history_variance=1e-20)


@pytest.mark.parametrize("history", [0, 10])
@pytest.mark.parametrize(
    "constraints",
    [
        LinearConstraints.box([-9.0, 0.05], [9.0, 0.05]),
        LinearConstraints(np.array([[0, 1.0], [0, 1.0], [0, 2.0], [0, -1.0]]), np.array([0.05, 0.05, 0.1, -0.05])),
    ],
)
def test_fixed_output_does_not_affect_the_others(history, constraints):
    """The fixed output has equal lower and upper bounds, once or repeatedly."""
    t = np.linspace(0, 2, 200)
    reference = ReferenceTrajectory(t, np.column_stack([np.sin(t), 0.1 * t]), np.tile(1e-4 * np.eye(2), (200, 1, 1)))
    p = LcNsKmp(reference, history=history, constraints=constraints)
    past = np.tile(constraints.nearest(reference.means[0]), (history, 1)) if history else None
    for step in range(200):
        output = p.predict(step, np.array([0.0, 3.0]), past).output
        assert constraints.violation(output) <= 1e-9
        past = np.vstack([past, output])[1:] if history else past
    assert output[0] == pytest.approx(reference.means[-1, 0], abs=0.02)


def test_trajectory_does_not_alias_the_callers_array():
    p, action = LcNsKmp(**small()), np.array([0.1, 0.1])
    prediction, expected = p.predict(5, action), p.predict(5, action.copy()).trajectory.copy()
    action[:] = 1e3
    np.testing.assert_array_equal(prediction.trajectory, expected)


def test_predict_accepts_any_kernel_and_an_uneven_clock():
    t = np.cumsum(np.random.default_rng(0).uniform(0.01, 0.1, 30))
    reference = ReferenceTrajectory(t, np.column_stack([np.sin(t)]), np.full((30, 1, 1), 1e-4))
    p = LcNsKmp(reference, kernel=Matern52(0.3), horizon=10)
    outputs = np.array([p.predict(n).output[0] for n in range(30)])
    np.testing.assert_allclose(outputs, np.sin(t), atol=0.05)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"lambda_": -1.0}, "lambda_"),
        ({"beta": np.nan}, "beta"),
        ({"lambda_": 0.0, "beta": 0.0}, "regularization"),
        ({"history": 2, "history_variance": 0.0}, "history_variance"),
        ({"constraints": LinearConstraints(np.eye(3), np.zeros(3))}, "3 outputs"),
        ({"constraints": LinearConstraints(np.zeros((7, 1, 2)), np.zeros((7, 1)))}, "7 steps"),
        ({"kernel": "matern52"}, "a kernel is an object such as SquaredExponential"),
        ({"kernel": Matern52}, "a kernel is an object such as SquaredExponential"),
    ],
)
def test_constructor_refuses_invalid_arguments(changes, message):
    with pytest.raises(InputError, match=message):
        LcNsKmp(**small(**changes))


@pytest.mark.parametrize(
    ("step", "action", "history", "message"),
    [
        (-1, np.zeros(2), np.zeros((3, 2)), "step"),
        (1.5, np.zeros(2), np.zeros((3, 2)), "whole number"),
        (np.nan, np.zeros(2), np.zeros((3, 2)), "whole number"),
        (0, np.array([np.nan, 0]), np.zeros((3, 2)), "finite"),
        (0, np.array([np.inf, 0]), np.zeros((3, 2)), "finite"),
        (0, np.zeros(2), np.zeros((2, 2)), "history"),
        (0, np.zeros(2), None, "history"),
        (0, np.zeros(2), np.full((3, 2), np.nan), "finite"),
    ],
)
def test_predict_refuses_invalid_arguments(step, action, history, message):
    with pytest.raises(InputError, match=message):
        LcNsKmp(**small(history=3)).predict(step, action, history)


@pytest.mark.parametrize("unit", [1.0, 10.0, 1000.0])
def test_deviation_from_demonstrations_depends_on_the_unit(unit):
    """The default λ and β are for meters, so that demonstrations in millimeters are refused."""
    t = np.linspace(0.0, 4.0, 60)
    means = unit * np.column_stack([0.3 + 0.1 * np.sin(2.0 * t), 0.2 * t])
    reference = ReferenceTrajectory(t, means, np.tile((0.01 * unit) ** 2 * np.eye(2), (60, 1, 1)))
    if unit == 1000.0:
        with pytest.raises(InputError, match="check the unit of the outputs"):
            LcNsKmp(reference)
    elif unit == 10.0:
        with pytest.warns(UserWarning, match="standard deviations away from its demonstrations"):
            primitive = LcNsKmp(reference)
        assert 1.0 < primitive.deviation < MAX_DEVIATION
    else:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            primitive = LcNsKmp(reference)
        assert primitive.deviation < 1.0
        steps = np.unique(np.linspace(0, 59, 16).astype(int))
        motion = np.array([primitive.predict(step).output for step in steps.tolist()])
        assert primitive.deviation == pytest.approx(np.sqrt((((motion - means[steps]) / 0.01) ** 2).mean()))
        np.testing.assert_allclose(outputs_at(reference, SquaredExponential(), 12.0, 40, steps), motion, atol=1e-9)


@pytest.mark.parametrize("is_refused", [True, False])
@pytest.mark.parametrize("limit", ["max_deviation", "MAX_MISS"])
def test_primitive_is_refused_beyond_both_limits(monkeypatch, limit, is_refused):
    """The limits are in standard deviations of the demonstrations and in shares of an output's range."""
    t = np.linspace(0.0, 4.0, 60)
    reference = ReferenceTrajectory(t, 1000.0 * np.column_stack([t, t]), np.tile(100.0 * np.eye(2), (60, 1, 1)))
    deviation, miss = measure_deviation(reference, SquaredExponential(0.5), 6.0, 6.0, 40)
    assert deviation > MAX_DEVIATION
    assert miss > MAX_MISS
    arguments = {}
    if limit == "max_deviation":
        arguments["max_deviation"] = np.nextafter(deviation, 0.0) if is_refused else deviation
    else:
        monkeypatch.setattr(
            "guiderail.models.primitives.deviation.MAX_MISS", np.nextafter(miss, 0.0) if is_refused else miss
        )
    if is_refused:
        with pytest.raises(InputError, match="standard deviations away from its demonstrations"):
            LcNsKmp(reference, **arguments)
    else:
        with pytest.warns(UserWarning, match="of an output's range"):
            assert LcNsKmp(reference, **arguments).deviation == deviation


def test_deviation_of_constant_outputs_is_zero():
    t = np.linspace(0.0, 4.0, 60)
    reference = ReferenceTrajectory(t, np.zeros((60, 2)), np.tile(1e-20 * np.eye(2), (60, 1, 1)))
    assert measure_deviation(reference, SquaredExponential(0.5), 6.0, 6.0, 40) == (0.0, 0.0)


STEPS = 30
KERNEL = SquaredExponential(0.5)


def reference(height=1.0):
    times = np.linspace(0.0, 1.0, STEPS)
    means = np.stack([np.sin(times), height * times], axis=1)
    return ReferenceTrajectory(times, means, np.tile(0.01 * np.eye(2), (STEPS, 1, 1)))


def box(half=0.9):
    return LinearConstraints.box([-half, -half], [half, half])


def test_equal_arguments_share_a_primitive_in_use():
    first = get_shared_primitive(reference(), box(), KERNEL, history=2, lambda_=6)
    assert get_shared_primitive(reference(), box(), KERNEL, lambda_=6.0, history=2) is first


@pytest.mark.parametrize(
    "get_primitive",
    [
        lambda: get_shared_primitive(reference(1.1), box(), KERNEL, history=2),
        lambda: get_shared_primitive(reference(), box(0.8), KERNEL, history=2),
        lambda: get_shared_primitive(reference(), box(), SquaredExponential(0.4), history=2),
        lambda: get_shared_primitive(reference(), box(), KERNEL, history=3),
    ],
)
def test_different_arguments_make_another_primitive(get_primitive):
    assert get_primitive() is not get_shared_primitive(reference(), box(), KERNEL, history=2)


def test_shared_primitive_predicts_like_a_new_primitive():
    shared = get_shared_primitive(reference(), box(), KERNEL, history=2)
    past, action = np.array([[0.0, 0.0], [0.01, 0.01]]), np.array([3.0, -2.0])
    shared.predict(7, -action, past)  # earlier predictions have no effect
    own = LcNsKmp(reference(), kernel=KERNEL, constraints=box(), history=2)
    np.testing.assert_array_equal(shared.predict(5, action, past).output, own.predict(5, action, past).output)


def test_unused_primitive_is_released():
    from guiderail.models.primitives.lc_ns_kmp import _SHARED

    get_shared_primitive(reference(1.7), box(), KERNEL)
    gc.collect()
    assert not [primitive for primitive in _SHARED.values() if primitive.reference.means[-1, 1] == 1.7]


def test_predict_accepts_lists_and_whole_numbers_of_any_type():
    primitive = LcNsKmp(**small(history=2))
    past = np.zeros((2, 2))
    outputs = [primitive.predict(step, [0, 1], past.tolist()).output for step in (3, np.int64(3), 3.0)]
    np.testing.assert_array_equal(outputs[1:], outputs[:1] * 2)
