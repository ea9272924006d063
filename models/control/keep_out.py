"""Manually defined active constraints: stop before walls and boundaries (thesis, section 4.4.1)."""

import math

import numpy as np

from guiderail.models.common.arrays import is_finite
from guiderail.models.common.errors import InputError
from guiderail.models.primitives import LinearConstraints, UnsolvableError


class KeepOut:
    """Linear constraints, and axis-aligned boxes that must not be entered, both with a margin.

    A desired position is projected onto the constraints, and out of a box through the nearest face. The motion towards
    the projected position ends before a box, so that a large step cannot jump through a wall.

    Args:
        lower: Lower corners of the boxes (B, O).
        upper: Upper corners of the boxes (B, O); a box may extend to infinity.
        constraints: G y ≥ c on positions (O,), the same at every step.
        margin: Distance from boxes and constraints [unit of a position], finite and not negative.

    Raises:
        InputError: If shapes do not match, a box is empty, the margin is out of range, or the constraints change from
            step to step or contradict each other with the margin.

    Attributes:
        margin: Distance from boxes and constraints [unit of a position].
    """

    _GAP = 1e-6  # distance from a box at which a motion stops, so that rounding cannot put the position inside

    def __init__(self, lower: np.ndarray, upper: np.ndarray, constraints: LinearConstraints, margin: float):
        self._lower = np.atleast_2d(np.asarray(lower, dtype=float))
        self._upper = np.atleast_2d(np.asarray(upper, dtype=float))
        if self._lower.shape != self._upper.shape or not (self._lower < self._upper).all():
            raise InputError("each box needs a lower corner below its upper corner")
        if constraints.num_outputs != self._lower.shape[1] or constraints.num_steps is not None:
            raise InputError(f"constraints must be constant and on {self._lower.shape[1]} outputs, like the boxes")
        if not 0 <= margin < math.inf:
            raise InputError(f"a margin must be finite and 0 or more, not {margin}")
        self.margin = float(margin)
        norms = np.linalg.norm(constraints.G, axis=1)
        self._constraints = LinearConstraints(constraints.G, constraints.c + self.margin * norms)
        # For a few boxes in the plane or in space, Python numbers are several times faster than small arrays.
        self._boxes = [(lower.tolist(), upper.tolist()) for lower, upper in zip(self._lower, self._upper, strict=True)]

    @property
    def num_outputs(self) -> int:
        """Number of outputs O."""
        return self._lower.shape[1]

    def project(self, position: np.ndarray, desired: np.ndarray) -> tuple[np.ndarray, bool]:
        """Return the allowed position (O,) for a current and a desired one (O,), and True if a box changed it.

        Raises:
            UnsolvableError: If a position is not finite.
        """
        if not (is_finite(position) and is_finite(desired)):
            raise UnsolvableError(f"positions must be finite to stop before walls, not {position} and {desired}")
        target, was_in_box = self._project_to_faces(self._project_to_constraints(desired))
        if was_in_box:
            target = self._project_to_constraints(target)
        reach = self._free_fraction(position.tolist(), target.tolist())
        if reach < 1.0:
            length = float(np.linalg.norm(target - position))
            return position + max(reach - self._GAP / length, 0.0) * (target - position), True
        return target, was_in_box

    def half_spaces(self, position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return half-spaces G y ≥ c, G (F, O) with rows of unit norm and c (F,), for a position (O,).

        The half-spaces are the constraints and, for each box, the half-space outside of the face with the largest
        clearance at the position, both with the margin.
        """
        below, above = self._lower - position, position - self._upper
        clearance = np.hstack([below, above])
        face = np.argmax(clearance, axis=1)
        rows = np.vstack([-np.eye(self.num_outputs), np.eye(self.num_outputs)])[face]
        bounds = np.hstack([-self._lower, self._upper])[np.arange(len(face)), face] + self.margin
        G, c = self._constraints.G, self._constraints.c
        return np.vstack([G, rows]), np.append(c, bounds)

    def _project_to_constraints(self, desired: np.ndarray) -> np.ndarray:
        """Return the nearest point within the constraints."""
        G, c = self._constraints.G, self._constraints.c
        violation = c - G @ desired
        if not violation.size or violation.max() <= 0:
            return desired
        # If the projection to the most violated constraint satisfies all of them, no QP is needed.
        worst = int(np.argmax(violation))
        nearest = desired + violation[worst] / (G[worst] @ G[worst]) * G[worst]
        if (c - G @ nearest).max() <= 1e-12:
            return nearest
        return self._constraints.nearest(desired)

    def _project_to_faces(self, desired: np.ndarray) -> tuple[np.ndarray, bool]:
        """Return the nearest point on a face of the boxes that contain `desired`, and True if there is such a box."""
        point, was_in_box, margin = desired.tolist(), False, self.margin
        for lower, upper in self._boxes:
            # Each face: depth of the point behind the face, axis, coordinate just outside of the face.
            faces = [
                face
                for axis, x in enumerate(point)
                for face in (
                    (x - (lower[axis] - margin), axis, lower[axis] - margin - self._GAP),
                    (upper[axis] + margin - x, axis, upper[axis] + margin + self._GAP),
                )
            ]
            depth, axis, face_position = min(faces)
            if depth > 0:
                point[axis] = face_position
                was_in_box = True
        return np.array(point), was_in_box

    def _free_fraction(self, start: list[float], end: list[float]) -> float:
        """Return the fraction of the line from `start` (O,) to `end` (O,) before the first box."""
        free = 1.0
        for lower, upper in self._boxes:
            # If the start is closer to a box than the margin, or inside of it (after a push), the margin is reduced to
            # the clearance of the start: the motion may leave the box but not come closer.
            clearance = max(max(a - x, x - b) for a, b, x in zip(lower, upper, start, strict=True))
            margin = min(clearance, self.margin)
            enter, leave = -math.inf, math.inf
            for a, b, x, y in zip(lower, upper, start, end, strict=True):
                a, b, displacement = a - margin, b + margin, y - x
                if displacement == 0:
                    # The line is parallel to two faces: all of it is between them, or none.
                    if not a < x < b:
                        leave = -math.inf
                    continue
                first, second = (a - x) / displacement, (b - x) / displacement
                enter, leave = max(enter, min(first, second)), min(leave, max(first, second))
            # The start is outside of the box. A negative `enter` is a rounding error, or the box is behind the start.
            if -1e-9 <= enter < min(leave, free):
                free = max(enter, 0.0)
        return free
