"""Filters of commanded positions: projection, a control barrier function, and ATACOM.

The barrier and ATACOM bound the change of a command from one control step to the next by constraints with rows of unit
norm, h(y) = G y − c ≥ 0. If the constraints hold at the first command, they hold at every later one. If a desired
command is not finite, the last command is repeated.
"""

from typing import Protocol

import numpy as np

from guiderail.models.common.arrays import is_finite
from guiderail.models.common.errors import InputError
from guiderail.models.control.keep_out import KeepOut
from guiderail.models.primitives import UnsolvableError
from guiderail.models.primitives.qp import solve_least_norm

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
