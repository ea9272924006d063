"""Proofs that no pose satisfies a set of active constraints.

Constraints are compared only with constraints in the same frame, because objects move. A set is reported as
contradictory only if one of these statements is true:

- Two orientations or tilts are disjoint.
- All positions that one constraint allows are inside the region that another constraint excludes.
- The convex parts of the constraints on the position are separated by half-spaces. Let P_i be the projection onto the
  set i, p the approximate minimum of the sum of squared distances from all sets, n_i = p − P_i(p) the normals at p, and
  e their sum. A common point y of all sets satisfies e · (y − p) ≤ −Σ ‖n_i‖², so it is at least Σ ‖n_i‖² / ‖e‖ away
  from p. If this distance exceeds `UNBOUNDED`, the sets are separated.

A contradiction without such a proof is not reported. Kinds of constraint outside of this package are not examined.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from itertools import combinations, product

import numpy as np

from guiderail.models.templates.active_constraints import (
    UNBOUNDED,
    ActiveConstraint,
    Box,
    Cylinder,
    FixedOrientation,
    FrameConstraint,
    Funnel,
    HalfSpace,
    InsideSphere,
    KeepAbove,
    Outside,
    Sector,
    TiltByDistance,
    TiltConstraint,
    TiltLimits,
)
from guiderail.models.templates.parts import chord_angle, matrix_deg

CLEAR = 1e-6  # smallest violation that counts as a contradiction, far above rounding [m or rad]
STEPS = 400  # largest number of gradient steps to the point nearest to all sets

Projection = Callable[[np.ndarray], np.ndarray]


def find_contradiction(constraints: Sequence[ActiveConstraint]) -> tuple[int, ...]:
    """Return the indices of active constraints that no pose satisfies together; none if no contradiction is proven."""
    by_frame: dict[str, list[tuple[int, FrameConstraint]]] = {}
    for i, constraint in enumerate(constraints):
        if isinstance(constraint, FrameConstraint):
            by_frame.setdefault(constraint.frame, []).append((i, constraint))
    for numbered in by_frame.values():
        for (i, a), (j, b) in combinations(numbered, 2):
            if _have_disjoint_orientations(a, b) or _is_excluded(a, b) or _is_excluded(b, a):
                return i, j
        separated = _find_separated(dict(numbered))
        if separated:
            return separated
    return ()


def describe(constraints: Sequence[ActiveConstraint], contradictory: Sequence[int]) -> str:
    """Return a sentence about contradictory active constraints, which are numbered from 1."""
    first, *others = (f"{i + 1} ({type(constraints[i]).__name__})" for i in contradictory)
    both = "both" if len(others) == 1 else "all of them"
    return f"active constraint {first} contradicts {' and '.join(others)}; no pose satisfies {both}: change one"


def _have_disjoint_orientations(a: FrameConstraint, b: FrameConstraint) -> bool:
    """Return True if no orientation satisfies both constraints, at any position."""
    for one, other in ((a, b), (b, a)):
        if isinstance(one, FixedOrientation):
            return _angle_to(other, matrix_deg(one.rpy_deg)) > CLEAR
    tilts = [constraint for constraint in (a, b) if isinstance(constraint, TiltConstraint)]
    if len(tilts) == 2 and tilts[0].rpy_deg == tilts[1].rpy_deg:
        (low, high), (other_low, other_high) = (_tilt_range(tilt) for tilt in tilts)
        if tilts[0].turns_along != tilts[1].turns_along:
            return _gap(*_magnitude_range(low, high), *_magnitude_range(other_low, other_high)) > CLEAR
        return min(_gap(low, high, other_low + turn, other_high + turn) for turn in (-math.tau, 0, math.tau)) > CLEAR
    return False


def _angle_to(constraint: FrameConstraint, R_FE: np.ndarray) -> float:
    """Return a lower bound of the angle [rad] from an orientation to all orientations that a constraint allows."""
    if isinstance(constraint, FixedOrientation):
        return chord_angle(R_FE, matrix_deg(constraint.rpy_deg))
    if isinstance(constraint, TiltConstraint):
        # The rotation is Rz(β) Ry(tilt), or Rz(β) Ry(tilt) Rz(−β), for some bearing β.
        R = R_FE @ matrix_deg(constraint.rpy_deg).T
        tilt = math.atan2(math.hypot(R[0, 2], R[1, 2]), R[2, 2])
        twist = 0.0 if constraint.turns_along else abs(float(R[1, 0] - R[0, 1])) / 2.0
        return max(_gap(tilt, tilt, *_magnitude_range(*_tilt_range(constraint))), twist)
    return 0.0


def _tilt_range(constraint: TiltConstraint) -> tuple[float, float]:
    """Return the smallest and the largest tilt [rad] that a constraint allows at any distance."""
    if isinstance(constraint, TiltByDistance):
        return math.radians(min(constraint.tilt_deg)), math.radians(max(constraint.tilt_deg))
    if isinstance(constraint, TiltLimits):
        return math.radians(constraint.min_deg), math.radians(constraint.max_deg)
    return -math.pi, math.pi


def _magnitude_range(low: float, high: float) -> tuple[float, float]:
    """Return the smallest and the largest magnitude of a tilt between two limits in [−π, π]."""
    return max(0.0, low, -high), max(abs(low), abs(high))


def _gap(low: float, high: float, other_low: float, other_high: float) -> float:
    """Return the distance between two intervals; 0 or less if they overlap."""
    return max(other_low - high, low - other_high)


def _is_excluded(inner: FrameConstraint, outer: FrameConstraint) -> bool:
    """Return True if `outer` excludes all positions that `inner` allows: they are within its shape or near F's axis."""
    if isinstance(outer, Outside):
        if isinstance(inner, InsideSphere):
            return outer.shape.distance(np.array(inner.center_m)) + inner.radius_m < -CLEAR
        if isinstance(inner, Box):
            return all(outer.shape.distance(corner) < -CLEAR for corner in _corners(inner))
        return False
    least = outer.min_radius_m if isinstance(outer, Cylinder) else 0.0
    return _largest_radius(inner) < least - CLEAR


