"""Compare certificates near the numerical limits with a reference in extended precision.

Parameters of primitives (λ, β, the history's variance, length scale, clock, covariances, gains) are sampled between
1e-300 and 1e300. Every bound that the checker computes, which is the tightest claim that it accepts, must contain the
exact bound, computed with 400 digits. With constraints, the exact quadratic program is solved at every step of random
action sequences, and commands, speeds and accelerations must be within the bounds. The commands of the primitive in
double precision must be within the claims.

Run it with `python tests/harness/certificate_extremes.py [NUMBER] [SEED]`.
"""

import itertools
import json
import sys
import warnings
from collections import Counter

import mpmath as mp
import numpy as np

from guiderail.models.common.errors import InputError
from guiderail.models.primitives import LcNsKmp, LinearConstraints, ReferenceTrajectory, SquaredExponential
from guiderail.models.primitives.qp import UnsolvableError
from guiderail_studies.certificate import checker
from guiderail_studies.certificate.bounds import certify
from guiderail_studies.certificate.files import OUTWARD
from guiderail_studies.certificate.loop import CertifiedLoop

DIGITS = 400
ORDERS = {"speed": 1, "acceleration": 2}


def sample_scale(rng, usual):
    """Sample a number near `usual`, within a factor of 1e25 of it, or between 1e-300 and 1e300, equally often."""
    kind = rng.integers(3)
    if kind == 0:
        return float(usual * 10.0 ** rng.uniform(-1.0, 1.0))
    return float(10.0 ** rng.uniform(*((-300.0, 300.0) if kind == 1 else (np.log10(usual) - 25, np.log10(usual) + 25))))


def sample_primitive(rng):
    """Return the arrays of a random primitive, in which at most two parameters are far from their usual values."""
    steps, outputs = int(rng.integers(2, 5)), int(rng.integers(1, 3))
    history, horizon = int(rng.choice([0, 0, 1, 2, 3])), int(rng.integers(0, 4))
    usual = {
        **{"lambda": 6.0, "beta": 6.0, "history_variance": 1e-6, "length_scale": 0.5, "clock": 0.02},
        **{"variance": 0.0025, "mean": 0.2, "gain": 0.5, "start_within": 0.003},
    }
    far = rng.choice(list(usual), size=rng.integers(0, 3), replace=False)
    scales = {name: sample_scale(rng, value) if name in far else value for name, value in usual.items()}
    if "lambda" in far and rng.uniform() < 0.7:  # so that λ + β is extreme too
        scales["beta"] = scales["lambda"] * rng.choice([0.0, 0.5, 1.0])
    phase = np.linspace(0.0, 1.0, steps)
    means = scales["mean"] * np.column_stack([np.sin(2.0 * phase + o) for o in range(outputs)])
    factors = rng.normal(size=(steps, outputs, outputs)) + 1.5 * np.eye(outputs)
    with np.errstate(over="ignore", invalid="ignore"):
        covariances = scales["variance"] * np.einsum("nij,nkj->nik", factors, factors)
    gains = np.zeros(outputs)
    gains[0] = scales["gain"]
    return {
        **{"means": means, "covariances": 0.5 * (covariances + covariances.transpose(0, 2, 1)), "gains": gains},
        **{"start": means[0].copy(), "start_within": np.full(outputs, scales["start_within"])},
        **{name: np.array(scales[name]) for name in ("clock", "length_scale", "lambda", "beta", "history_variance")},
        **{"horizon": np.array(horizon), "history": np.array(history)},
    }


