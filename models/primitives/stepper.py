"""Stepper of a movement primitive, which computes the commands of an episode without a diagram, and its progress."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import ArrayLike

from guiderail.models.common.arrays import as_numbers, is_finite, is_whole
from guiderail.models.common.errors import InputError, brief
from guiderail.models.common.transforms import POSE_SIZE, angle_between
from guiderail.models.primitives.lc_ns_kmp import LcNsKmp
from guiderail.models.primitives.qp import UnsolvableError

if TYPE_CHECKING:
    from guiderail.models.control.motion_constraints import MotionConstraintFilter


@dataclass(frozen=True)
class Command:
    """Command of one control step.

    Attributes:
        output: Command (O,).
        violation: Largest violation of the constraints, max(c − G y), or of the motion's constraints if there is a
            motion filter; negative if all constraints are slack, −inf without constraints.
        is_fallback: True if no window within the constraints was found, or if the motion filter had to brake, or if the
            first command exceeds the filter's largest acceleration. Without a window, the primitive's output is the
            point nearest to the last command within the constraints of the step.
    """

    output: np.ndarray
    violation: float
    is_fallback: bool


class PrimitiveStepper:
    """Stepper of a primitive: computes the command of each control step, as `LcNsKmpSystem` does in a diagram.

    Args:
        primitive: Primitive with O outputs.
        pose: Measured output (O,) that fills the history, or the last outputs, oldest first: (P, O), or (2, O) for a
            motion filter if P < 2. The first mean of the reference by default.
        gain: Raw null-space action per unit of the action (O,); ones by default.
        history_source: "commanded" for a smooth motion; "measured" for a robot that tracks well or is pushed by an
            operator.
        motion: Filter of the commands by constraints of the motion; none by default. The filter starts at the pose. It
            starts at rest, or with the velocity of the last two outputs if `pose` has several. If the motion cannot
            brake within the largest acceleration before it leaves the constraints, the first command exceeds this
            acceleration.

    Raises:
        InputError: If an argument has the wrong shape or is not finite, or `motion` is not a filter of O outputs.

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
        if motion is not None and getattr(motion, "num_outputs", None) != primitive.num_outputs:
            raise InputError(f"motion is a filter of {primitive.num_outputs} outputs, not {brief(motion)}")
        if motion is not None and not hasattr(motion, "apply"):
            raise InputError(f"motion is a MotionConstraintFilter, not {brief(motion)}")
        self.primitive, self.num_steps = primitive, 0
        self.gain = np.ones(primitive.num_outputs) if gain is None else self._checked(gain, "gain")
        first = primitive.reference.means[0]
        self._is_measured = history_source == "measured"
        recent = self._recent(first if pose is None else pose, has_filter=motion is not None)
        has_past = len(recent) == primitive.history
        self._history = recent if has_past else np.tile(recent[-1], (primitive.history, 1))
        self._last = primitive.constraints.nearest(first)
        self._motion = motion
        if motion is not None:
            displacement = recent[-1] - recent[-2] if len(recent) > 1 else np.zeros(primitive.num_outputs)
            self._state = motion.start(recent[-1], displacement)
            self._is_slowed = not np.array_equal(self._state[primitive.num_outputs :], displacement)

    def step(self, action: ArrayLike, pose: ArrayLike | None = None) -> Command:
        """Compute the command of the next control step.

        Args:
            action: Policy's action (O,), in [−1, 1].
            pose: Measured output (O,); required for a measured history.

        Raises:
            InputError: If an argument has the wrong shape or is not finite, or the pose is missing.
        """
        step, raw, history = self.request(action, pose)
        try:
            return self.finish(self.primitive.predict(step, raw, history).output)
        except UnsolvableError:
            return self.finish(None)

    def request(self, action: ArrayLike, pose: ArrayLike | None = None) -> tuple[int, np.ndarray, np.ndarray | None]:
        """Return the arguments of `LcNsKmp.predict` for the next step; with them, several episodes can form a batch.

        `action` (O,) and `pose` (O,) are those of `step`. Then call `finish` with the predicted output.

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
        """Complete the step, and return the command for a predicted output (O,), or for None if no output was found."""
        constraints = self.primitive.constraints
        is_fallback = output is None
        self._last = constraints.nearest(self._last, self.num_steps) if output is None else output
        violation = constraints.violation(self._last, self.num_steps)
        if self._motion is not None:
            self._state, is_braking = self._motion.apply(self._state, self._last)
            self._last = self._state[: len(self._last)]
            violation = self._motion.constraints.violation(self._last)
            is_fallback, self._is_slowed = is_fallback or is_braking or self._is_slowed, False
        command = Command(self._last.copy(), violation, is_fallback)
        if not self._is_measured:
            self._append(self._last)
        self.num_steps += 1
        return command

    def _recent(self, pose: ArrayLike, *, has_filter: bool) -> np.ndarray:
        """Return the outputs in `pose`, oldest first: (1, O), (P, O), or (2, O) for a motion filter if P < 2."""
        outputs, history = as_numbers(pose, "pose"), self.primitive.history
        lengths = {history or 2, max(history, 2)} if has_filter else {history}
        has_several = outputs.ndim == 2 and len(outputs) in lengths
        return np.array([self._checked(output, "pose") for output in (outputs if has_several else [pose])])

    def _append(self, output: np.ndarray) -> None:
        if self.primitive.history:
            self._history = np.concatenate([self._history[1:], output[None]])

    def _checked(self, values: ArrayLike, what: str) -> np.ndarray:
        checked = as_numbers(values, what)
        if checked.shape != (self.primitive.num_outputs,) or not np.isfinite(checked).all():
            raise InputError(f"{what} must be {self.primitive.num_outputs} finite numbers, not {brief(values)}")
        return checked


@dataclass(frozen=True)
class StateProgress:
    """Progress that waits while the robot does not follow its commands.

    Progress s is a step of the reference. In control step k, it increases by one if the measured pose is near the last
    command, and is constant otherwise (phase stopping, after Ijspeert et al., 2002):

        s_{k+1} = s_k + 1  if ‖y − x‖ ≤ tolerance  or  k + 1 − s_k > max_lag,  else  s_k

    Here y is the last command and x the measured pose. For poses (6,), the distance and the rotation between them must
    each be within their tolerance. Progress never decreases and is at most `max_lag` steps behind the clock. An
    intended contact, such as in a search, can therefore delay the motion by at most `max_lag` steps. The tolerance
    should cover the deviations that contact and tracking cause while nothing blocks the robot.

    Raises:
        InputError: If an argument is out of range.
    """

    tolerance: tuple[float, float]  # tolerances of the position [unit of the output] and the rotation [rad], positive
    # Largest number of steps behind the clock, not negative; with 0, progress follows the clock. (The option `max_lag`
    # of an environment is a time in seconds.)
    max_lag: int

    def __post_init__(self) -> None:
        if len(self.tolerance) != 2 or not all(0.0 < value < np.inf for value in self.tolerance):
            raise InputError(f"the tolerance of progress is two positive numbers, not {brief(self.tolerance)}")
        if not is_whole(self.max_lag, 0):
            raise InputError(f"max_lag must be a whole number of steps, at least 0, not {brief(self.max_lag)}")

    def next_step(self, step: int, clock: int, command: np.ndarray, pose: np.ndarray) -> int:
        """Return the step of the next command.

        Args:
            step: Step of the last command.
            clock: Number of the next control step, from 0.
            command: Last command (O,).
            pose: Measured pose (O,); NaN counts as not near.
        """
        is_pose, error = len(command) == POSE_SIZE, command - pose
        is_near = is_finite(error)
        if is_near:
            distance = error[:3] if is_pose else error
            angle = angle_between(command, pose) if is_pose else 0.0
            is_near = bool(np.sqrt(distance @ distance) <= self.tolerance[0] and angle <= self.tolerance[1])
        return step + 1 if is_near or clock - step > self.max_lag else step
