"""Projection of requested poses into the active constraints (thesis, equation 2.21)."""

from collections.abc import Mapping

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from guiderail.models.laws.template_law import TemplateLaw, TemplateState
from guiderail.models.templates.template import SharedControlTemplate
from guiderail.systems.support import declarations as declare
from guiderail.systems.support.declarations import input_getter, output_getter
from guiderail.systems.support.template_frames import TemplateFrames


class ActiveConstraintProjector(LeafSystem):
    """Project requested poses into the active constraints of a shared control template's current state.

        H^ac = project_q(H^im), reachable in one period from the last command    (equation 2.21)

    H^im is the requested pose, q the template's state and H^ac the command; see `SharedControlTemplate.command`. The
    last command is discrete state. The first command is the measured pose, moved towards the constraints by at most the
    motion of one period. Between control instants, the output depends only on discrete state, H^im and q.

    If the requested pose or the measured pose is not finite, the last safe command is repeated and ``fallback`` is 1.
    The last command is also repeated if the tracking error exceeds its limit and the new command would not reduce it,
    for example while an obstacle blocks the robot. A repeated command can be outside the constraints after a transition
    or the motion of an object; it is then projected into the constraints.

    All poses are (6,), [x y z Rz Ry Rx] in meters and radians; the other ports are (1,). ``state`` is the number of the
    template's state. Each violation output is the largest violation of an active constraint, in meters or radians; it
    is 0 if all active constraints are satisfied. If ``state`` is not the number of a state, the last command is
    repeated with ``fallback`` 1, and the violations are the maxima over all states.

    Args:
        template: Shared control template.
        frames: Poses of the template's object frames by name, in the reference frame of the poses at the ports.
        period: Control period [s], positive.
        max_tracking_error: Limit of the tracking error [m], positive; infinite by default. The tracking error is the
            distance between the last command and the position measured at the same instant.

    Raises:
        InputError: If a frame is missing or not finite, or active constraints of a state contradict each other. At
            initialization, if the measured pose or a frame is not finite, or the measured pose is more than 0.2 m or 1
            rad outside of the active constraints.

    Attributes:
        frames: Poses of the template's object frames, parameters that a reset can set. While ``frame_poses`` (6·k,) is
            connected, the poses of the k frames that it has replace them, for objects that move (`TemplateFrames`).
    """

    def __init__(
        self,
        template: SharedControlTemplate,
        frames: Mapping[str, RigidTransform],
        period: float,
        max_tracking_error: float = np.inf,
    ):
        super().__init__()
        self._law = TemplateLaw(template, {}, period, max_tracking_error=max_tracking_error)
        self._requested_pose_port = self.DeclareVectorInputPort("requested_pose", 6)
        self._pose_port = self.DeclareVectorInputPort("pose", 6)
        self._state_port = self.DeclareVectorInputPort("state", 1)
        self.frames = TemplateFrames(self, template, frames)

        # [last command (6,), pose (6,) measured at the same instant]
        self._last = declare.unset_state(self, 12)
        constraints = [self._state_port, self.frames.ticket]
        self._command = declare.cache_entry(
            self, "command", self._calc_command, [*constraints, self._last, self._requested_pose_port]
        )
        declare.part_output(self, "desired_pose", self._command, lambda command: command[:6], 6)
        declare.output(
            self,
            "last_desired_pose",
            6,
            lambda context: declare.initialized(self, context, self._last)[:6],
            [self._last],
        )
        declare.part_output(self, "fallback", self._command, lambda command: command[6])
        declare.scalar_output(self, "commanded_violation", self._commanded_violation, [self._command, *constraints])
        declare.scalar_output(self, "measured_violation", self._measured_violation, [*constraints, self._pose_port])
        declare.update_after_start(self, period, self._update, self._start)

    get_requested_pose_input_port = input_getter("requested_pose", "requested pose H^im, (6,)")
    get_pose_input_port = input_getter("pose", "measured pose, (6,)")
    get_state_input_port = input_getter("state", "number of the template's state, (1,)")
    get_frame_poses_input_port = input_getter(
        "frame_poses", "poses of the template's frames, (6·k,), instead of the parameters; optional"
    )
    get_desired_pose_output_port = output_getter("desired_pose", "command H^ac, (6,), inside the active constraints")
    get_last_desired_pose_output_port = output_getter("last_desired_pose", "previous command, (6,)")
    get_fallback_output_port = output_getter("fallback", "flag that the last safe command is repeated, (1,)")
    get_commanded_violation_output_port = output_getter("commanded_violation", "violation of the command, (1,)")
    get_measured_violation_output_port = output_getter("measured_violation", "violation of the measured pose, (1,)")

    def _state(self, context: Context) -> int | None:
        return declare.state_number(self._state_port, context, len(self._law.template.states))

    def _calc_command(self, context: Context, value: AbstractValue) -> None:
        """Compute the command and the fallback flag, (7,)."""
        stored = declare.initialized(self, context, self._last)
        last, measured = stored[:6], stored[6:]
        number, command, is_fallback = self._state(context), last, True
        if number is not None:
            requested, frames = self._requested_pose_port.Eval(context), self.frames.eval(context)
            command, is_fallback = self._law.constrain(TemplateState(number, last, measured), requested, frames)
        value.set_value(np.append(command, float(is_fallback)))

    def _commanded_violation(self, context: Context) -> float:
        return self._law.violation(self._state(context), self._command.Eval(context)[:6], self.frames.eval(context))

    def _measured_violation(self, context: Context) -> float:
        return self._law.violation(self._state(context), self._pose_port.Eval(context), self.frames.eval(context))

    def _start(self, context: Context, discrete_state: DiscreteValues) -> None:
        measured = declare.start_pose(self._pose_port.Eval(context))
        # The state port is not read, because the system that outputs the state is initialized at the same instant.
        start = self._law.start_in(measured, self.frames.eval(context))
        discrete_state.set_value(self._last, np.concatenate([start.last, measured]))

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        command, measured = self._command.Eval(context)[:6], self._pose_port.Eval(context)
        discrete_state.set_value(self._last, np.concatenate([command, measured]))
