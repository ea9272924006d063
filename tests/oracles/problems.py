"""Random instances of problem 4.5, with their dense reference solution."""

from dataclasses import dataclass

import numpy as np

from guiderail.models.primitives import LcNsKmp, LinearConstraints, ReferenceTrajectory, SquaredExponential
from oracles.dense import DenseWindow, Extended, squared_exponential


@dataclass
class Problem:
    primitive: LcNsKmp
    step: int
    action: np.ndarray
    history: np.ndarray | None
    length_scale: float

    def solve(self):
        return self.primitive.predict(self.step, self.action, self.history)

    def dense(self, precision=Extended, *, step=None, horizon=None, actions=None, at=None) -> DenseWindow:
        """Return the dense window of this problem, or with another step, horizon, or actions (J, O) at steps (J,)."""
        p = self.primitive
        n, H = self.step if step is None else step, p.horizon if horizon is None else horizon
        P, N = p.history, p.num_steps
        dt = p.reference.times[1] - p.reference.times[0]
        indices = np.minimum(np.arange(n, n + H + 1), N - 1)
        inputs = p.reference.times[0] + dt * np.arange(n - P, n + H + 1)
        means, covariances = p.reference.means[indices], p.reference.covariances[indices]
        if P:
            past = p.history_variance * np.broadcast_to(np.eye(p.num_outputs), (P, p.num_outputs, p.num_outputs))
            means, covariances = np.vstack([self.history, means]), np.concatenate([past, covariances])
        return DenseWindow(
            squared_exponential, self.length_scale, inputs, means, covariances, P, p.lambda_, p.beta,
            self.action if at is None else actions, precision, None if at is None else P + np.asarray(at) - n,
        )  # fmt: skip

    def constraints(self):
        return self.primitive.constraints.window(np.arange(self.step, self.step + self.primitive.horizon + 1))


def random_problem(
    seed: int,
    history_variance: float = 1e-4,
    history_noise: float = 1e-3,
    length_scale: float | None = None,
    box: bool = False,
) -> Problem:
    """Return a problem with O = 1…6, F = 0…8, H = 5…60, P = 0…15, correlated covariances and active constraints.

    If `box` is true, some of the rows are pairs of parallel planes, in random order.
    """
    rng = np.random.default_rng(seed)
    outputs, rows, H, P = rng.integers(1, 7), rng.integers(0, 9), rng.integers(5, 61), rng.integers(0, 16)
    N = 80
    dt = 0.02
    t = dt * np.arange(N)
    scale = 10 ** rng.uniform(-2, 0, outputs)
    phase = rng.uniform(0, 2 * np.pi, outputs)
    means = scale * np.sin(rng.uniform(1, 4) * t[:, None] + phase)
    mix = rng.standard_normal((outputs, outputs)) * 0.4 + np.eye(outputs)
    width = scale * (0.05 + 0.3 * np.sin(np.pi * t[:, None] / t[-1]) ** 2)
    covariances = np.einsum("ni,ij,kj,nk->nik", width, mix, mix, width)
    # The mean violates the constraints at some steps; a point within a few standard deviations satisfies them.
    inside = means.mean(axis=0)
    G = rng.standard_normal((rows, outputs)) / scale
    c = G @ inside - rng.uniform(0.1, 0.8, rows)
    if box:
        G, c = _slabs(seed, rows, scale, inside)
    length_scale = np.sqrt(0.5 / rng.uniform(1, 6)) if length_scale is None else length_scale
    step = int(rng.integers(0, N))
    primitive = LcNsKmp(
        ReferenceTrajectory(t, means, covariances),
        kernel=SquaredExponential(length_scale),
        lambda_=rng.uniform(1, 10),
        beta=rng.uniform(1, 10),
        horizon=int(H),
        history=int(P),
        history_variance=float(history_variance * scale.min() ** 2),
        constraints=LinearConstraints(G, c),
        max_deviation=np.inf,
    )
    history = None
    if P:
        past = np.clip(np.arange(step - P, step), 0, N - 1)
        history = means[past] + history_noise * scale * rng.standard_normal((P, outputs))
    action = rng.standard_normal(outputs) * 30 / scale * rng.choice([0.1, 1, 10])
    return Problem(primitive, step, action, history, length_scale)


def _slabs(seed: int, rows: int, scale: np.ndarray, inside: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return rows G and bounds c around a point; 70 % of the rows have an opposite row."""
    rng = np.random.default_rng([seed, 1])
    G = rng.standard_normal((rows + 1, len(scale))) / scale
    opposite = rng.uniform(size=rows + 1) < 0.7
    G = np.vstack([G, -G[opposite]])
    c = G @ inside - rng.uniform(0.1, 0.8, len(G))
    order = rng.permutation(len(G))
    return G[order], c[order]
