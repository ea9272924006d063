"""Projects requested poses into the active constraints (thesis, equation 2.21)."""

import math
from collections.abc import Mapping

import numpy as np
from pydrake.math import RigidTransform
from pydrake.systems.framework import (
    BasicVector,
    Context,
    DiscreteValues,
    EventStatus,
    InputPort,
    LeafSystem,
    OutputPort,
)

from guiderail.models.common.errors import InputError
from guiderail.models.common.poses import pose_to_transform, transform_to_pose
from guiderail.models.templates.template import INSIDE, SharedControlTemplate
from guiderail.systems.support.caching import declare_cache
from guiderail.systems.support.sampling import check_period
from guiderail.systems.support.template_frames import TemplateFrames


class ActiveConstraintProjector(LeafSystem):
    """Applies the active constraints of a shared control template's current state to requested poses.

        H^ac = project_q(H^im), reachable in one period from the last command    (equation 2.21)

    (`SharedControlTemplate.command`). The last command is state; it is initialized with the measured pose, as far inside the
    constraints as one period leads. Between two control instants the output is a pure function of it and of the
    request. The last safe command is repeated, and ``fallback`` is 1, where a request or the measured pose is not
    finite, and where the tracking error exceeds its bound and the request would not reduce it: the command waits for a
    robot that is held back. Constraints hold while it waits, too: where a transition or a moved object leaves the last
    command outside of them, it is led inside.

    .. pydrake_system::

        name: ActiveConstraintProjector
        input_ports:
        - requested_pose
        - pose
        - state
        output_ports:
        - desired_pose
        - last_desired_pose
        - fallback
        - commanded_violation
        - measured_violation

    All poses are (6,), [x y z Rz Ry Rx] in metres and radians; the other ports are (1,). ``state`` is the number of the
    template's state. Violations are the larger of metres and radians from the projection, 0 inside.

    Attributes:
        frames: the poses of the template's objects, which a reset can set.
    """

    def __init__(
        self,
        template: SharedControlTemplate,
        frames: Mapping[str, RigidTransform],
        period: float,
        max_tracking_error: float = np.inf,
    ):
        """
        Args:
            template: the template.
            frames: the poses of its objects by name, in the frame that poses are given in.
            period: between two control steps [s], positive.
            max_tracking_error: distance of the robot from its command beyond which that waits [m], positive.

        Raises:
            InputError: if an argument is out of range, or a frame is missing or not finite. At initialization, if the
                measured pose is not finite.
        """
        super().__init__()
        check_period(period)
        if not max_tracking_error > 0.0:
            raise InputError(f"the greatest tracking error must be positive, not {max_tracking_error} m")
        self._template, self._period, self._max_tracking_error = template, period, max_tracking_error
        self.frames = TemplateFrames(self, template, frames)
        self._requested_pose_port = self.DeclareVectorInputPort("requested_pose", 6)
        self._pose_port = self.DeclareVectorInputPort("pose", 6)
        self._state_port = self.DeclareVectorInputPort("state", 1)

        # The last command, and the pose that was measured when it was given.
        self._last = self.DeclareDiscreteState(12)
        last = self.discrete_state_ticket(self._last)
        constraints = {self._state_port.ticket(), self.frames.ticket}
        self._command = declare_cache(
            self,
            "command",
            self._calc_command,
            prerequisites_of_calc=constraints | {last, self._requested_pose_port.ticket()},
        )
        command = {self._command.ticket()}
        self._desired_pose_port = self.DeclareVectorOutputPort(
            "desired_pose", 6, self._calc_desired_pose, prerequisites_of_calc=command
        )
        self._last_desired_pose_port = self.DeclareVectorOutputPort(
            "last_desired_pose", 6, self._calc_last_desired_pose, prerequisites_of_calc={last}
        )
        self._fallback_port = self.DeclareVectorOutputPort(
            "fallback", 1, self._calc_fallback, prerequisites_of_calc=command
        )
        self._commanded_violation_port = self.DeclareVectorOutputPort(
            "commanded_violation", 1, self._calc_commanded_violation, prerequisites_of_calc=command | constraints
        )
        self._measured_violation_port = self.DeclareVectorOutputPort(
            "measured_violation",
            1,
            self._calc_measured_violation,
            prerequisites_of_calc=constraints | {self._pose_port.ticket()},
        )
        self.DeclareInitializationDiscreteUpdateEvent(self._start)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)

    def get_requested_pose_input_port(self) -> InputPort:
        """The requested pose H^im, (6,)."""
        return self._requested_pose_port

    def get_pose_input_port(self) -> InputPort:
        """The measured pose, (6,)."""
        return self._pose_port

    def get_state_input_port(self) -> InputPort:
        """The number of the template's state, (1,)."""
        return self._state_port

    def get_desired_pose_output_port(self) -> OutputPort:
        """The command H^ac, (6,), inside the active constraints."""
        return self._desired_pose_port

    def get_last_desired_pose_output_port(self) -> OutputPort:
        """The command before this one, (6,): what an input displaces. It is state and never feeds through."""
        return self._last_desired_pose_port

    def get_fallback_output_port(self) -> OutputPort:
        """1 while the last safe command is repeated, (1,)."""
        return self._fallback_port

    def get_commanded_violation_output_port(self) -> OutputPort:
        """How far the command is outside of the constraints, (1,)."""
        return self._commanded_violation_port

    def get_measured_violation_output_port(self) -> OutputPort:
        """How far the measured pose is outside of the constraints, (1,)."""
        return self._measured_violation_port

    def _violation(self, context: Context, pose: np.ndarray) -> float:
        state = int(self._state_port.Eval(context)[0])
        return self._template.violation(state, pose_to_transform(pose), self.frames.eval(context))

    def _calc_command(self, context: Context) -> np.ndarray:
        """The command (6,), and 1 if it waits, else 0."""
        value = context.get_discrete_state(self._last).value()
        last, measured = value[:6], value[6:]
        requested = self._requested_pose_port.Eval(context)
        if np.isfinite(requested).all() and np.isfinite(measured).all():
            desired = self._constrained(context, last, requested)
            tracking_error = math.dist(last[:3], measured[:3])
            waits = tracking_error > self._max_tracking_error and math.dist(desired[:3], measured[:3]) >= tracking_error
            if not waits and np.isfinite(desired).all():
                return np.array([*desired, 0.0])
        # Only where it has to: projecting what is inside already would let it creep by rounding.
        if self._violation(context, last) > INSIDE:
            inside = self._constrained(context, last, last)
            last = inside if np.isfinite(inside).all() else last
        return np.array([*last, 1.0])

    def _constrained(self, context: Context, last: np.ndarray, requested: np.ndarray) -> np.ndarray:
        """What the constraints and one period make of a request, (6,)."""
        command = self._template.command(
            int(self._state_port.Eval(context)[0]),
            pose_to_transform(last),
            pose_to_transform(requested),
            self.frames.eval(context),
            self._period,
        )
        return transform_to_pose(command.X_WE)

    def _calc_desired_pose(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._command.Eval(context)[:6])

    def _calc_last_desired_pose(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(context.get_discrete_state(self._last).value()[:6])

    def _calc_fallback(self, context: Context, output: BasicVector) -> None:
        output.SetAtIndex(0, self._command.Eval(context)[6])

    def _calc_commanded_violation(self, context: Context, output: BasicVector) -> None:
        output.SetAtIndex(0, self._violation(context, self._command.Eval(context)[:6]))

    def _calc_measured_violation(self, context: Context, output: BasicVector) -> None:
        output.SetAtIndex(0, self._violation(context, self._pose_port.Eval(context)))

    def _start(self, context: Context, discrete_state: DiscreteValues) -> EventStatus:
        measured = self._pose_port.Eval(context)
        if not np.isfinite(measured).all():
            raise InputError(f"a template begins where the robot is: its measured pose must be finite, not {measured}")
        X_WE, frames = pose_to_transform(measured), self.frames.eval(context)
        # Not the state port's value: that is decided at this same instant.
        state = self._template.state_at(X_WE, frames)
        command = self._template.command(state, X_WE, X_WE, frames, self._period)
        discrete_state.set_value(np.concatenate([transform_to_pose(command.X_WE), measured]))
        return EventStatus.Succeeded()

    def _update(self, context: Context, discrete_state: DiscreteValues) -> EventStatus:
        # At time zero no step is over yet; an offset of one period instead would not fall on k * period exactly.
        if context.get_time() > 0:
            command, measured = self._command.Eval(context)[:6], self._pose_port.Eval(context)
            discrete_state.set_value(np.concatenate([command, measured]))
        return EventStatus.Succeeded()
