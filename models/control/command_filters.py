"""Filters of commanded positions: projection, a control barrier function, and ATACOM.

The barrier and ATACOM bound the change of a command from one control step to the next by constraints with rows of unit
norm, h(y) = G y − c ≥ 0. If the constraints hold at the first command, they hold at every later one. If a desired
command is not finite, the last command is repeated.

These filters are for residual RL. `MotionConstraintFilter` of `motion_constraints.py` is a `CommandLaw`, too.
"""

import math
from typing import Protocol

import numpy as np

from guiderail.models.common.arrays import is_finite
from guiderail.models.common.errors import InputError
from guiderail.models.primitives import LinearConstraints, UnsolvableError
from guiderail.models.primitives.qp import solve_least_norm


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


_TOLERANCE = 1e-9  # largest violation that counts as rounding [unit of a position]


class CommandLaw(Protocol):
    """Law that computes a safe command from the last and the desired command."""

    num_outputs: int
    needs_pose: bool  # True if `apply` uses the measured pose

    def start(self, pose: np.ndarray) -> np.ndarray:
        """Return the initial state (S,) of a motion from a pose (O,); a state begins with the last command (O,)."""
        ...

    def apply(self, last: np.ndarray, desired: np.ndarray, pose: np.ndarray) -> tuple[np.ndarray, bool]:
        """Return the state (S,) after the state `last`, for a desired command (O,), and True if the law intervened.

        `pose` (O,) is the pose measured in this control step.
        """
        ...


class _LastCommand:
    """Law whose state is the last command."""

    needs_pose = False

    def start(self, pose: np.ndarray) -> np.ndarray:
        """Return the initial state, a copy of the pose (O,) at which a motion begins."""
        return pose.copy()


class KeepOutFilter(_LastCommand):
    """Projection of commands by active constraints, from the measured pose (thesis, section 4.4.1).

    `KeepOut.project` moves a command out of boxes and into linear constraints. It intervenes if a box changes the
    command, but not if only the linear constraints do.

    Args:
        keep_out: Boxes and constraints, with their margin.

    Attributes:
        num_outputs: Number of outputs O.
    """

    needs_pose = True

    def __init__(self, keep_out: KeepOut):
        self._keep_out, self.num_outputs = keep_out, keep_out.num_outputs

    def apply(self, last: np.ndarray, desired: np.ndarray, pose: np.ndarray) -> tuple[np.ndarray, bool]:
        """Return the safe command (O,), and True if a box changed it or the last command is repeated."""
        if not (is_finite(desired) and is_finite(pose)):
            return last.copy(), True
        return self._keep_out.project(pose, desired)


class BarrierFilter(_LastCommand):
    """Discrete-time control barrier function on commands (Agrawal and Sreenath, 2017).

    The safe command is the command nearest to the desired one for which no barrier decreases by more than a fraction γ:

        h(y_{k+1}) ≥ (1 − γ) h(y_k)

    The barrier of a keep-out box is the barrier of the face with the largest clearance at the last command (nonsmooth:
    Glotfelter, Cortés and Egerstedt, 2017). With γ = 1 the filter is a projection.

    Args:
        keep_out: Boxes and constraints, with their margin.
        decay: γ in (0, 1].

    Raises:
        InputError: If γ is out of range.

    Attributes:
        num_outputs: Number of outputs O.
    """

    def __init__(self, keep_out: KeepOut, decay: float = 0.2):
        if not 0.0 < decay <= 1.0:
            raise InputError(f"a barrier decays by a fraction in (0, 1] per step, not {decay}")
        self._keep_out, self._decay = keep_out, decay
        self.num_outputs = keep_out.num_outputs

    def apply(self, last: np.ndarray, desired: np.ndarray, pose: np.ndarray | None = None) -> tuple[np.ndarray, bool]:
        """Return the safe command (O,), and True if it differs from the desired one.

        If no allowed command is found, the last command is repeated. This can happen while the last command is not
        allowed itself.
        """
        if not is_finite(desired):
            return last.copy(), True
        G, c = self._keep_out.half_spaces(last)
        bounds = c + (1.0 - self._decay) * (G @ last - c)
        missing = bounds - G @ desired
        if not missing.size or missing.max() <= _TOLERANCE:
            return desired.copy(), False
        try:
            move, _ = solve_least_norm(G.copy(), missing, np.full(len(c), np.inf))
        except UnsolvableError:
            return last.copy(), True
        return _last_allowed(last, desired + move, G, np.minimum(c, G @ last)), True


class TangentSpaceFilter(_LastCommand):
    """Motion of commands in the tangent space of the constraint manifold (ATACOM; Liu et al., 2022 and 2024).

    Each constraint G y − s = c has a slack s ≥ 0 with the velocity ṡ = (s / σ) μ. A step v = desired − last is
    projected to the null space of the Jacobian [−G, diag(s / σ)] in y and μ:

        y_{k+1} = y_k + v − Gᵀ (G Gᵀ + diag(s / σ)²)⁻¹ G v

    Far from a constraint, the result is the desired command; at a constraint, the command only moves along the
    constraint. A satisfied constraint is left out if the step moves away from it. The projection is only accurate near
    the start of a step. A step that would cross a constraint is therefore shortened to end at the constraint.

    Args:
        keep_out: Boxes and constraints, with their margin. A box is replaced by the face with the largest clearance.
        width: σ, slack at which motion towards a constraint is halved, positive [unit of a position].

    Raises:
        InputError: If σ is not positive and finite.

    Attributes:
        num_outputs: Number of outputs O.
    """

    def __init__(self, keep_out: KeepOut, width: float):
        if not 0.0 < width < np.inf:
            raise InputError(f"the width of a slack must be positive, not {width}")
        self._keep_out, self._width = keep_out, width
        self.num_outputs = keep_out.num_outputs

    def apply(self, last: np.ndarray, desired: np.ndarray, pose: np.ndarray | None = None) -> tuple[np.ndarray, bool]:
        """Return the safe command (O,), and True if the step was shortened or the last command repeated.

        The projection does not count as an intervention, because it changes every step towards a constraint. The
        violation c − G y of a constraint is corrected by the same pseudoinverse, as in ATACOM.
        """
        if not is_finite(desired):
            return last.copy(), True
        G, c = self._keep_out.half_spaces(last)
        if not c.size:
            return desired.copy(), False
        slack, step = G @ last - c, desired - last
        is_approached = (G @ step < 0.0) | (slack < -_TOLERANCE)
        near, slack = G[is_approached], slack[is_approached]
        damped = near @ near.T + np.diag((np.maximum(slack, 0.0) / self._width) ** 2)
        error = near @ step - np.maximum(-slack, 0.0)  # step towards the constraints minus their violation
        goal = last + step - near.T @ np.linalg.lstsq(damped, error, rcond=None)[0]
        is_inside = bool((G @ goal - c >= -_TOLERANCE).all())
        return (goal, False) if is_inside else (_last_allowed(last, goal, G, np.minimum(c, G @ last)), True)


def _last_allowed(last: np.ndarray, goal: np.ndarray, G: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Return the point (O,) nearest to `goal` with G y ≥ c on the line from `last`; `last` must satisfy G y ≥ c."""
    slack, change = G @ last - c, G @ (goal - last)
    share = np.min(np.divide(slack, -change, out=np.ones_like(slack), where=slack + change < 0.0), initial=1.0)
    return np.asarray(last + max(share, 0.0) * (goal - last))
