"""Duration of a control step of an LC-NS-KMP: `python -m research.benchmarks primitive`.

Every row is a closed loop (history → next point, uniform actions in ±1, gains calibrated by authority) in one of three
regimes: constraints slack, sometimes active, or active at almost every step. The dense step is computed as in the
thesis: K + ħΣ is inverted, and the dual of equation 4.20 over the whole window is solved with PIQP, or with DAQP if
PIQP is not installed. The difference is the largest deviation from the dense step, relative to the outputs' scales.
Most of this difference is the numerical error of the dense step: the tests compare both with extended precision.
"""

import gc
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from guiderail.models.primitives import LcNsKmp, LinearConstraints, ReferenceTrajectory
from guiderail.models.primitives.gains import authority_gains
from guiderail.models.primitives.qp import solve_least_norm
from research.benchmarks import with_progress

# Outputs O, constraint rows F, horizon H and history P of a planar task, the connector, and a larger problem.
SIZES = ((2, 1, 40, 10), (6, 4, 40, 10), (6, 12, 100, 20))
REGIMES = {"slack": 1.3, "grazing": 1.0, "active": 0.5}
DENSE_SECONDS = 5.0  # time after which no further dense step is computed [s]
STEPS = 20_000  # timed steps of each regime
PERIOD = 0.02  # control period [s]
_MOTION = 400  # steps of the motion


@dataclass
class _Loop:
    """Closed loop of a primitive with a sequence of actions."""

    primitive: LcNsKmp
    actions: np.ndarray

    def run(self, predict: Callable[..., Any], steps: int) -> tuple[np.ndarray, int, list[tuple[Any, ...]]]:
        """Return durations [s], (steps,), the number of constrained steps, and every 50th problem with its output."""
        p, seconds, constrained, samples = self.primitive, np.empty(steps), 0, []
        for k in range(steps):
            n = k % _MOTION
            if n == 0:
                history = np.tile(p.constraints.nearest(p.reference.means[0]), (p.history, 1))
            action = self.actions[k % len(self.actions)]
            begin = time.perf_counter()
            prediction = predict(n, action, history)
            seconds[k] = time.perf_counter() - begin
            constrained += prediction.constrained
            if k % 50 == 7:
                samples.append((n, action, history, prediction.output))
            history = np.vstack([history[1:], prediction.output])
        return seconds, constrained, samples


def _reference(outputs: int) -> ReferenceTrajectory:
    """Return a smooth motion with correlated deviations of varying size, at the scales of a connector."""
    rng = np.random.default_rng(0)
    t = PERIOD * np.arange(_MOTION)
    s = t / t[-1]
    scale = np.resize([2e-3, 2e-3, 3e-2, 1.5, 2e-2, 2e-2], outputs)
    means = scale * np.sin(np.outer(s, np.arange(1, outputs + 1)) + np.arange(outputs))
    mix = np.eye(outputs) + 0.3 * rng.standard_normal((outputs, outputs))
    width = scale * (0.1 + 0.3 * np.sin(np.pi * s)[:, None])
    return ReferenceTrajectory(t, means, np.einsum("ni,ij,kj,nk->nik", width, mix, mix, width))


