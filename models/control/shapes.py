"""Convex shapes that a command must not enter or must not leave, and their linearization.

The signed distance d to a convex set is a convex function (negative inside), and its unit normal n at a point p is a
subgradient: d(y) ≥ d(p) + nᵀ(y − p) for every y. Two statements follow, however far y is from p:

- Outside: d(y) ≥ 0 everywhere in the half-space nᵀ(y − p) ≥ −d(p). If p is outside the set, the half-space contains p,
  and therefore the straight line from p to every other point of the half-space.
- The linearization error e(y) = d(y) − d(p) − nᵀ(y − p) is never negative: the true distance of a command is at least
  its linearization. For a sphere whose center is at the distance r from p, the error is at most ‖y − p‖² / (2 r).

`MotionConstraintFilter` and the constraints `Outside` of templates use these half-spaces and `CLEARANCE`.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from guiderail.models.common.arrays import as_number, as_numbers
from guiderail.models.common.errors import InputError, brief
from guiderail.models.primitives.constraints import LinearConstraints

CLEARANCE = 1e-8
"""Distance of linearized constraints from a shape, larger than the tolerance of a solver [unit of the output]."""
_HALVINGS = 60  # number of bisections after which the ends of an interval are neighboring floating-point numbers


class ConvexShape(ABC):
    """Convex set in the space of the first D outputs of a command, usually x, y and z, enlarged by a margin.

    Attributes:
        num_dims: Number of dimensions D.
        margin: Distance by which the set is enlarged [unit of the output].
    """

    num_dims: int
    margin: float

    @abstractmethod
    def surface(self, p: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the signed distance of p (D,) from the set, negative inside, and the outward unit normal (D,)."""

    def half_space(self, p: np.ndarray) -> tuple[np.ndarray, float]:
        """Return n (D,) and c of the half-space nᵀ y ≥ c outside of the shape, linearized at p (D,)."""
        distance, normal = self.surface(p)
        return normal, float(normal @ p) - distance

    def distance(self, p: np.ndarray) -> float:
        """Return the signed distance of p (D,), negative inside."""
        return self.surface(p)[0]

    def separate(self, p: np.ndarray, q: np.ndarray) -> tuple[np.ndarray, float]:
        """Return n (D,) and c of a half-space nᵀ y ≥ c outside of the shape that contains the line from p to q (D,).

        The shape is linearized at p or at q if the half-space then contains both points, otherwise at the point of the
        line nearest to the shape. If the line crosses the shape, the half-space contains only a part of the line.
        """
        for at, other in ((p, q), (q, p)):
            n, c = self.half_space(at)
            if n @ other >= c:
                return n, c
        low, high = 0.0, 1.0
        for _ in range(_HALVINGS):
            middle = 0.5 * (low + high)
            _, normal = self.surface(p + middle * (q - p))
            low, high = (middle, high) if normal @ (q - p) < 0.0 else (low, middle)
        return self.half_space(p + 0.5 * (low + high) * (q - p))


def _finite(values: ArrayLike, what: str) -> np.ndarray:
    array = as_numbers(values, what)
    if array.ndim != 1 or not len(array) or not np.isfinite(array).all():
        raise InputError(f"{what} must be finite numbers, not {brief(values)}")
    return array


def _length(value: float, what: str, *, can_be_zero: bool = False) -> float:
    length = as_number(value, what)
    if not (0.0 < length < math.inf or (can_be_zero and length == 0.0)):
        bound = "not negative" if can_be_zero else "positive"
        raise InputError(f"{what} must be finite and {bound}, not {brief(value)}")
    return length


class Sphere(ConvexShape):
    """Ball ‖y − center‖ ≤ radius + margin; in the plane, a disc.

    Args:
        center: Center (D,).
        radius: Radius, positive.
        margin: Distance by which the shape is enlarged, not negative.
    """

    def __init__(self, center: ArrayLike, radius: float, margin: float = 0.0):
        self.center = _finite(center, "the center of a sphere")
        self.radius = _length(radius, "the radius of a sphere")
        self.margin = _length(margin, "a margin", can_be_zero=True)
        self.num_dims = len(self.center)

    def surface(self, p: np.ndarray) -> tuple[float, np.ndarray]:
        """Return distance and normal; at the center, where the normal is not unique, it is the first axis."""
        offset = p - self.center
        length = math.sqrt(offset @ offset)
        normal = offset / length if length > 0.0 else np.eye(self.num_dims)[0]
        return length - self.radius - self.margin, normal


