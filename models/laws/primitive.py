"""Law of a movement primitive: the demonstrations alone (KMP), KGRL, sKGRL and residual RL."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from guiderail.models.common.arrays import is_finite
from guiderail.models.common.errors import InputError, brief
from guiderail.models.common.transforms import POSE_SIZE, angle_between, nearest_pose
from guiderail.models.control.command_filters import CommandLaw
from guiderail.models.control.motion_constraints import MotionConstraintFilter, MotionConstraints
from guiderail.models.laws.law import Command, Law, checked_vector
from guiderail.models.primitives import LcNsKmp, LinearConstraints, ReferenceTrajectory, UnsolvableError, make_kernel

HISTORY_SOURCES = ("commanded", "measured")


def predict(
    primitive: LcNsKmp,
    step: int,
    null_space_action: np.ndarray,
    history: np.ndarray | None,
    window: np.ndarray | None = None,
) -> np.ndarray | None:
    """Return the output (O,) of a primitive's `predict`; None if no window within the constraints was found.

    With a `window` ((H+1)(O + O²),), its means and covariances replace those of the reference.
    """
    try:
        if window is None:
            return primitive.predict(step, null_space_action, history).output
        means, covariances = np.split(window, [(primitive.horizon + 1) * primitive.num_outputs])
        means = means.reshape(-1, primitive.num_outputs)
        covariances = covariances.reshape(*means.shape, primitive.num_outputs)
        return primitive.predict_window(step, means, covariances, null_space_action, history).output
    except UnsolvableError:
        return None


def output_or_nearest(
    constraints: LinearConstraints, step: int, output: np.ndarray | None, last: np.ndarray
) -> tuple[np.ndarray, bool]:
    """Return a primitive's output (O,) and False, or, for None, the fallback and True.

    The fallback is the point within the constraints of the step that is nearest to the last output (O,), which may
    violate them, because they can differ from those of its own step.
    """
    return (constraints.nearest(last, step), True) if output is None else (output, False)


def appended(history: np.ndarray, output: np.ndarray, *, is_pose: bool) -> np.ndarray:
    """Return the last P outputs (P, O), oldest first, after one more output (O,).

    If outputs are poses with Euler angles, the new angles are those nearest to the newest stored ones (`nearest_pose`).
    """
    return np.concatenate([history[1:], (nearest_pose(output, history[-1]) if is_pose else output)[None]])


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
        InputError: If a tolerance is not positive and finite.
    """

    tolerance: tuple[float, float]  # tolerances of the position [unit of the output] and the rotation [rad], positive
    max_lag: int  # largest number of steps behind the clock, not negative; with 0, progress follows the clock

    def __post_init__(self) -> None:
        if len(self.tolerance) != 2 or not all(0.0 < value < np.inf for value in self.tolerance):
            raise InputError(f"the tolerance of progress is two positive numbers, not {brief(self.tolerance)}")

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


class PrimitiveState(NamedTuple):
    """State of a `PrimitiveLaw`."""

    clock: int  # number of the control step, from 0
    step: int  # step of the motion
    output: np.ndarray  # last output (O,) of the primitive
    history: np.ndarray  # last P poses, oldest first (P, O)
    filtered: np.ndarray  # state of the filter, which begins with the last command; empty without a filter
    is_slowed: bool  # True if the first command exceeds the filter's largest acceleration


