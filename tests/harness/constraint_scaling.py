"""Adversarial actions against constraints with scaled rows: `python tests/harness/constraint_scaling.py [STEPS]`.

Every row of G and the corresponding entry of c are scaled by a random factor from 1e-9 to 1e9. No command, fallbacks
included, may violate a constraint by more than 1e-9 of the norm of its row.
"""

import sys
import time
from dataclasses import dataclass

import numpy as np

from guiderail.models.primitives import LcNsKmp, LinearConstraints, ReferenceTrajectory, UnsolvableError

PERIOD, STEPS = 0.02, 40
KINDS = ("box", "moving box", "polygon", "turning polygon", "jumping box")
MOVING = ("moving box", "turning polygon", "jumping box")


@dataclass
class Result:
    """Statistics of the executed steps.

    Attributes:
        steps: Number of executed steps.
        corrected: Number of steps at which a constraint of the window was active.
        fallbacks: Number of steps without a solution.
        worst: Largest violation, divided by the norm of its row of G [unit of the output].
    """

    steps: int = 0
    corrected: int = 0
    fallbacks: int = 0
    worst: float = -np.inf


def half_spaces(kind: str, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return G (N, F, 2) and c (N, F) around a moving center, rows of unit norm."""
    phase = np.linspace(0.0, 1.0, STEPS)
    is_moving, is_turning = kind in MOVING, kind == "turning polygon"
    sides = 4 if kind.endswith("box") else int(rng.integers(3, 8))
    angles = np.arange(sides) * 2 * np.pi / sides + (0.0 if kind.endswith("box") else rng.uniform(0.0, 2 * np.pi))
    angles = angles + np.outer(phase, np.ones(sides)) * (rng.uniform(-2.0, 2.0) if is_turning else 0.0)
    G = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    if kind.endswith("box"):
        G = np.round(G)
    center = np.column_stack([0.2 * np.sin(2 * np.pi * phase), 0.2 * np.cos(2 * np.pi * phase)]) * is_moving
    if kind == "jumping box":  # no smooth window satisfies constraints without overlap
        center = center + np.outer(np.arange(STEPS) % 8 == 7, [5.0, 0.0])
    width = rng.uniform(0.02, 0.3) + (rng.uniform(0.0, 0.2) * np.sin(7.0 * phase) ** 2 if is_moving else 0.0 * phase)
    return G, np.einsum("nfo,no->nf", G, center) - width[:, None]


def random_actions(rng: np.random.Generator) -> np.ndarray:
    """Return actions (N, 2) of a random constant size from 1 to 1e5, with sign changes at no, some or all steps."""
    parity = np.cumsum(rng.uniform(size=(STEPS, 2)) < rng.choice([0.0, 0.05, 0.3, 1.0]), axis=0) % 2
    return (1.0 - 2.0 * parity) * rng.choice([-1.0, 1.0], 2) * 10.0 ** rng.uniform(0.0, 5.0)


def attack(steps: int, seed: int = 0) -> dict[str, Result]:
    """Execute at least `steps` steps; return the result for each kind of constraints."""
    rng, results, sequences = np.random.default_rng(seed), {kind: Result() for kind in KINDS}, 0
    while sum(result.steps for result in results.values()) < steps:
        kind = KINDS[sequences % len(KINDS)]
        history = 4 * (sequences // len(KINDS) % 2)
        sequences += 1
        G, c = half_spaces(kind, rng)
        factors = 10.0 ** rng.uniform(-9.0, 9.0, c.shape if kind in MOVING else (1, c.shape[1]))
        G, c = G * factors[..., None], c * factors
        constraints = LinearConstraints(G, c) if kind in MOVING else LinearConstraints(G[0], c[0])
        phase = np.linspace(0.0, 1.0, STEPS)
        means = np.column_stack([0.2 * np.sin(np.pi * phase), 0.1 * phase])
        covariances = np.tile(rng.uniform(0.01, 0.2) ** 2 * np.array([[1.0, 0.3], [0.3, 0.5]]), (STEPS, 1, 1))
        reference = ReferenceTrajectory(PERIOD * np.arange(STEPS), means, covariances)
        primitive = LcNsKmp(reference, horizon=10, history=history, constraints=constraints)
        norms = np.linalg.norm(G, axis=2)
        for _ in range(5):
            run(primitive, random_actions(rng), (G, c, norms), results[kind])
    return results


def run(primitive: LcNsKmp, sequence: np.ndarray, rows: tuple[np.ndarray, ...], result: Result) -> None:
    """Execute a sequence of actions (N, 2) like `LcNsKmpSystem`, and add its statistics to a result."""
    G, c, norms = rows
    last = primitive.constraints.nearest(primitive.reference.means[0])
    past = np.tile(last, (primitive.history, 1))
    for n, action in enumerate(sequence):
        try:
            prediction = primitive.predict(n, action, past if primitive.history else None)
            last = prediction.output
            result.corrected += prediction.constrained
        except UnsolvableError:
            last = primitive.constraints.nearest(last, n)
            result.fallbacks += 1
        past = np.vstack([past[1:], last]) if primitive.history else past
        result.steps += 1
        result.worst = max(result.worst, float(((c[n] - G[n] @ last) / norms[n]).max()))


def main(steps: int) -> int:
    start = time.perf_counter()
    results = attack(steps)
    for kind, result in results.items():
        print(
            f"{kind}: {result.steps} steps, {result.corrected} corrected, {result.fallbacks} fallbacks, "
            f"worst violation {result.worst:.1e} of the row's norm"
        )
    print(f"{time.perf_counter() - start:.0f} s")
    return int(any(result.worst > 1e-9 for result in results.values()))


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1]) if len(sys.argv) > 1 else 1_000_000))