class Box(ConvexShape):
    """Axis-aligned box lower ≤ y ≤ upper, enlarged by the margin with rounded edges; it may extend to infinity.

    Args:
        lower: Lower corner (D,).
        upper: Upper corner (D,), larger in every coordinate.
        margin: Distance by which the shape is enlarged, not negative.

    Raises:
        InputError: If an argument is out of range.
    """

    def __init__(self, lower: ArrayLike, upper: ArrayLike, margin: float = 0.0):
        self.lower, self.upper = as_numbers(lower, "a lower corner"), as_numbers(upper, "an upper corner")
        is_corner = self.lower.ndim == 1 and self.lower.size > 0 and self.lower.shape == self.upper.shape
        if not is_corner or not (self.lower < self.upper).all():
            raise InputError(f"a box needs a lower corner below its upper one, not {brief(lower)} and {brief(upper)}")
        self.margin, self.num_dims = _length(margin, "a margin", can_be_zero=True), len(self.lower)

    def surface(self, p: np.ndarray) -> tuple[float, np.ndarray]:
        """Return distance and normal; inside of the box, those of the nearest face."""
        offset = p - np.clip(p, self.lower, self.upper)
        length = math.sqrt(offset @ offset)
        if length > 0.0:
            return length - self.margin, offset / length
        depths = np.concatenate([p - self.lower, self.upper - p])
        face = int(np.argmin(depths))
        normal = np.zeros(self.num_dims)
        normal[face % self.num_dims] = -1.0 if face < self.num_dims else 1.0
        return -float(depths[face]) - self.margin, normal


class Cylinder(ConvexShape):
    """Solid cylinder between the centers of its two faces, enlarged by the margin with rounded edges.

    Args:
        start: Center of one face (3,).
        end: Center of the other face (3,).
        radius: Radius, positive.
        margin: Distance by which the shape is enlarged, not negative.

    Raises:
        InputError: If an argument is out of range, or both centers are the same point.
    """

    num_dims = 3

    def __init__(self, start: ArrayLike, end: ArrayLike, radius: float, margin: float = 0.0):
        self.start, end = _finite(start, "the start of a cylinder"), _finite(end, "the end of a cylinder")
        if self.start.shape != (3,) or end.shape != (3,) or not np.linalg.norm(end - self.start) > 0.0:
            raise InputError("a cylinder needs two different points in space, start and end")
        self.radius = _length(radius, "the radius of a cylinder")
        self.margin = _length(margin, "a margin", can_be_zero=True)
        self.length = float(np.linalg.norm(end - self.start))
        self.axis = (end - self.start) / self.length

    def surface(self, p: np.ndarray) -> tuple[float, np.ndarray]:
        """Return distance and normal; inside of the cylinder, those of the side or a face, whichever is nearer."""
        along = float(self.axis @ (p - self.start))
        across = p - self.start - along * self.axis
        radius = math.sqrt(across @ across)
        outward = across / radius if radius > 0.0 else _perpendicular(self.axis)
        beyond_side, beyond_face = radius - self.radius, max(-along, along - self.length)
        face = self.axis if along > 0.5 * self.length else -self.axis
        if beyond_side > 0.0 and beyond_face > 0.0:
            length = math.hypot(beyond_side, beyond_face)
            return length - self.margin, (beyond_side * outward + beyond_face * face) / length
        if beyond_side > beyond_face:
            return beyond_side - self.margin, outward
        return beyond_face - self.margin, face


def _perpendicular(axis: np.ndarray) -> np.ndarray:
    """Return a unit vector (3,) perpendicular to a unit vector."""
    other = np.cross(axis, np.eye(3)[int(np.argmin(np.abs(axis)))])
    return other / np.linalg.norm(other)


def linearize(
    shapes: Sequence[ConvexShape], path: np.ndarray, linear: LinearConstraints | None = None
) -> LinearConstraints:
    """Return linear constraints that exclude shapes, linearized around a reference path.

    Step n has two half-spaces per shape, those of the path's points n and n + 1. Consecutive commands therefore have a
    half-space in common, so that the straight line between them is outside of the shape too. The half-spaces have the
    distance `CLEARANCE` from a shape, so that a command that satisfies them up to the solver's tolerance is outside.

    Args:
        shapes: Shapes that commands must not enter.
        path: Reference means (N, O); the first D outputs are positions. If a point is inside of a shape, the half-space
            touches the nearest point of the surface. A path through the middle of a shape therefore does not determine
            the side on which commands pass.
        linear: Further constraints; none by default.
    """
    steps, outputs = path.shape
    rows = [] if linear is None else [linear.window(np.arange(steps))]
    for shape in shapes:
        G, c = np.zeros((steps, 1, outputs)), np.zeros((steps, 1))
        for n, point in enumerate(path[:, : shape.num_dims]):
            G[n, 0, : shape.num_dims], c[n, 0] = shape.half_space(point)
        c += CLEARANCE
        after = np.minimum(np.arange(steps) + 1, steps - 1)
        rows += [(G, c), (G[after], c[after])]
    if not rows:
        return LinearConstraints.none(outputs)
    return LinearConstraints(*(np.concatenate(parts, axis=1) for parts in zip(*rows, strict=True)))