class Reference:
    """Primitive and its motions with `DIGITS` digits."""

    def __init__(self, p):
        self.p, (self.steps, self.outputs) = p, p["means"].shape
        self.past, self.horizon = int(p["history"]), int(p["horizon"])
        self.hbar, self.beta = mp.mpf(float(p["lambda"])) + mp.mpf(float(p["beta"])), mp.mpf(float(p["beta"]))
        n, P = self.past + self.horizon + 1, self.past
        clock, length = mp.mpf(float(p["clock"])), mp.mpf(float(p["length_scale"]))
        k = mp.matrix(n, n)
        for i, j in itertools.product(range(n), repeat=2):
            k[i, j] = mp.exp(-(((i - j) * clock) ** 2) / (2 * length**2))
        self.W, self.C = mp.matrix(n - P, P), k[P:, P:]
        if P:
            noisy = k[:P, :P] + self.hbar * mp.mpf(float(p["history_variance"])) * mp.eye(P)
            self.W = mp.lu_solve(noisy, k[:P, P:]).T if n - P == 1 else (mp.inverse(noisy) * k[:P, P:]).T
            self.C = k[P:, P:] - self.W * k[:P, P:]
        self.windows = [self._window(step) for step in range(self.steps)]

    def _window(self, step):
        """Return the maps of history and action, the offset and S of a step's window."""
        outs, at = self.outputs, np.minimum(np.arange(step, step + self.horizon + 1), self.steps - 1)
        size = len(at) * outs
        precision, C, W, mean = mp.matrix(size), mp.matrix(size), mp.matrix(size, self.past * outs), mp.matrix(size, 1)
        for j, row in enumerate(at):
            one = mp.inverse(mp.matrix(self.p["covariances"][row].tolist()))
            for o, q in itertools.product(range(outs), repeat=2):
                precision[j * outs + o, j * outs + q] = one[o, q]
            for o in range(outs):
                mean[j * outs + o] = mp.mpf(float(self.p["means"][row, o]))
                for m in range(len(at)):
                    C[j * outs + o, m * outs + o] = self.C[j, m]
                for m in range(self.past):
                    W[j * outs + o, m * outs + o] = self.W[j, m]
        S = mp.inverse(C * precision + self.hbar * mp.eye(size)) * C
        pull = S * precision
        history = W - pull * W if self.past else W
        return history, self.beta * S[:, :outs], pull * mean, S

    def exact_bounds(self, period):
        """Return the exact bounds of motions without constraints."""
        outs, rest = self.outputs, max(self.past, 2)
        moved = np.flatnonzero(self.p["gains"])
        batch = self.steps * len(moved) + outs
        zero = mp.mpf(0)
        middle = np.full((rest + self.steps, outs), zero, dtype=object)
        spread = np.full((rest + self.steps, outs, batch), zero, dtype=object)
        for o in range(outs):
            middle[:rest, o] = mp.mpf(float(self.p["start"][o]))
            spread[:rest, o, batch - outs + o] = mp.mpf(float(self.p["start_within"][o]))
        for n in range(self.steps):
            history, action, offset, _ = self.windows[n]
            row = rest + n
            for o in range(outs):
                middle[row, o] = offset[o]
                for m, q in itertools.product(range(self.past), range(outs)):
                    middle[row, o] += history[o, m * outs + q] * middle[row - self.past + m, q]
                    spread[row, o] = spread[row, o] + history[o, m * outs + q] * spread[row - self.past + m, q]
                for i, output in enumerate(moved):
                    spread[row, o, n * len(moved) + i] += action[o, int(output)] * float(self.p["gains"][output])
        size = np.abs(spread).sum(axis=2)
        bounds = {"lower": (middle - size)[rest:], "upper": (middle + size)[rest:]}
        for name, order in ORDERS.items():
            change = np.abs(np.diff(middle, order, axis=0)) + np.abs(np.diff(spread, order, axis=0)).sum(axis=2)
            bounds[name] = change[-self.steps :] / mp.mpf(period) ** order
        return bounds

    def execute(self, actions, start, G, c):
        """Return the exact commands (N, O) for actions (N,) of the first output, and True if one was corrected."""
        outs, commands, corrected = self.outputs, [list(start)] * self.past, False
        for n, action in enumerate(actions):
            history, by, offset, S = self.windows[n]
            raw = mp.matrix([mp.mpf(float(action)) * mp.mpf(float(gain)) for gain in self.p["gains"]])
            y = offset + by * raw
            if self.past:
                y += history * mp.matrix([x for one in commands[len(commands) - self.past :] for x in one])
            at = np.minimum(np.arange(n, n + self.horizon + 1), self.steps - 1)
            rows, limits = [], []
            for j, row in enumerate(at):
                for normal, limit in zip(G[row], c[row], strict=True):
                    full = mp.matrix(1, len(y))
                    for o in range(outs):
                        full[j * outs + o] = mp.mpf(float(normal[o]))
                    rows.append(full)
                    limits.append(mp.mpf(float(limit)))
            solution = solve_exactly(y, S, rows, limits)
            if solution is None:
                return None, True
            y, is_corrected = solution
            corrected |= is_corrected
            commands.append(list(y[:outs]))
        return np.array(commands[self.past :], dtype=object), corrected


def solve_exactly(y, S, rows, limits):
    """Return the feasible point nearest to y in the metric S⁻¹, and True if it is not y; None if none is found."""
    short = [limit - (row * y)[0] for row, limit in zip(rows, limits, strict=True)]
    if all(one <= 0 for one in short):
        return y, False
    for size in range(1, min(len(rows), len(y)) + 1):
        for active in itertools.combinations(range(len(rows)), size):
            A = mp.matrix([list(rows[i]) for i in active])
            M = A * S * A.T
            try:
                alpha = mp.lu_solve(M, mp.matrix([short[i] for i in active]))
            except ZeroDivisionError:
                continue
            if any(one < 0 for one in alpha):
                continue
            moved = y + S * A.T * alpha
            if all((row * moved)[0] >= limit - mp.mpf(10) ** -200 for row, limit in zip(rows, limits, strict=True)):
                return moved, True
    return None


def quantities(commands, start, period):
    """Return commands (N, O) with their speeds and accelerations from rest at the start."""
    motion = np.vstack([np.array([start] * 2, dtype=object), commands])
    return {"lower": commands, "upper": commands} | {
        name: np.abs(np.diff(motion, order, axis=0))[-len(commands) :] / mp.mpf(period) ** order
        for name, order in ORDERS.items()
    }


