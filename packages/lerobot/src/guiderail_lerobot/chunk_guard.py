"""Filter of action chunks by bounds, velocity and jerk limits of the commanded poses, by projection or slowdown."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.sparse.csgraph import connected_components

from guiderail.models.common.arrays import as_numbers, as_whole
from guiderail.models.common.errors import InputError, brief
from guiderail.models.primitives.constraints import TOLERANCE, LinearConstraints
from guiderail.models.primitives.qp import UnsolvableError, solve_least_norm

MODES = ("projection", "slowdown")
RATES = (1.0, 0.8, 0.6, 0.4, 0.2, 0.1, 0.05, 0.02, 0.01, 0.0)  # relative speeds along the chunk that a slowdown tries
SAMPLES = 10  # samples of the path per step of a chunk
MIN_STEPS = 4  # smallest number of steps of a chunk, which must end at rest
MARGIN = 1e-4  # share of each limit that is reserved for the solver's rounding errors


@dataclass(frozen=True)
class GuardedChunk:
    """Chunk within the limits, or a fallback."""

    outputs: np.ndarray  # outputs (K, O)
    # Speed along the path of the requested chunk, relative to the requested speed: 1 in the mode "projection", 0 for a
    # fallback.
    rate: float
    is_fallback: bool  # True if no chunk within the limits was found; `outputs` is then the rest of the previous result


class ChunkGuard:
    """Filter of a policy's chunks by bounds, velocity and jerk limits, which also hold between chunks.

    The last executed outputs are y₋₂ … y₀, and the chunk is y₁ … y_K. The result is the nearest chunk (in units of the
    velocity limit) with

        G y_k ≥ c,   |y_k − y_{k−1}| ≤ v T,   |y_k − 3 y_{k−1} + 3 y_{k−2} − y_{k−3}| ≤ j T³,   at rest at its end,

    for every output. Because a chunk ends at rest inside the bounds, its remaining steps, followed by its last output,
    are always within the limits. They are commanded if the solver finds no chunk. The mode "slowdown" preserves the
    path: the result advances along the chunk at the largest of `RATES` at which the projection is within a tolerance of
    the path.

    The limits couple the steps of an output; a constraint on several outputs couples these outputs. A separate
    quadratic program is solved for each group of coupled outputs.

    Args:
        constraints: Bounds G y ≥ c of the outputs, the same at every step.
        velocity: Velocity limits v (O,) [unit/s], positive.
        jerk: Jerk limits j (O,) [unit/s³], positive.
        period: T, control period [s], positive.
        start: Output (O,) inside the constraints, from which the motion starts at rest; see `reset` and `reset_near`.
        mode: "projection" or "slowdown".
        tolerance: Accepted distance (O,) from the path in a slowdown [unit], positive; a tenth of v T by default.

    Raises:
        InputError: If an argument has the wrong shape or is out of range, the constraints change from step to step, or
            the start violates a constraint.
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
        limits = [as_numbers(velocity, "velocity limits"), as_numbers(jerk, "jerk limits")]
        limits += [] if tolerance is None else [as_numbers(tolerance, "tolerance")]
        if any(limit.shape != (outputs,) or not (np.isfinite(limit) & (limit > 0)).all() for limit in limits):
            raise InputError(f"limits of velocity and jerk, and the tolerance, are {outputs} positive numbers each")
        if constraints.num_steps is not None:
            raise InputError("a chunk guard needs constraints that are the same at every step")
        if not (np.isfinite(period) and period > 0):
            raise InputError(f"a control period must be positive, not {period}")
        if mode not in MODES:
            raise InputError(f"the mode of a chunk guard is {' or '.join(MODES)}, not {brief(mode)}")
        self.constraints, self.period, self._mode = constraints, period, mode
        self._step, self._jerk = limits[0] * period, limits[1] * period**3
        self._tolerance = 0.1 * self._step if tolerance is None else limits[2]
        coupled = (constraints.G != 0).T.astype(float) @ (constraints.G != 0)
        number, labels = connected_components(coupled, directed=False)
        self._groups = [np.flatnonzero(labels == group) for group in range(number)]
        self.reset(start)

    def reset(self, start: np.ndarray) -> None:
        """Restart at rest at an output (O,) inside the constraints.

        Raises:
            InputError: If the output has the wrong shape, is not finite or violates a constraint.
        """
        start, outputs = as_numbers(start, "the start"), self.constraints.num_outputs
        if start.shape != (outputs,) or not self.constraints.violation(start) <= TOLERANCE:
            raise InputError(f"a chunk guard starts from {outputs} numbers inside the constraints, not {brief(start)}")
        self._past, self._plan = np.tile(start, (3, 1)), start[None]

    def reset_near(self, measured: np.ndarray) -> None:
        """Restart at rest at a measured output (O,), inside the constraints or at most one step outside.

        The first command is inside the constraints, and is reached within the limits of velocity and jerk.

        Raises:
            InputError: As `nearest_start`.
        """
        self.reset(self.nearest_start(measured))
        self._past = np.tile(as_numbers(measured, "the measured start"), (3, 1))

    def nearest_start(self, measured: np.ndarray) -> np.ndarray:
        """Return the output (O,) inside the constraints that is nearest to a measured output (O,).

        Raises:
            InputError: If the measured output has the wrong shape or is not finite, or is so far outside that a step
                from rest within the limits of velocity and jerk does not reach the constraints.
        """
        measured, outputs = as_numbers(measured, "the measured start"), self.constraints.num_outputs
        if measured.shape != (outputs,) or not np.isfinite(measured).all():
            raise InputError(f"a measured start is {outputs} finite numbers, not {brief(measured)}")
        inside = self.constraints.nearest(measured)
        # A step d from rest to rest has the third differences d, -2 d and d.
        reach, distance = np.minimum(self._step, 0.5 * self._jerk), np.abs(measured - inside)
        if not (distance <= reach).all():
            number = int(np.argmax(distance / reach))
            raise InputError(
                f"number {number} of the measured start is {distance[number]:.4g} outside of the bounds, and one step "
                f"within the limits moves it by at most {reach[number]:.4g}: move the robot, or widen the bounds"
            )
        return inside

    def guard(self, chunk: np.ndarray, num_executed: int | None = None) -> GuardedChunk:
        """Return the chunk within the limits, and record its first `num_executed` steps as executed.

        Args:
            chunk: Requested outputs (K, O), finite, from the next control step on; K is at least `MIN_STEPS`.
            num_executed: Number of steps of the result that are executed before the next call, 0 to K; all by default.

        Raises:
            InputError: If the chunk has the wrong shape, fewer than four steps, or values that are not finite, or
                `num_executed` is not a whole number in its range.
        """
        result = self.limit(chunk, self._past, self._plan)
        length = len(result.outputs)
        number = length if num_executed is None else as_whole(num_executed, "num_executed", 0, length)
        self._past = np.concatenate([self._past, result.outputs[:number]])[-3:]
        self._plan = result.outputs[min(number, len(result.outputs) - 1) :]
        return result

    def limit(self, chunk: np.ndarray, past: np.ndarray, plan: np.ndarray) -> GuardedChunk:
        """Return the chunk within the limits after a given past, without changing the guard's state.

        Args:
            chunk: Requested outputs (K, O), from the next control step on.
            past: Last three executed outputs (3, O).
            plan: Rest of the previous result (n, O), n at least 1, which is the fallback.

        Raises:
            InputError: If the chunk has the wrong shape, fewer than four steps, or values that are not finite.
        """
        requested = as_numbers(chunk, "a chunk")
        outputs = self.constraints.num_outputs
        if requested.ndim != 2 or requested.shape[1] != outputs or len(requested) < MIN_STEPS:
            raise InputError(f"a chunk has at least four steps of {outputs} outputs, not {brief(requested.shape)}")
        if not np.isfinite(requested).all():
            raise InputError("a chunk must be finite")
        if self._mode == "slowdown":
            limited, rate = self._slow_down(requested, past)
        else:
            limited, rate = self._project(requested, past), 1.0
        if limited is None:
            return GuardedChunk(plan[np.minimum(np.arange(len(requested)), len(plan) - 1)], 0.0, True)
        return GuardedChunk(limited, rate, False)

    def _slow_down(self, chunk: np.ndarray, past: np.ndarray) -> tuple[np.ndarray | None, float]:
        """Return the projection of the chunk at the largest rate that preserves the path, and this rate."""
        points = np.concatenate([past[-1:], chunk])
        projected = None
        for rate in RATES:
            at = rate / SAMPLES * np.arange(SAMPLES * len(chunk) + 1)
            path = np.column_stack([np.interp(at, np.arange(len(points)), column) for column in points.T])
            projected = self._project(path[SAMPLES::SAMPLES], past)
            if projected is None:
                continue
            # The result may lag behind on the path, as a motion from rest does.
            is_near = (np.abs(projected[:, None] - path[None]) <= self._tolerance).all(axis=2)
            if is_near.any(axis=1).all():
                return projected, rate
        return projected, 0.0

    def _project(self, chunk: np.ndarray, past: np.ndarray) -> np.ndarray | None:
        """Return the nearest chunk (K, O) within the limits, or None if the solver finds none."""
        if self.is_within(chunk, past) and (chunk[-3:] == chunk[-1]).all():
            return chunk.copy()
        projected = chunk.copy()
        try:
            for group in self._groups:
                projected[:, group] += self._correction(chunk, past, group)
        except UnsolvableError:
            return None
        projected[-2:] = projected[-3]  # exactly at rest
        return projected if self.is_within(projected, past) else None

    def _correction(self, chunk: np.ndarray, past: np.ndarray, group: np.ndarray) -> np.ndarray:
        """Return the correction (K, n) of the outputs of a group (n,).

        Raises:
            UnsolvableError: If the solver finds no correction.
        """
        steps, size = len(chunk), len(group)
        velocity, jerk, rest = _differences(steps)
        sequence = np.concatenate([past[:, group], chunk[:, group]])
        rows, low, high = [], [], []
        for index, output in enumerate(group):
            differences = np.concatenate([velocity / self._step[output], jerk / self._jerk[output], rest])
            bounds = np.concatenate([np.full(len(velocity) + len(jerk), 1.0 - MARGIN), np.zeros(len(rest))])
            offset = differences @ sequence[:, index]
            block = np.zeros((len(differences), steps, size))
            block[:, :, index] = differences[:, 3:] * self._step[output]
            rows.append(block.reshape(-1, steps * size))
            low.append(-bounds - offset)
            high.append(bounds - offset)
        is_involved = (self.constraints.G[:, group] != 0).any(axis=1)
        G, c = self.constraints.G[is_involved][:, group], self.constraints.c[is_involved]
        scaled = G * self._step[group]  # for variables in units of v T
        slack = (c - chunk[:, group] @ G.T).ravel()
        rows.append(np.kron(np.eye(steps), scaled))
        low.append(slack + MARGIN * np.tile(np.linalg.norm(scaled, axis=1), steps))
        high.append(np.full(len(slack), np.inf))
        A, lower, upper = np.concatenate(rows), np.concatenate(low), np.concatenate(high)
        if (lower <= 0.0).all() and (upper >= 0.0).all():
            return np.zeros((steps, size))
        length = np.linalg.norm(A, axis=1)
        used = length > 0
        if (lower[~used] > 0.0).any() or (upper[~used] < 0.0).any():
            raise UnsolvableError("the executed outputs violate a limit")
        v, _ = solve_least_norm(A[used] / length[used, None], lower[used] / length[used], upper[used] / length[used])
        return self._step[group] * v.reshape(steps, size)

    def is_within(self, chunk: np.ndarray, past: np.ndarray | None = None) -> bool:
        """Return True if a chunk (K, O) is within all limits after `past` (3, O), the executed outputs by default."""
        motion = np.concatenate([self._past if past is None else past, chunk])
        return bool(
            (np.abs(np.diff(motion, axis=0)[2:]) <= self._step).all()
            and (np.abs(np.diff(motion, n=3, axis=0)) <= self._jerk).all()
            and (chunk @ self.constraints.G.T >= self.constraints.c).all()
        )


@lru_cache(maxsize=16)
def _differences(steps: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the matrices of velocity, jerk and the last two velocities of three past and `steps` future outputs."""
    first = np.diff(np.eye(steps + 3), axis=0)
    return first[2:], np.diff(np.eye(steps + 3), n=3, axis=0), first[-2:]
