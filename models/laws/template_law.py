"""Law of a shared control template (thesis, section 2.3).

The three systems of `systems/shared_control_template.py` call its parts with the frames of the moment, hence the
argument `frames`. packages/cpp has the same law in C++ (`template.hpp`), and its tests compare them.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from guiderail.models.common.arrays import as_number
from guiderail.models.common.errors import InputError
from guiderail.models.common.transforms import POSE_SIZE, pose_to_transform, transform_to_pose
from guiderail.models.laws.law import Command, Law
from guiderail.models.templates.parts import Frames
from guiderail.models.templates.template import INSIDE, SharedControlTemplate

ROUNDING = 1e-9  # smallest reduction of a tracking error that counts [m]


def requested_pose(
    template: SharedControlTemplate,
    state: int | None,
    action: np.ndarray,
    pose: np.ndarray,
    frames: Frames,
    period: float,
) -> np.ndarray:
    """Return the requested pose H^im = displace_q(H, map_q(u)), (6,) (equations 2.19 and 2.20).

    It is NaN if an input u (n,) is not finite, or the state is None. `pose` (6,) is H.
    """
    if state is None or not np.isfinite(action).all():
        return np.full(POSE_SIZE, np.nan)
    X_WE = pose_to_transform(pose)
    return transform_to_pose(template.displace(X_WE, template.map(state, action, X_WE, frames, period)))


class TemplateState(NamedTuple):
    """State of a `TemplateLaw`."""

    number: int  # number of the template's state
    last: np.ndarray  # last command (6,)
    measured: np.ndarray  # pose (6,) measured at the same instant


class TemplateLaw(Law):
    """Law of a shared control template: input mapping and active constraints of the template's current state.

    The command is a pose [x y z Rz Ry Rx] in meters and radians. If the requested or the measured pose is not finite,
    the last command is repeated as a fallback. It is also repeated if the tracking error exceeds its limit and the new
    command would not reduce it. A repeated command outside of the constraints is projected into them.

    Args:
        template: Template with n inputs.
        frames: Poses X_WF of the template's objects by name.
        period: Control period [s], positive.
        input_mapping: Second template, whose initial state maps the inputs instead of `template`.
        max_tracking_error: Distance between robot and command beyond which the last command is repeated, unless the new
            one is closer to the robot [m].

    Raises:
        InputError: If active constraints of a state contradict each other, the period is missing or not positive, or
            the largest tracking error is not positive.

    Attributes:
        template, frames, period: Arguments.
    """

    def __init__(
        self,
        template: SharedControlTemplate,
        frames: Frames,
        period: float | None,
        *,
        input_mapping: SharedControlTemplate | None = None,
        max_tracking_error: float = np.inf,
    ):
        super().__init__(POSE_SIZE, (input_mapping or template).inputs)
        if period is None or not 0.0 < period < np.inf:
            raise InputError(f"guidance by a template needs the control period [s], positive, not {period}")
        if not as_number(max_tracking_error, "max_tracking_error") > 0.0:
            raise InputError(f"the largest tracking error must be positive, not {max_tracking_error} m")
        template.check_consistency()
        self.template, self.frames, self.period = template, frames, period
        self._input_mapping, self._max_tracking_error = input_mapping, max_tracking_error
        self.needs_pose = max_tracking_error < np.inf

    def start(self, pose: np.ndarray) -> TemplateState:
        """Return the state at a measured pose (6,); see `start_in`."""
        return self.start_in(pose, self.frames)

    def default_state(self) -> TemplateState:
        """Return a state; see `Law.default_state`."""
        return TemplateState(self.template.initial_state, np.zeros(POSE_SIZE), np.zeros(POSE_SIZE))

    def command(self, state: TemplateState, action: np.ndarray, pose: np.ndarray, wrench: np.ndarray) -> Command:
        """Return the command for an action (A,), a measured pose (O,) and a wrench (W,); see `Law.command`."""
        mapping = self._input_mapping or self.template
        number = state.number if self._input_mapping is None else mapping.initial_state
        requested = requested_pose(mapping, number, action, state.last, self.frames, self.period)
        command, is_fallback = self.constrain(state, requested, self.frames)
        return Command(command, self.violation(state.number, command, self.frames), is_fallback)

    def next(self, state: TemplateState, command: Command, pose: np.ndarray) -> TemplateState:
        """Return the state after a command, at a measured pose (O,); see `Law.next`."""
        X_WE = pose_to_transform(command.pose)
        number = self.template.next_state(state.number, X_WE, self.frames, self.period)
        return TemplateState(number, command.pose, pose)

    def start_in(self, pose: np.ndarray, frames: Frames) -> TemplateState:
        """Return the state at a measured pose (6,), with this pose moved towards the constraints for one period.

        Raises:
            InputError: If the pose or a frame is not finite, or the pose is more than 0.2 m or 1 rad outside of the
                active constraints.
        """
        X_WE = pose_to_transform(pose)
        number = self.template.state_at(X_WE, frames)
        command = self._allowed(number, pose, pose, frames)
        if not np.isfinite(command).all():
            raise InputError(f"the pose and the frames of {self.template.name} must be finite at the start")
        self.template.check_start(X_WE, frames)
        return TemplateState(number, command, pose)

    def constrain(self, state: TemplateState, requested: np.ndarray, frames: Frames) -> tuple[np.ndarray, bool]:
        """Return the command (6,) for a requested pose (6,) and False, or the repeated last command and True."""
        number, last, measured = state
        if np.isfinite(requested).all() and np.isfinite(measured).all():
            desired = self._allowed(number, last, requested, frames)
            tracking_error = math.dist(last[:3], measured[:3])
            reduces_error = math.dist(desired[:3], measured[:3]) < tracking_error - ROUNDING
            is_waiting = tracking_error > self._max_tracking_error and not reduces_error
            if not is_waiting and np.isfinite(desired).all():
                return desired, False
        # Projecting a command that is already inside would move it by rounding errors at every step.
        if self.violation(number, last, frames) > INSIDE:
            inside = self._allowed(number, last, last, frames)
            last = inside if np.isfinite(inside).all() else last
        return last, True

    def violation(self, number: int | None, pose: np.ndarray, frames: Frames) -> float:
        """Return the violation of a state's active constraints by a pose (6,) [m or rad]; for None, of all states."""
        X_WE = pose_to_transform(pose)
        numbers = range(len(self.template.states)) if number is None else (number,)
        return max(self.template.violation(each, X_WE, frames) for each in numbers)

    def _allowed(self, number: int, last: np.ndarray, requested: np.ndarray, frames: Frames) -> np.ndarray:
        """Return the pose (6,) of `SharedControlTemplate.command`."""
        X_WLast, X_WRequest = pose_to_transform(last), pose_to_transform(requested)
        return transform_to_pose(self.template.command(number, X_WLast, X_WRequest, frames, self.period).X_WE)
