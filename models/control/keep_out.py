"""Active constraints made by hand: stop before walls and boundaries (thesis, section 4.4.1)."""

import math

import numpy as np

from guiderail.models.primitives import LinearConstraints


class KeepOut:
    """Axis-aligned boxes not to enter and linear constraints to keep, both at a distance.

    A commanded position is projected to the nearest allowed one, and the robot then goes towards that in a straight
    line, until just before it would enter a box: a big step can't jump through a wall.

    Attributes:
        margin: the distance kept, in the unit of a position.
    """

    #: How far before a box a motion stops, so that rounding can't put it inside.
    _GAP = 1e-6

    def __init__(self, lower: np.ndarray, upper: np.ndarray, constraints: LinearConstraints, margin: float):
        """
        Args:
            lower: (B, O) lower corners of the boxes.
            upper: (B, O) upper corners; a box may extend to infinity.
            constraints: G y ≥ c on (O,) positions, the same at every step.
            margin: the distance to keep from boxes and constraints, not negative.

        Raises:
            ValueError: if shapes don't fit, a box is empty, or the margin is negative.
        """
        self._lower = np.atleast_2d(np.asarray(lower, dtype=float))
        self._upper = np.atleast_2d(np.asarray(upper, dtype=float))
        if self._lower.shape != self._upper.shape or not (self._lower < self._upper).all():
            raise ValueError("each box needs a lower corner below its upper corner")
        if constraints.num_outputs != self._lower.shape[1] or constraints.num_steps is not None:
            raise ValueError(f"constraints must be constant and on {self._lower.shape[1]} outputs, as the boxes are")
        if not margin >= 0:
            raise ValueError(f"the margin must not be negative, not {margin}")
        self.margin = float(margin)
        norms = np.linalg.norm(constraints.G, axis=1)
        self._constraints = LinearConstraints(constraints.G, constraints.c + self.margin * norms)
        # A few boxes in the plane or in space: plain numbers are several times faster than arrays of two.
        self._boxes = [(lower.tolist(), upper.tolist()) for lower, upper in zip(self._lower, self._upper, strict=True)]

    @property
    def num_outputs(self) -> int:
        """O."""
        return self._lower.shape[1]

    def project(self, position: np.ndarray, desired: np.ndarray) -> tuple[np.ndarray, bool]:
        """Where to go instead of `desired` (O,) from `position` (O,), and whether a box is the reason for it."""
        target, pushed = self._outside(self._inside(desired))
        if pushed:
            target = self._inside(target)
        reach = self._free_fraction(position.tolist(), target.tolist())
        if reach < 1.0:
            length = float(np.linalg.norm(target - position))
            return position + max(reach - self._GAP / length, 0.0) * (target - position), True
        return target, pushed

    def _inside(self, desired: np.ndarray) -> np.ndarray:
        """The nearest point within the constraints."""
        G, c = self._constraints.G, self._constraints.c
        violation = c - G @ desired
        if not violation.size or violation.max() <= 0:
            return desired
        # Where moving straight out of the worst one is enough, that is the nearest point, and no QP is needed.
        worst = int(np.argmax(violation))
        nearest = desired + violation[worst] / (G[worst] @ G[worst]) * G[worst]
        if (c - G @ nearest).max() <= 1e-12:
            return nearest
        return self._constraints.nearest(desired)

    def _outside(self, desired: np.ndarray) -> tuple[np.ndarray, bool]:
        """The nearest point on a face of the boxes that `desired` is in."""
        point, pushed, margin = desired.tolist(), False, self.margin
        for lower, upper in self._boxes:
            # Depth below each face: (depth, axis, where the face is).
            faces = [
                face
                for axis, x in enumerate(point)
                for face in (
                    (x - (lower[axis] - margin), axis, lower[axis] - margin - self._GAP),
                    (upper[axis] + margin - x, axis, upper[axis] + margin + self._GAP),
                )
            ]
            depth, axis, where = min(faces)
            if depth > 0:
                point[axis] = where
                pushed = True
        return np.array(point), pushed

    def _free_fraction(self, start: list[float], end: list[float]) -> float:
        """How much of the way from `start` to `end` is outside all boxes: 1 for all of it."""
        free = 1.0
        for lower, upper in self._boxes:
            # A robot that is already nearer to a box than the margin, or in it (someone pushed it), may leave but not
            # come nearer: the box is taken as small as that.
            clearance = max(max(a - x, x - b) for a, b, x in zip(lower, upper, start, strict=True))
            margin = min(clearance, self.margin)
            enter, leave = -math.inf, math.inf
            for a, b, x, y in zip(lower, upper, start, end, strict=True):
                a, b, way = a - margin, b + margin, y - x
                if way == 0:
                    # Parallel to two faces: between them all the way, or never.
                    if not a < x < b:
                        leave = -math.inf
                    continue
                first, second = (a - x) / way, (b - x) / way
                enter, leave = max(enter, min(first, second)), min(leave, max(first, second))
            # It starts outside, so that less than zero is rounding, or a box that it already left behind.
            if -1e-9 <= enter < min(leave, free):
                free = max(enter, 0.0)
        return free