class PrimitiveLaw(Law):
    """Law of a movement primitive, followed by a filter of the commands.

        command = filter(LC-NS-KMP(step, gain · action, history) + residual · action)

    Its parameters make the kinds of guidance: KGRL has a `gain`, sKGRL also a primitive with a history, and the
    demonstrations alone (KMP) neither. Residual RL has a `residual`. If no window within the constraints is found, the
    primitive's output is the point nearest to its last output within the constraints of the step.

    Args:
        primitive: Primitive with O outputs and a history of P outputs.
        gain: Raw null-space action per unit of the action (O,); ones by default.
        residual: Displacement of the command per unit of the action (O,); none by default.
        outputs: Indices of the outputs that an action moves, one entry each; all by default.
        history_source: "commanded" for a smooth motion; "measured" for a robot that tracks well or is pushed by an
            operator.
        near: Pose (6,), if outputs are poses with Euler angles. The angles of the first pose of the history are nearest
            to it among those of the same orientation, and those of each later pose nearest to the pose before.
        command_filter: Filter of the commands; none by default. It starts at the pose; a `MotionConstraintFilter`
            starts at rest, or with the velocity of the last two outputs if `start` is given several. If it cannot brake
            within its largest acceleration before it leaves the constraints, the first command exceeds this
            acceleration.
        progress: Rule by which the motion waits for the robot; by default, the clock drives the motion.
        checked: Constraints of the reported violation; by default those of the `MotionConstraintFilter`, or of the
            primitive.
        clip: Constraints to which the command is moved, at the nearest point; none by default.

    Raises:
        InputError: If `history_source` is unknown, or a gain is not finite or has the wrong shape.

    Attributes:
        primitive, gain, residual, outputs, history_source, near, command_filter, progress, checked, clip: Arguments.
    """

    def __init__(
        self,
        primitive: LcNsKmp,
        gain: ArrayLike | None = None,
        *,
        residual: ArrayLike | None = None,
        outputs: Sequence[int] | None = None,
        history_source: Literal["commanded", "measured"] = "commanded",
        near: np.ndarray | None = None,
        command_filter: CommandLaw | None = None,
        progress: StateProgress | None = None,
        checked: LinearConstraints | MotionConstraints | None = None,
        clip: LinearConstraints | None = None,
    ):
        num_outputs = primitive.num_outputs
        self.outputs = list(range(num_outputs)) if outputs is None else list(outputs)
        super().__init__(num_outputs, len(self.outputs))
        if history_source not in HISTORY_SOURCES:
            raise InputError(f"history_source is commanded or measured, not {brief(history_source)}")
        self.primitive, self.history_source, self.near = primitive, history_source, near
        self.gain = np.ones(num_outputs) if gain is None else checked_vector(gain, "gain", num_outputs)
        self.residual = None if residual is None else checked_vector(residual, "residual", num_outputs)
        self.command_filter, self.progress, self.clip = command_filter, progress, clip
        own: Any = getattr(command_filter, "constraints", primitive.constraints)
        self.checked = own if checked is None else checked
        is_measured = history_source == "measured" and primitive.history > 0
        self.needs_pose = is_measured or progress is not None or getattr(command_filter, "needs_pose", False)

    def start(self, pose: np.ndarray) -> PrimitiveState:
        """Return the state at a measured pose (O,), or after the last outputs, oldest first.

        These are (P, O), or at least (2, O) with a `MotionConstraintFilter`.

        Raises:
            InputError: If there are several outputs, but not as many.
        """
        length = self.primitive.history
        lengths = {length or 2, max(length, 2)} if isinstance(self.command_filter, MotionConstraintFilter) else {length}
        if pose.ndim != 1 and len(pose) not in lengths:
            raise InputError(f"pose must be {self.num_outputs} finite numbers, or the last {length} outputs")
        recent = np.atleast_2d(pose)
        first = recent[-1] if self.near is None else nearest_pose(recent[-1], self.near)
        history = recent if len(recent) == length else np.tile(first, (length, 1))
        filtered, is_slowed = np.zeros(0), False
        if isinstance(self.command_filter, MotionConstraintFilter):
            displacement = recent[-1] - recent[-2] if len(recent) > 1 else np.zeros(self.num_outputs)
            filtered = self.command_filter.start(recent[-1], displacement)
            is_slowed = not np.array_equal(filtered[self.num_outputs :], displacement)
        elif self.command_filter is not None:
            filtered = self.command_filter.start(recent[-1])
        primitive = self.primitive
        return PrimitiveState(
            0, 0, primitive.constraints.nearest(primitive.reference.means[0]), history, filtered, is_slowed
        )

    def command(self, state: PrimitiveState, action: np.ndarray, pose: np.ndarray, wrench: np.ndarray) -> Command:
        """Return the command for an action (A,), a measured pose (O,) and a wrench (W,); see `Law.command`."""
        history = state.history if self.primitive.history else None
        predicted = predict(self.primitive, state.step, self.gain * self._spread(action), history)
        output, is_fallback = output_or_nearest(self.primitive.constraints, state.step, predicted, state.output)
        desired, filtered = output, state.filtered
        if self.residual is not None:
            desired = desired + self.residual * self._spread(action)
        if self.clip is not None:
            desired = self.clip.nearest(desired, state.step)
        if self.command_filter is not None:
            filtered, is_changed = self.command_filter.apply(filtered, desired, pose)
            desired = filtered[: self.num_outputs]
            is_fallback = is_fallback or is_changed or state.is_slowed
        violation = self.checked.violation(desired, state.step)
        return Command(desired, violation, is_fallback, (output, filtered))

    def next(self, state: PrimitiveState, command: Command, pose: np.ndarray) -> PrimitiveState:
        """Return the state after a command, at a measured pose (O,); see `Law.next`."""
        clock, history = state.clock + 1, state.history
        if self.primitive.history:
            past = command.pose if self.history_source == "commanded" else pose
            history = appended(history, past, is_pose=self.near is not None)
        step = clock if self.progress is None else self.progress.next_step(state.step, clock, command.pose, pose)
        output, filtered = command.memory
        return PrimitiveState(clock, step, output, history, filtered, False)

    def _spread(self, action: np.ndarray) -> np.ndarray:
        """Return the action on all outputs (O,), zero for outputs that it does not move."""
        spread = np.zeros(self.num_outputs)
        spread[self.outputs] = action
        return spread


SKILL_FILE, PRIMITIVE_FILE = "skill.json", "primitive.npz"


def load_law(folder: Path | str) -> PrimitiveLaw:
    """Return the law of the guidance in a folder that ``guiderail export`` has written.

    Raises:
        InputError: If the folder has no exported skill with a movement primitive.
    """
    folder = Path(folder)
    try:
        skill = json.loads((folder / SKILL_FILE).read_text(encoding="utf-8"))
        settings = skill["primitive"]
        with np.load(folder / PRIMITIVE_FILE) as data:
            arrays = {name: data[name] for name in ("times", "means", "covariances", "G", "c", "gains")}
    except (OSError, ValueError, KeyError) as error:
        raise InputError(f"{folder} is no exported skill ({error}): write it with guiderail export") from error
    primitive = LcNsKmp(
        ReferenceTrajectory(arrays["times"], arrays["means"], arrays["covariances"]),
        kernel=make_kernel(settings["kernel"], settings["length_scale"]),
        constraints=LinearConstraints(arrays["G"], arrays["c"]),
        **{key: settings[key] for key in ("lambda_", "beta", "horizon", "history", "history_variance")},
    )
    return PrimitiveLaw(
        primitive,
        arrays["gains"],
        outputs=[entry["output"] for entry in skill["action"]],
        history_source=settings["history_source"],
        near=primitive.reference.means[0] if primitive.num_outputs == POSE_SIZE else None,
    )
