"""Arrays of the laws of a skill, as the C++ library reads them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from guiderail.models.common.errors import InputError
from guiderail.models.laws.primitive import PrimitiveLaw
from guiderail.models.primitives import LcNsKmp, LinearConstraints
from guiderail.models.primitives.window import StepFactor

Arrays = dict[str, np.ndarray]
"""Arrays of doubles by name."""
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
        InputError: If a lower bound is equal to its upper bound: the solver needs thousands of iterations for the
            many dependent equations of a window.
    """
    primitive = law.primitive
    gain = law.gain[:, None] * np.eye(law.num_outputs)[:, law.outputs]  # (O, A), per unit of each entry of the action
    factors = [_factor(primitive, step) for step in range(primitive.num_steps)]
    if any((factor.upper - factor.lower < _EQUAL).any() for factor in factors):
        raise InputError("constraints with equal lower and upper bounds cannot be exported: widen them a little")
    rows = [factor.constraint_rows for factor in factors]
    width = max(row.shape[1] for row in rows)
    arrays = {
        "primitive/output_map": [factor.output_map for factor in factors],
        "primitive/output_offset": [factor.output_offset for factor in factors],
        "primitive/constraint_map": [factor.constraint_map for factor in factors],
        "primitive/lower": [factor.lower for factor in factors],
        "primitive/upper": [factor.upper for factor in factors],
        "primitive/scale": [_scale(factor) for factor in factors],
        "primitive/constraint_rows": [_widened(row, width) for row in rows],
        "primitive/correction_map": [_widened(factor.correction_map, width) for factor in factors],
        "primitive/rank": [float(row.shape[1]) for row in rows],
        "primitive/gain": gain,
        "primitive/initial_command": primitive.constraints.nearest(primitive.reference.means[0]),
        "primitive/first_mean": primitive.reference.means[0],
        "primitive/is_measured": [float(law.history_source == "measured")],
    }
    stacked = {name: np.asarray(values, dtype=float) for name, values in arrays.items()}
    return stacked | constraint_arrays(primitive.constraints)


def _factor(primitive: LcNsKmp, step: int) -> StepFactor:
    history = np.tile(primitive.reference.means[0], (primitive.history, 1)) if primitive.history else None
    return primitive.predict(step, None, history).factor


def _scale(factor: StepFactor) -> np.ndarray:
    """Return the scale (m,) of each constrained direction."""
    alpha = factor.multipliers(np.full(len(factor.lower), -1.0))
    return alpha[alpha > 0.0]


def _widened(matrix: np.ndarray, width: int) -> np.ndarray:
    """Return a matrix with columns of zeros up to a width."""
    return np.pad(matrix, ((0, 0), (0, width - matrix.shape[1])))


def frozen(arrays: Mapping[str, np.ndarray]) -> Arrays:
    """Return contiguous arrays, doubles except those of single precision."""
    return {
        name: np.ascontiguousarray(value, value.dtype if value.dtype == np.float32 else float)
        for name, value in arrays.items()
    }
