"""Law of guidance: the command of each control step as a function of a state, an action and the measurements."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from guiderail.models.common.arrays import as_numbers, is_finite
from guiderail.models.common.errors import InputError, brief
from guiderail.models.common.registry import check_methods


class Command(NamedTuple):
    """Command of one control step."""

    pose: np.ndarray  # commanded pose (O,)
    violation: float = -np.inf  # largest constraint violation; negative inside, −inf without constraints
    fallback: bool = False  # True if a safe pose is commanded instead of the requested one
    memory: Any = None  # further values that `Law.next` needs


class Law:
    """Guidance as a law on arrays: the command of each control step from the policy's action and the measurements.

        command_k = command(state_k, action_k, pose_k, wrench_k),    state_{k+1} = next(state_k, command_k, pose_{k+1})

    A subclass implements `command`. By default, the state is the last command, at first the measured pose. With `start`
    and `next`, the state is any array, or a named tuple of arrays, numbers and such tuples, of constant size. The
    methods must not keep values elsewhere, because a reset restores only the state.

    Args:
        num_outputs: Size O of the pose and of the command, at least 1.
        num_actions: Size A of the action, at least 1; O by default.
        known: Prior knowledge of the task in a Drake diagram; None elsewhere.

    Attributes:
        num_outputs, num_actions, known: Arguments.
        needs_pose: True if the law uses poses that are measured after the start.
    """

    needs_pose = True

    def __init__(self, num_outputs: int, num_actions: int | None = None, known: Any = None):
        num_actions = num_outputs if num_actions is None else num_actions
        self.num_outputs, self.num_actions, self.known = num_outputs, num_actions, known

    def start(self, pose: np.ndarray) -> Any:
        """Return the state at the start of an episode at a measured pose (O,)."""
        return pose

    def default_state(self) -> Any:
        """Return a state before the start, for the sizes of its arrays."""
        return self.start(np.zeros(self.num_outputs))

    def command(self, state: Any, action: np.ndarray, pose: np.ndarray, wrench: np.ndarray) -> Command | np.ndarray:
        """Return the command of a control step, as a `Command` or as a pose (O,).

        Args:
            state: State of this control step.
            action: Policy's action (A,), in [−1, 1].
            pose: Measured pose (O,).
            wrench: Measured wrench (W,); empty if there is none.
        """
        raise NotImplementedError

    def next(self, state: Any, command: Command, pose: np.ndarray) -> Any:
        """Return the state of the next control step.

        Args:
            state: State of the last control step.
            command: Command of the last control step.
            pose: Pose (O,) measured at the beginning of the next control step.
        """
        return command.pose


def check_law(law: object) -> None:
    """Raise an InputError unless an object is a `Law` whose `command` takes state, action, pose and wrench."""
    if not isinstance(law, Law) or not hasattr(law, "num_outputs"):
        raise InputError(f"guidance needs a Law, whose constructor calls that of Law, not {brief(law)}")
    check_methods(type(law), Law)
    if type(law).command is Law.command:
        raise InputError(f"{type(law).__name__} needs a method command(self, state, action, pose, wrench)")


def check_command(returned: Any, num_outputs: int) -> Command:
    """Return the result of `Law.command` as a `Command` with a pose (O,) of numbers, which need not be finite.

    Raises:
        InputError: If the pose is anything else.
    """
    command = returned if isinstance(returned, Command) else Command(returned)
    try:
        pose = np.asarray(command.pose)
    except ValueError:
        pose = np.zeros(0)
    if pose.shape != (num_outputs,) or pose.dtype.kind not in "fiu":
        raise InputError(f"a law must command {num_outputs} numbers, not {brief(command.pose)}")
    return command._replace(pose=pose.astype(float, copy=False))


def safe_command(returned: Any, last: np.ndarray) -> Command:
    """Return the result of `Law.command` as a `Command`; without O finite numbers, repeat the last pose (O,)."""
    try:
        command = check_command(returned, len(last))
    except InputError:
        return Command(last, fallback=True)
    return command if is_finite(command.pose) else command._replace(pose=last, fallback=True)


class Stepper:
    """Stepper of a law: computes the commands of an episode, one for each control step, without a diagram.

    Args:
        law: Law.
        pose: Measured pose (O,) at the start. A `PrimitiveLaw` also continues from several last outputs (n, O).

    Raises:
        InputError: If the pose has the wrong shape or is not finite.

    Attributes:
        law: Law.
        num_steps: Number of steps taken.
    """

    def __init__(self, law: Law, pose: ArrayLike):
        self.law, self.num_steps = law, 0
        start = as_numbers(pose, "pose")
        if start.shape[-1:] != (law.num_outputs,) or not np.isfinite(start).all():
            raise InputError(f"pose must be {law.num_outputs} finite numbers, not {brief(pose)}")
        self._state = law.start(start)
        self._last = Command(start if start.ndim == 1 else start[-1])

    def step(self, action: ArrayLike, pose: ArrayLike | None = None, wrench: ArrayLike = ()) -> Command:
        """Compute the command of the next control step.

        Args:
            action: Policy's action (A,), in [−1, 1].
            pose: Measured pose (O,); required after the first step if the law `needs_pose`.
            wrench: Measured wrench (W,), for laws that use it.

        Raises:
            InputError: If an argument has the wrong shape or is not finite, or the pose is missing.
        """
        action = checked_vector(action, "action", self.law.num_actions)
        if pose is not None:
            measured = checked_vector(pose, "pose", self.law.num_outputs)
        elif self.law.needs_pose and self.num_steps:
            raise InputError("this law needs the measured pose at every step")
        else:
            measured = self._last.pose
        state = self.law.next(self._state, self._last, measured) if self.num_steps else self._state
        returned = self.law.command(state, action, measured, as_numbers(wrench, "wrench"))
        self._state, self._last = state, safe_command(returned, self._last.pose)
        self.num_steps += 1
        return self._last._replace(pose=self._last.pose.copy())


def checked_vector(values: ArrayLike, what: str, size: int) -> np.ndarray:
    """Return a vector (size,) of finite numbers; `what` is its name in messages.

    Raises:
        InputError: If the values are anything else.
    """
    checked = as_numbers(values, what)
    if checked.shape != (size,) or not np.isfinite(checked).all():
        raise InputError(f"{what} must be {size} finite numbers, not {brief(values)}")
    return checked