def _primitive(size: tuple[int, int, int, int], share: float) -> LcNsKmp:
    """Return a primitive with a box constraint on F/2 outputs; for F = 1, with one upper bound.

    The half-width of the box is `share` times the largest absolute mean. If `share` is above 1, three standard
    deviations are added to the mean first.
    """
    outputs, rows, horizon, history = size
    reference = _reference(outputs)
    reach = share * (np.abs(reference.means) + reference.standard_deviations * (share > 1) * 3).max(axis=0)
    lower, upper = np.full(outputs, -np.inf), np.full(outputs, np.inf)
    boxed = np.arange(max(rows // 2, 1))
    upper[boxed] = reach[boxed]
    if rows > 1:
        lower[boxed] = -reach[boxed]
    return LcNsKmp(
        reference,
        horizon=horizon,
        history=history,
        history_variance=1e-8,
        constraints=LinearConstraints.box(lower, upper),
    )


def _dense_step(p: LcNsKmp, step: int, action: np.ndarray, history: np.ndarray) -> np.ndarray:
    """Evaluate equations 4.18-4.21 (errata corrected) with all matrices of the window."""
    outputs, past, rows = p.num_outputs, p.history, p.constraints.num_constraints
    window = np.minimum(np.arange(step, step + p.horizon + 1), p.num_steps - 1)
    t = p.reference.inputs(np.arange(step - past, step + p.horizon + 1))
    points = len(t)
    K = np.kron(p.kernel(t, t), np.eye(outputs))
    sigma = np.zeros_like(K)
    known = np.tile(p.history_variance * np.eye(outputs), (past, 1, 1))
    for i, block in enumerate(np.concatenate([known, p.reference.covariances[window]])):
        sigma[i * outputs : (i + 1) * outputs, i * outputs : (i + 1) * outputs] = block
    mu = np.concatenate([history, p.reference.means[window]]).ravel()
    hbar = p.lambda_ + p.beta
    A = np.linalg.inv(K + hbar * sigma)
    executed = slice(past * outputs, (past + 1) * outputs)
    G_bar = np.zeros((points * outputs, (p.horizon + 1) * rows))
    G, c = p.constraints.window(window)
    for i, block in enumerate(G):
        at = (past + i) * outputs
        G_bar[at : at + outputs, i * rows : (i + 1) * rows] = block.T
    KA = K @ A
    y = KA @ mu + p.beta * sigma @ (A @ K[:, executed] @ action)
    S_G = KA @ (sigma @ G_bar)
    alpha = _dual(G_bar.T @ S_G, G_bar.T @ y - c.ravel())
    return y[executed] + S_G[executed] @ alpha


def _dual(H: np.ndarray, slack: np.ndarray) -> np.ndarray:
    """Solve min ½αᵀHα + slackᵀα over α ≥ 0 (equation 4.20)."""
    size = len(slack)
    H = (H + H.T) / 2 + 1e-12 * np.eye(size)
    try:
        import piqp
    except ImportError:
        import daqp

        return daqp.solve(H, slack, np.zeros((0, size)), np.full(size, 1e30), np.zeros(size))[0]
    solver = piqp.DenseSolver()
    solver.settings.verbose = False
    solver.setup(H, slack, None, None, None, None, None, np.zeros(size), None)
    solver.solve()
    return solver.result.x


def _microseconds(seconds: np.ndarray) -> dict[str, float]:
    median, p99, p999, worst = (float(1e6 * t) for t in np.percentile(seconds, [50, 99, 99.9, 100]))
    return {"median_us": median, "p99_us": p99, "p999_us": p999, "worst_us": worst}


def _regime(size: tuple[int, int, int, int], share: float, steps: int) -> tuple[dict[str, Any], np.ndarray]:
    """Return the row of one regime, and the durations of its steps [s]."""
    p = _primitive(size, share)
    rng = np.random.default_rng(1)
    actions = authority_gains(p) * rng.uniform(-1, 1, (997, p.num_outputs))
    loop = _Loop(p, actions)
    loop.run(p.predict, _MOTION)
    gc.collect()
    seconds, constrained, samples = loop.run(p.predict, steps)
    scale = np.abs(p.reference.means).max(axis=0)
    dense_seconds: list[float] = []
    difference = 0.0
    for n, action, history, output in samples[::8][:25]:
        if sum(dense_seconds) > DENSE_SECONDS:
            break
        begin = time.perf_counter()
        expected = _dense_step(p, n, action, history)
        dense_seconds.append(time.perf_counter() - begin)
        difference = max(difference, float((np.abs(expected - output) / scale).max()))
    violation = max(p.constraints.violation(sample[3], sample[0]) for sample in samples)
    dense_ms = 1e3 * float(np.median(dense_seconds))
    row = {"constrained": constrained / steps, **_microseconds(seconds)}
    row |= {
        "dense_ms": dense_ms,
        "times_dense": 1e3 * dense_ms / row["median_us"],
        "difference_to_dense": difference,
        "max_commanded_violation": violation,
    }
    return row, seconds


def _predict(size: tuple[int, int, int, int], steps: int) -> dict[str, dict[str, Any]]:
    """Return a row for each regime and one for all of them together."""
    rows, seconds = {}, []
    for regime, share in REGIMES.items():
        rows[regime], spent = _regime(size, share, steps)
        seconds.append(spent)
    together = _microseconds(np.concatenate(seconds))
    mean = {key: float(np.mean([row[key] for row in rows.values()])) for key in ("constrained", "dense_ms")}
    worst = {key: max(row[key] for row in rows.values()) for key in ("difference_to_dense", "max_commanded_violation")}
    rows["together"] = {**mean, **together, "times_dense": 1e3 * mean["dense_ms"] / together["median_us"], **worst}
    return rows


def _piqp(rows: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    import piqp

    size = rows.shape[1]
    solver = piqp.DenseSolver()
    solver.settings.verbose = False
    solver.settings.eps_abs = solver.settings.eps_rel = 1e-13
    solver.setup(np.eye(size), np.zeros(size), None, None, rows, lower, upper, None, None)
    solver.solve()
    return solver.result.x


def _osqp(rows: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    import osqp
    from scipy import sparse

    solver, size = osqp.OSQP(), rows.shape[1]
    # A first-order solver satisfies a bound up to its tolerance: with a margin it satisfies the bound itself.
    margin = np.minimum(1e-8, (upper - lower) / 4)
    problem = sparse.eye(size, format="csc"), np.zeros(size), sparse.csc_matrix(rows), lower + margin, upper - margin
    solver.setup(*problem, verbose=False, eps_abs=1e-9, eps_rel=1e-9, polishing=True, max_iter=20_000)
    return solver.solve(raise_error=False).x


SOLVERS = {"daqp": lambda *problem: solve_least_norm(*problem)[0], "piqp": _piqp, "osqp": _osqp}


def _solvers(size: tuple[int, int, int, int]) -> dict[str, dict[str, Any]]:
    """Return the median duration of the same quadratic programs with each solver, and the difference from DAQP."""
    p = _primitive(size, REGIMES["active"])
    actions = authority_gains(p) * np.random.default_rng(2).uniform(-1, 1, (997, p.num_outputs))
    _, _, samples = _Loop(p, actions).run(p.predict, 4 * _MOTION)
    predictions = [p.predict(*sample[:3]) for sample in samples]
    rows, scale = {}, np.abs(p.reference.means).max(axis=0)
    for name in SOLVERS if size != SIZES[-1] else ("daqp", "piqp"):  # OSQP needs a second per step at the largest size
        seconds, difference = [], 0.0
        for prediction in predictions:
            if prediction.correction is None:
                continue
            factor = prediction.factor
            free = factor.constraint_map @ prediction.x
            lower, upper = factor.lower - free, factor.upper - free
            largest = max(lower.max(), -upper.min())  # problems of unit size, as in `solve_least_norm`
            begin = time.perf_counter()
            v = largest * SOLVERS[name](factor.constraint_rows, lower / largest, upper / largest)
            seconds.append(time.perf_counter() - begin)
            change = factor.correction_map @ (v - prediction.correction)
            difference = max(difference, float((np.abs(change) / scale).max()))
        median = 1e6 * float(np.median(seconds)) if seconds else float("nan")
        rows[name] = {"median_us": median, "of": len(seconds), "difference_to_daqp": difference}
    return rows


def _leaf_system(size: tuple[int, int, int, int], steps: int) -> dict[str, float]:
    """Time the prediction through the output port of `LcNsKmpSystem`, with a new action each time."""
    from guiderail.systems.movement_primitive import LcNsKmpSystem

    p = _primitive(size, REGIMES["grazing"])
    system = LcNsKmpSystem(p, authority_gains(p), PERIOD)
    context = system.CreateDefaultContext()
    action = system.get_null_space_action_input_port().FixValue(context, np.zeros(p.num_outputs))
    system.get_history_input_port().FixValue(context, np.tile(p.reference.means[0], (p.history, 1)).ravel())
    port = system.get_command_output_port()
    actions = np.random.default_rng(1).uniform(-1, 1, (steps, p.num_outputs))
    seconds = np.empty(steps)
    for k in range(steps):
        action.GetMutableData().set_value(actions[k])
        begin = time.perf_counter()
        port.Eval(context)
        seconds[k] = time.perf_counter() - begin
    return _microseconds(seconds)


def _factoring(size: tuple[int, int, int, int]) -> dict[str, float]:
    """Return the duration of a first prediction, and the time and memory of factoring a step."""
    p = _primitive(size, REGIMES["grazing"])
    history = np.tile(p.reference.means[0], (p.history, 1))
    begin = time.perf_counter()
    p.predict(0, np.zeros(p.num_outputs), history)
    first = time.perf_counter() - begin
    begin = time.perf_counter()
    for step in range(p.num_steps):
        p.linear_response(step)  # factors the step
    seconds, total = time.perf_counter() - begin, p.cached_bytes
    return {"first_ms": 1e3 * first, "step_ms": 1e3 * seconds / p.num_steps, "step_kB": total / p.num_steps / 1e3}


def measure(steps: int = STEPS) -> dict[str, Any]:
    """Run the benchmark; return the results by size."""
    report = {}
    for size in with_progress(SIZES, "primitive, O F H P"):
        name = "O{} F{} H{} P{}".format(*size)
        report[name] = {
            "predict": _predict(size, steps),
            "leaf_system": _leaf_system(size, steps),
            "factoring": _factoring(size),
            "solvers": _solvers(size),
        }
    return report


def show(report: dict[str, Any]) -> None:
    """Print the tables."""
    from rich.console import Console
    from rich.table import Table

    console = Console()
    for size, parts in report.items():
        table = Table(title=f"LC-NS-KMP, {size}: one prediction [µs]")
        for column in ("regime", "constrained", "median", "p99", "p99.9", "worst", "dense [ms]", "ratio", "difference"):
            table.add_column(column, justify="right")
        for regime, row in parts["predict"].items():
            table.add_row(
                regime,
                f"{row['constrained']:.0%}",
                *(f"{row[key]:.0f}" for key in ("median_us", "p99_us", "p999_us", "worst_us")),
                f"{row['dense_ms']:.1f}",
                f"{row['times_dense']:.0f}",
                f"{row['difference_to_dense']:.0e}",
            )
        console.print(table)
        leaf, factoring = parts["leaf_system"], parts["factoring"]
        console.print(
            f"through the LeafSystem: median {leaf['median_us']:.0f} µs, p99 {leaf['p99_us']:.0f} µs; first prediction "
            f"{factoring['first_ms']:.1f} ms; factoring a step takes {factoring['step_ms']:.2f} ms and "
            f"{factoring['step_kB']:.0f} kB"
        )
        for name, row in parts["solvers"].items():
            console.print(
                f"  {row['of']} quadratic programs by {name}: median {row['median_us']:.0f} µs, differs by "
                f"{row['difference_to_daqp']:.0e}"
            )
