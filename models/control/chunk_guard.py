"""Guard of chunks: bounds, velocity and jerk of the poses that any policy commands, by projection or slowdown."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag

from guiderail.models.common.arrays import as_numbers
from guiderail.models.common.errors import InputError, brief
from guiderail.models.primitives.constraints import LinearConstraints
from guiderail.models.primitives.qp import UnsolvableError, find_solver, solve_least_norm

MODES = ("projection", "slowdown")
RATES = (1.0, 0.8, 0.6, 0.4, 0.2, 0.1, 0.05, 0.02, 0.01, 0.0)  # speeds along the chunk that a slowdown tries
SAMPLES = 10  # of the path, per step of a chunk
MARGIN = 1e-4  # share of each limit that is left to the solver's rounding errors


@dataclass(frozen=True)
class GuardedChunk:
    """Chunk within the limits.

    Attributes:
        outputs: Outputs (K, O).
        rate: Speed along the chunk, relative to the chunk's; 1 with a projection.
        is_fallback: True if no chunk within the limits was found, and the rest of the previous one is repeated.
    """

    outputs: np.ndarray
    rate: float
    is_fallback: bool


class ChunkGuard:
    """Filter from a policy's chunk to a chunk within bounds, velocity and jerk limits, from one chunk to the next.

    With y₋₂ … y₀ the last executed outputs and y₁ … y_K the chunk, the result is the nearest chunk (in units of the
    velocity limit) with

        G y_k ≥ c,   |y_k − y_{k−1}| ≤ v T,   |y_k − 3 y_{k−1} + 3 y_{k−2} − y_{k−3}| ≤ j T³,   at rest at its end,

    for every output. Because a chunk ends at rest inside the bounds, the rest of it, held at its end, is within the
    limits whatever happens; it is repeated if the solver finds no other. The mode "slowdown" preserves the path: it
    advances along the chunk at the greatest of `RATES` whose projection stays within a tolerance of the path.

    Args:
        constraints: Bounds of every output, G y ≥ c.
        velocity: Velocity limits v (O,) [unit/s], positive.
        jerk: Jerk limits j (O,) [unit/s³], positive.
        period: T, control period [s], positive.
        start: Output (O,) at rest inside the constraints, from which the motion starts.
        mode: "projection" or "slowdown".
        tolerance: Distance from the path (O,) that a slowdown accepts [unit]; a tenth of v T by default.

    Raises:
        InputError: If an argument has the wrong shape or is out of range, or the start violates a constraint.
    """

    def __init__(
        self,
        constraints: LinearConstraints,
        velocity: np.ndarray,
        jerk: np.ndarray,
        *,
        period: float,
        start: np.ndarray,
        mode: str = "projection",
        tolerance: np.ndarray | None = None,
    ):
        outputs = constraints.num_outputs
        limits = as_numbers(velocity, "velocity limits"), as_numbers(jerk, "jerk limits")
        if any(one.shape != (outputs,) or not (np.isfinite(one) & (one > 0)).all() for one in limits):
            raise InputError(f"limits of velocity and jerk are {outputs} positive numbers each")
        if constraints.num_steps is not None:
            raise InputError("a guard has the same constraints at every step")
        if not (np.isfinite(period) and period > 0):
            raise InputError(f"a control period is positive, not {period}")
        if mode not in MODES:
            raise InputError(f"a guard's mode is {' or '.join(MODES)}, not {brief(mode)}")
        start = as_numbers(start, "the start")
        if start.shape != (outputs,) or not constraints.violation(start) <= 0.0:
            raise InputError(f"a guard starts from {outputs} numbers inside the constraints, not {brief(start)}")
        self._constraints, self._mode = constraints, mode
        self._step, self._jerk = limits[0] * period, limits[1] * period**3
        self._tolerance = 0.1 * self._step if tolerance is None else as_numbers(tolerance, "tolerance")
        self._solve = find_solver("daqp")
        self._past = np.tile(start, (3, 1))
        self._plan = start[None]

    def guard(self, chunk: np.ndarray, num_executed: int | None = None) -> GuardedChunk:
        """Return the chunk within the limits, and continue after its first steps.

        Args:
            chunk: Requested outputs (K, O), from the next control step on; values that are not finite are refused.
            num_executed: Steps of the result that are executed before the next call; all by default.

        Raises:
            InputError: If the chunk has the wrong shape or is not finite, or fewer than four steps.
        """
        requested = as_numbers(chunk, "a chunk")
        outputs = self._constraints.num_outputs
        if requested.ndim != 2 or requested.shape[1] != outputs or len(requested) < 4:
            raise InputError(f"a chunk has at least four steps of {outputs} outputs, not {brief(requested.shape)}")
        if not np.isfinite(requested).all():
            raise InputError("a chunk must be finite")
        found = self._slow_down(requested) if self._mode == "slowdown" else (self._project(requested), 1.0)
        held = self._plan[np.minimum(np.arange(len(requested)), len(self._plan) - 1)]
        result = GuardedChunk(held, 0.0, True) if found[0] is None else GuardedChunk(found[0], found[1], False)
        number = len(requested) if num_executed is None else num_executed
        self._past = np.concatenate([self._past, result.outputs[:number]])[-3:]
        self._plan = result.outputs[min(number, len(requested) - 1) :]
        return result

    def _slow_down(self, chunk: np.ndarray) -> tuple[np.ndarray | None, float]:
        """Return the projection of the chunk at the greatest rate that preserves its path, and that rate."""
        points = np.concatenate([self._past[-1:], chunk])
        projected = None
        for rate in RATES:
            at = rate / SAMPLES * np.arange(SAMPLES * len(chunk) + 1)
            path = np.column_stack([np.interp(at, np.arange(len(points)), column) for column in points.T])
            projected = self._project(path[SAMPLES::SAMPLES])
            if projected is None:
                continue
            # The result may lag behind on the path: a motion from rest does.
            is_near = (np.abs(projected[:, None] - path[None]) <= self._tolerance).all(axis=2)
            if is_near.any(axis=1).all():
                return projected, rate
        return projected, 0.0

    def _project(self, chunk: np.ndarray) -> np.ndarray | None:
        """Return the nearest chunk (K, O) within the limits, or None if the solver finds none."""
        steps, outputs = chunk.shape
        sequence = np.eye(steps + 3)
        velocity = np.diff(sequence, axis=0)[2:]
        jerk = np.diff(sequence, n=3, axis=0)
        rest = np.diff(sequence, axis=0)[-2:]
        rows, lower, upper = [], [], []
        for output in range(outputs):
            differences = np.concatenate([velocity / self._step[output], jerk / self._jerk[output], rest])
            bounds = np.concatenate([np.full(len(velocity) + len(jerk), 1.0 - MARGIN), np.zeros(len(rest))])
            offset = differences[:, :3] @ self._past[:, output] + differences[:, 3:] @ chunk[:, output]
            rows.append(differences[:, 3:] * self._step[output])
            lower.append(-bounds - offset)
            upper.append(bounds - offset)
        scaled = self._constraints.G * self._step  # rows of all steps, for variables in units of v T
        A = np.concatenate(
            [
                block_diag(*rows)[:, np.arange(outputs * steps).reshape(outputs, steps).T.ravel()],
                np.kron(np.eye(steps), scaled),
            ]
        )
        slack = (self._constraints.c[None] - chunk @ self._constraints.G.T).ravel()
        low = np.concatenate([*lower, slack + MARGIN * np.tile(np.linalg.norm(scaled, axis=1), steps)])
        high = np.concatenate([*upper, np.full(len(slack), np.inf)])
        if self.is_within(chunk) and (chunk[-3:] == chunk[-1]).all():
            return chunk.copy()
        size = np.linalg.norm(A, axis=1)
        kept = size > 0
        A, low, high = A[kept] / size[kept, None], low[kept] / size[kept], high[kept] / size[kept]
        try:
            v, _ = solve_least_norm(A, low, high, self._solve)
        except UnsolvableError:
            return None
        found = chunk + self._step * v.reshape(steps, outputs)
        found[-2:] = found[-3]  # exactly at rest
        return found if self.is_within(found) else None

    def is_within(self, chunk: np.ndarray) -> bool:
        """Return True if a chunk (K, O) that continues the executed outputs is within all limits."""
        motion = np.concatenate([self._past, chunk])
        return bool(
            (np.abs(np.diff(motion, axis=0)[2:]) <= self._step).all()
            and (np.abs(np.diff(motion, n=3, axis=0)) <= self._jerk).all()
            and (chunk @ self._constraints.G.T >= self._constraints.c).all()
        )
