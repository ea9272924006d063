"""Episode of a movement primitive without a diagram: history, gains and fallback, one command per control step."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import ArrayLike

from guiderail.models.common.arrays import as_numbers
from guiderail.models.common.errors import InputError, brief
from guiderail.models.primitives.lc_ns_kmp import LcNsKmp
from guiderail.models.primitives.qp import UnsolvableError

if TYPE_CHECKING:
    from guiderail.models.control.motion_constraints import MotionConstraintFilter


@dataclass(frozen=True)
class Command:
    """Command of one control step.

    Attributes:
        output: Command (O,).
        violation: max(c − G y) of the command, or its violation of the motion's constraints if there is a motion
            filter: negative if all constraints are slack, −inf without constraints.
        is_fallback: True if no window within the constraints was found; the command is then the point within the
            constraints of its step that is nearest to the last command. Also True if only braking was left.
    """

    output: np.ndarray
    violation: float
    is_fallback: bool


class PrimitiveStepper:
    """Commands of a primitive in consecutive control steps, as `LcNsKmpSystem` computes them in a diagram.

    Args:
        primitive: Primitive with O outputs.
        pose: Measured output (O,) that fills the history, or the last P outputs (P, O), oldest first; the first mean by
            default.
        gain: Raw null-space action per unit of the action (O,); ones by default.
        history_source: "commanded" outputs continue the motion smoothly; "measured" ones suit a robot that tracks well
            or is pushed by an operator.
        motion: Filter of the commands by constraints of the motion; none by default. The filter starts at the pose:
            at rest, or with the velocity of the last two outputs if `pose` holds several.

    Raises:
        InputError: If an argument has the wrong shape or is not finite.

    Attributes:
        primitive: Primitive.
        gain: Gain (O,).
        num_steps: Number of steps taken.
    """

    def __init__(
        self,
        primitive: LcNsKmp,
        pose: ArrayLike | None = None,
        gain: ArrayLike | None = None,
        history_source: Literal["commanded", "measured"] = "commanded",
        motion: MotionConstraintFilter | None = None,
    ):
        if history_source not in ("commanded", "measured"):
            raise InputError(f"history_source is commanded or measured, not {brief(history_source)}")
        self.primitive, self.num_steps = primitive, 0
        self.gain = np.ones(primitive.num_outputs) if gain is None else self._checked(gain, "gain")
        first = primitive.reference.means[0]
        self._is_measured = history_source == "measured"
        if pose is not None and np.asarray(pose).shape == (primitive.history, primitive.num_outputs):
            self._history = np.array([self._checked(each, "pose") for each in np.asarray(pose)])
        else:
            self._history = np.tile(first if pose is None else self._checked(pose, "pose"), (primitive.history, 1))
        self._last = primitive.constraints.nearest(first)
        self._motion = motion
        if motion is not None:
            recent = np.atleast_2d(first if pose is None else np.asarray(pose, dtype=float))
            self._state = motion.start(recent[-1])
            if len(recent) > 1:
                self._state[primitive.num_outputs :] = recent[-1] - recent[-2]

    def step(self, action: ArrayLike, pose: ArrayLike | None = None) -> Command:
        """Compute the command of the next control step.

        Args:
            action: Policy's action (O,), in [−1, 1].
            pose: Measured output (O,); required for a measured history.

        Raises:
            InputError: If an argument has the wrong shape or is not finite, or a measured history has no pose.
        """
        step, raw, history = self.request(action, pose)
        try:
            return self.finish(self.primitive.predict(step, raw, history).output)
        except UnsolvableError:
            return self.finish(None)

    def request(self, action: ArrayLike, pose: ArrayLike | None = None) -> tuple[int, np.ndarray, np.ndarray | None]:
        """Return the arguments of `LcNsKmp.predict` for the next step, for a batch of several episodes.

        Args:
            action: Policy's action (O,), as in `step`.
            pose: Measured output (O,), as in `step`.

        Raises:
            InputError: As `step`.
        """
        action = self._checked(action, "action")
        if self._is_measured and self.num_steps and self.primitive.history:
            if pose is None:
                raise InputError("a measured history needs the measured pose at every step")
            self._append(self._checked(pose, "pose"))
        return self.num_steps, self.gain * action, self._history if self.primitive.history else None

    def finish(self, output: np.ndarray | None) -> Command:
        """Complete the step: return the command for a predicted output (O,), or for None if no output was found."""
        constraints = self.primitive.constraints
        is_fallback = output is None
        self._last = constraints.nearest(self._last, self.num_steps) if output is None else output
        violation = constraints.violation(self._last, self.num_steps)
        if self._motion is not None:
            self._state, is_braking = self._motion.apply(self._state, self._last)
            self._last = self._state[: len(self._last)]
            violation, is_fallback = self._motion.constraints.violation(self._last), is_fallback or is_braking
        command = Command(self._last, violation, is_fallback)
        if not self._is_measured:
            self._append(self._last)
        self.num_steps += 1
        return command

    def _append(self, output: np.ndarray) -> None:
        if self.primitive.history:
            self._history = np.concatenate([self._history[1:], output[None]])

    def _checked(self, values: ArrayLike, what: str) -> np.ndarray:
        checked = as_numbers(values, what)
        if checked.shape != (self.primitive.num_outputs,) or not np.isfinite(checked).all():
            raise InputError(f"{what} must be {self.primitive.num_outputs} finite numbers, not {brief(values)}")
        return checked