def _corners(box: Box) -> Iterator[np.ndarray]:
    return (np.array(corner) for corner in product(*zip(box.lower_m, box.upper_m, strict=True)))


def _largest_radius(constraint: FrameConstraint) -> float:
    """Return an upper bound of the distance from F's z axis [m] of the positions that a constraint allows."""
    if isinstance(constraint, Cylinder):
        return constraint.max_radius_m
    if isinstance(constraint, InsideSphere):
        return math.hypot(*constraint.center_m[:2]) + constraint.radius_m
    if isinstance(constraint, Box):
        return max(math.hypot(*corner[:2]) for corner in _corners(constraint))
    return math.inf


def _find_separated(constraints: dict[int, FrameConstraint]) -> tuple[int, ...]:
    """Return the numbers of constraints on the position in one frame whose convex parts have no point in common."""
    parts = list(_convex_parts(constraints))
    if len({sources for sources, _ in parts}) < 2:
        return ()
    p = np.mean([project(np.zeros(3)) for _, project in parts], axis=0)
    for _ in range(STEPS):
        normals = np.array([p - project(p) for _, project in parts])
        squares = np.einsum("ij,ij->i", normals, normals)
        if squares.max() < CLEAR**2:
            return ()
        total = normals.sum(axis=0)
        if squares.sum() > UNBOUNDED * math.sqrt(total @ total):
            opposed = (
                sources for (sources, _), square in zip(parts, squares, strict=True) if square > 1e-6 * max(squares)
            )
            return tuple(sorted({number for sources in opposed for number in sources}))
        p = p - total / len(parts)
    return ()


def _convex_parts(constraints: dict[int, FrameConstraint]) -> Iterator[tuple[tuple[int, ...], Projection]]:
    """Yield convex sets as projections, each with the numbers of the constraints from which it is derived.

    A set contains all positions in the frame that its constraints allow.
    """
    narrowest = min(constraints, key=lambda number: _largest_radius(constraints[number]))
    radius = _largest_radius(constraints[narrowest])
    for number, constraint in constraints.items():
        if isinstance(constraint, HalfSpace | Box | InsideSphere):
            yield (number,), constraint.project_position
        elif isinstance(constraint, Cylinder):
            yield (number,), Cylinder(constraint.frame, 0.0, constraint.max_radius_m).project_position
        elif isinstance(constraint, Sector) and constraint.max_deg - constraint.min_deg <= 180:
            # Two half-spaces, because the sector's own projection has a constant radius and is not the nearest point.
            low, high = math.radians(constraint.min_deg), math.radians(constraint.max_deg)
            yield (number,), HalfSpace((-math.sin(low), math.cos(low), 0.0), 0.0).project_position
            yield (number,), HalfSpace((math.sin(high), -math.cos(high), 0.0), 0.0).project_position
        elif isinstance(constraint, KeepAbove):
            points = np.array(constraint.points_m).T
            # At any orientation, the height of a point above E is at most its distance from E.
            yield (number,), _above(constraint.height_m - float(np.linalg.norm(points, axis=0).min()))
            for other, fixed in constraints.items():
                if isinstance(fixed, FixedOrientation) and points.any():
                    height = constraint.height_m - float((matrix_deg(fixed.rpy_deg)[2] @ points).min())
                    yield (number, other), _above(height)
        elif isinstance(constraint, Funnel) and radius < UNBOUNDED:
            ceiling = constraint.height_m + constraint.slope * max(0.0, radius - constraint.radius_m)
            yield (number, narrowest), HalfSpace((0.0, 0.0, -1.0), -ceiling).project_position


def _above(height_m: float) -> Projection:
    return HalfSpace((0.0, 0.0, 1.0), height_m).project_position