def exceeds(values, bounds, room=0.0):
    """Return the name of a bound (N, O) that some values (N, O) exceed by more than `room` of its largest, or None."""
    for name in checker.QUANTITIES:
        sign = -1 if name == "lower" else 1
        finite = np.where(np.isfinite(bounds[name]), np.abs(bounds[name]), 0.0).max(axis=0)
        for n, o in np.ndindex(bounds[name].shape):
            bound = bounds[name][n, o]
            exact = mp.mpf(float(bound)) + mp.mpf(float(bound - type(bound)(float(bound))))  # from extended precision
            if np.isfinite(bound) and sign * (values[name][n, o] - exact) > room * float(finite[o]):
                return f"{name} of output {o} at step {n}: {mp.nstr(values[name][n, o], 20)} and not {bound!r}"
    return None


def check_sample(rng):
    """Return the outcome of a random certificate, and the reason of a refusal or of a false claim."""
    p = sample_primitive(rng)
    period = float(p["clock"]) if rng.uniform() < 0.8 else sample_scale(rng, 0.02)
    steps, outputs = p["means"].shape
    witness = {"active": np.zeros(steps, bool), "multipliers": np.zeros((0, 0, int(p["horizon"]) + 1, 0))}
    G, c = np.zeros((steps, 0, outputs)), np.zeros((steps, 0))
    executed = None
    try:
        reference = ReferenceTrajectory(float(p["clock"]) * np.arange(steps), p["means"], p["covariances"])
        bound = np.abs(p["means"][:, 0]).max() * rng.uniform(0.5, 1.5)
        limits = np.r_[bound, [np.inf] * (outputs - 1)]
        constraints = LinearConstraints.box(-limits, limits) if rng.uniform() < 0.5 else None
        executed = LcNsKmp(
            reference, SquaredExponential(float(p["length_scale"])), float(p["lambda"]), float(p["beta"]),
            int(p["horizon"]), int(p["history"]), float(p["history_variance"]), constraints, max_deviation=np.inf,
        )  # fmt: skip
        loop = CertifiedLoop(executed, p["gains"], period, p["start"], p["start_within"])
        result = certify(loop)
        witness = {"active": result.can_be_active, "multipliers": result.multipliers}
        G, c = executed.constraints.window(np.arange(steps))
        p["clock"] = np.array((reference.times[-1] - reference.times[0]) / (steps - 1))
    except (InputError, UnsolvableError, ArithmeticError, np.linalg.LinAlgError, ValueError):
        executed = None  # the checker must be correct for files that the package does not write
    arrays = p | {"G": G, "c": c}
    try:
        primitive = checker.Primitive(arrays, "squared_exponential")
        checker.require(checker.SMALLEST <= period <= checker.LARGEST, "the period is out of range")
        computed = primitive.bounds(arrays, primitive.reach(arrays, witness), np.longdouble(period))
        values = [computed[regime][name] for regime in computed for name in checker.QUANTITIES]
        checker.require(not any(np.isnan(each).any() for each in values), "a bound has no value")
    except Exception as reason:  # as in the checker's program
        return "refused", f"{type(reason).__name__}: {reason}"
    exact = Reference(p)
    wrong = exceeds(exact.exact_bounds(period), computed["free"])
    if wrong:
        return "false", f"free {wrong}"
    for _ in range(3):
        actions, side = rng.choice([-1.0, 1.0], steps), rng.choice([-1.0, 1.0])
        start = [mp.mpf(float(x)) + side * mp.mpf(float(d)) for x, d in zip(p["start"], p["start_within"], strict=True)]
        commands, _ = exact.execute(actions, start, G, c)
        if commands is not None and (wrong := exceeds(quantities(commands, start, period), computed["always"])):
            return "false", f"always {wrong}"
        if executed is None:
            continue
        history, outs = np.tile(np.array(start, dtype=float), (int(p["history"]), 1)), []
        for n, action in enumerate(actions):
            try:
                outs.append(executed.predict(n, action * p["gains"], history if len(history) else None).output)
            except (InputError, UnsolvableError):  # the certificate assumes that a program is solved
                break
            history = np.vstack([history, outs[-1]])[1:] if len(history) else history
        if len(outs) < steps:
            continue
        rounded = quantities(np.array([[mp.mpf(float(x)) for x in one] for one in outs], dtype=object), start, period)
        if wrong := exceeds(rounded, computed["always"], OUTWARD):
            return "outside", f"executed {wrong}"
    return "accepted" if executed is None else "accepted, executed", ""


def run(number, seed=0):
    """Check `number` random certificates; return the number of each outcome and all false claims."""
    outcomes, wrong = Counter(), []
    with mp.workdps(DIGITS), warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        for i in range(number):
            outcome, reason = check_sample(np.random.default_rng([seed, i]))
            outcomes[outcome] += 1
            if outcome in ("false", "outside"):
                wrong.append((i, outcome, reason))
    return outcomes, wrong


if __name__ == "__main__":
    results, false_claims = run(int(sys.argv[1]) if len(sys.argv) > 1 else 500, int(sys.argv[2]) if sys.argv[2:] else 0)
    print(json.dumps(results, indent=1))
    for each in false_claims:
        print(*each)
    sys.exit(bool(false_claims))
