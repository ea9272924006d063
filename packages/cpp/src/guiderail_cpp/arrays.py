"""Arrays of the laws of a skill, as the C++ library reads them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from guiderail.models.common.errors import InputError
from guiderail.models.laws.primitive import PrimitiveLaw
from guiderail.models.primitives import LinearConstraints
from guiderail.models.primitives.window import StepFactor

Arrays = dict[str, np.ndarray]
"""Arrays of doubles by name."""
_ROUNDING, _DEPENDENT = 1e-12, 1e-9  # negligible singular values of equations, relative to the largest
_EQUAL = 1e-9  # largest distance of two bounds that count as equal, relative to a correction of norm one


def constraint_arrays(constraints: LinearConstraints) -> Arrays:
    """Return rows, bounds and a point inside of linear constraints, with a leading axis of steps (one if constant)."""
    G, c = constraints.G, constraints.c
    points = constraints._interior
    if constraints.num_steps is None:
        G, c, points = G[None], c[None], points[None]
    return {"constraints/G": G, "constraints/c": c, "constraints/interior": points}


def primitive_arrays(law: PrimitiveLaw) -> Arrays:
    """Return the factored steps of a primitive, so that a control step needs only products and a least-norm problem.

    Args:
        law: Law of KGRL or sKGRL, without residual, filter and progress.

    Raises:
        InputError: If the primitive has a history and a lower bound is equal to its upper bound: in Python, a history
            outside of the equation then has no solution, and the last command is repeated.
    """
    primitive = law.primitive
    gain = law.gain[:, None] * np.eye(law.num_outputs)[:, law.outputs]  # (O, A), per unit of each entry of the action
    steps = [_Step.of(primitive._factor(step)) for step in range(primitive.num_steps)]
    if primitive.history and any(step.is_equal.any() for step in steps):
        raise InputError("equal lower and upper bounds cannot be exported with a history: widen them or use kgrl")
    steps = [step.without_equations() for step in steps]
    width = max(step.rows.shape[1] for step in steps)
    arrays = {
        "primitive/output_map": [step.output_map for step in steps],
        "primitive/output_offset": [step.output_offset for step in steps],
        "primitive/constraint_map": [step.constraint_map for step in steps],
        "primitive/lower": [step.lower for step in steps],
        "primitive/upper": [step.upper for step in steps],
        "primitive/scale": [step.scale for step in steps],
        "primitive/constraint_rows": [_widened(step.rows, width) for step in steps],
        "primitive/correction_map": [_widened(step.correction_map, width) for step in steps],
        "primitive/rank": [float(step.rows.shape[1]) for step in steps],
        "primitive/gain": gain,
        "primitive/initial_command": primitive.constraints.nearest(primitive.reference.means[0]),
        "primitive/first_mean": primitive.reference.means[0],
        "primitive/is_measured": [float(law.history_source == "measured")],
    }
    stacked = {name: np.asarray(values, dtype=float) for name, values in arrays.items()}
    return stacked | constraint_arrays(primitive.constraints)


@dataclass(frozen=True)
class _Step:
    """Factored problem of one step, as in `StepFactor`, with the scale (m,) of each constrained direction."""

    output_map: np.ndarray
    output_offset: np.ndarray
    constraint_map: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    rows: np.ndarray
    correction_map: np.ndarray
    scale: np.ndarray
    num_executed: int  # number of directions of the executed point, which are the first

    @classmethod
    def of(cls, factor: StepFactor) -> _Step:
        """Return the arrays of a factored problem."""
        alpha = factor.multipliers(np.full(len(factor.lower), -1.0))
        return cls(
            factor.output_map, factor.output_offset, factor.constraint_map, factor.lower, factor.upper,
            factor.constraint_rows, factor.correction_map, alpha[alpha > 0.0],
            len(factor._directions),
        )  # fmt: skip

    @property
    def is_equal(self) -> np.ndarray:
        """Mask (m,) of the directions with equal bounds."""
        return self.upper - self.lower < _EQUAL

    def without_equations(self) -> _Step:
        """Return the problem without its equations, which are the directions with equal bounds.

        The solutions of equations R v = e − F x are v = R⁺ (e − F x) + N w. The particular solution is affine in x
        and becomes part of the maps; as it is orthogonal to N w, the correction w of least norm gives v of least norm.
        The equations of a window are hundreds of nearly dependent rows, which an active-set method can't order well.
        The equations of the executed point are solved first, so that it satisfies them exactly.
        """
        executed = np.arange(len(self.scale)) < self.num_executed
        step = self
        for at, negligible in ((self.is_equal & executed, _ROUNDING), (self.is_equal & ~executed, _DEPENDENT)):
            if at.any():
                step = step._solved(at, negligible)
        return step

    def _solved(self, at: np.ndarray, negligible: float) -> _Step:
        """Return the problem with the equations of a mask (m,) solved; their rows become zero and unbounded.

        Singular values below `negligible` times the largest belong to equations that follow from the others.
        """
        U, s, Vt = np.linalg.svd(self.rows[at])
        rank = int((s > negligible * s.max(initial=0.0)).sum())
        pinv = Vt[:rank].T / s[:rank] @ U[:, :rank].T  # (r, equations)
        basis = Vt[rank:].T
        free = ~at
        e, F = 0.5 * (self.lower[at] + self.upper[at]), self.constraint_map[at]
        offset = free * (self.rows @ (pinv @ e))
        return replace(
            self,
            output_map=self.output_map - self.correction_map @ pinv @ F,
            output_offset=self.output_offset + self.correction_map @ (pinv @ e),
            constraint_map=free[:, None] * (self.constraint_map - self.rows @ pinv @ F),
            lower=np.where(free, self.lower - offset, -np.inf),
            upper=np.where(free, self.upper - offset, np.inf),
            rows=free[:, None] * (self.rows @ basis),
            correction_map=self.correction_map @ basis,
        )


def _widened(matrix: np.ndarray, width: int) -> np.ndarray:
    """Return a matrix with columns of zeros up to a width."""
    return np.pad(matrix, ((0, 0), (0, width - matrix.shape[1])))


def frozen(arrays: Mapping[str, np.ndarray]) -> Arrays:
    """Return contiguous arrays, doubles except those of single precision."""
    return {
        name: np.ascontiguousarray(value, value.dtype if value.dtype == np.float32 else float)
        for name, value in arrays.items()
    }
