"""Active constraints made by hand: stop before walls and boundaries (thesis, section 4.4.1)."""

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

    @property
    def num_outputs(self) -> int:
        """O."""
        return self._lower.shape[1]

    def project(self, position: np.ndarray, desired: np.ndarray) -> tuple[np.ndarray, bool]:
        """Where to go instead of `desired` (O,) from `position` (O,), and whether a box is the reason for it."""
        target, pushed = self._outside(self._constraints.nearest(desired))
        target = self._constraints.nearest(target)
        reach = self._free_fraction(position, target)
        if reach < 1.0:
            length = np.linalg.norm(target - position)
            return position + max(reach - self._GAP / length, 0.0) * (target - position), True
        return target, pushed

    def _outside(self, desired: np.ndarray) -> tuple[np.ndarray, bool]:
        """The nearest point on a face of the boxes that `desired` is in."""
        pushed = False
        for lower, upper in zip(self._lower - self.margin, self._upper + self.margin, strict=True):
            below, above = desired - lower, upper - desired
            if (below > 0).all() and (above > 0).all():
                depth = np.concatenate([below, above])
                face = int(np.argmin(depth))
                desired, pushed = desired.copy(), True
                axis = face % len(lower)
                desired[axis] = lower[axis] - self._GAP if face < len(lower) else upper[axis] + self._GAP
        return desired, pushed

    def _free_fraction(self, start: np.ndarray, end: np.ndarray) -> float:
        """How much of the way from `start` to `end` is outside all boxes: 1 for all of it."""
        # A robot that is already nearer to a box than the margin, or in it (someone pushed it), may leave but not come
        # nearer: the box is taken as small as that.
        clearance = np.maximum(self._lower - start, start - self._upper).max(axis=1)
        margin = np.minimum(clearance - self._GAP / 2, self.margin)[:, None]
        lower, upper = self._lower - margin, self._upper + margin
        direction = end - start
        with np.errstate(divide="ignore", invalid="ignore"):
            first, second = (lower - start) / direction, (upper - start) / direction
        # Parallel to a face: either between the two faces all the way, or never.
        parallel = direction == 0
        between = (start > lower) & (start < upper)
        enter = np.where(parallel, np.where(between, -np.inf, np.inf), np.minimum(first, second)).max(axis=1)
        leave = np.where(parallel, np.where(between, np.inf, -np.inf), np.maximum(first, second)).min(axis=1)
        hits = (enter < leave) & (enter >= 0) & (enter < 1)
        return float(enter[hits].min()) if hits.any() else 1.0
