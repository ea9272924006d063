"""Where an arm is told to go: from where it is to where it is commanded, never faster than it may."""

import numpy as np
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
from guiderail.systems.support.sampling import check_period


class PoseRateLimiter(LeafSystem):
    """Follows a desired pose with limited speed, starting from the measured pose.

    While the authority is zero the output is the measured pose; where there is authority at initialization already, it
    starts from the pose measured then. From then on it goes to the desired pose: at most the speed times the period in
    each period, along a straight line, and each angle on its own the shorter way. A desired pose that keeps to the
    speed is passed on as it is.

    .. pydrake_system::

        name: PoseRateLimiter
        input_ports:
        - desired_pose
        - pose
        - blend_factor
        output_ports:
        - limited_pose

    ``desired_pose``, ``pose`` (measured) and ``limited_pose`` are (6,), [x y z Rz Ry Rx] in metres and radians.
    ``blend_factor`` is (1,), a `TorqueSafetyLimiter`'s.
    """

    def __init__(self, *, period: float, speed: float = 0.25, angular_speed: float = 1.5):
        """
        Args:
            period: [s], positive.
            speed: of the tool centre [m/s], positive.
            angular_speed: of each angle [rad/s], positive.

        Raises:
            InputError: if an argument is out of range.
        """
        super().__init__()
        check_period(period)
        if not 0.0 < speed < np.inf or not 0.0 < angular_speed < np.inf:
            raise InputError(f"a desired pose's speeds must be positive, not {speed} m/s and {angular_speed} rad/s")
        self._step, self._angular_step = speed * period, angular_speed * period
        self._desired_pose_port = self.DeclareVectorInputPort("desired_pose", 6)
        self._pose_port = self.DeclareVectorInputPort("pose", 6)
        self._blend_factor_port = self.DeclareVectorInputPort("blend_factor", 1)
        self._last = self.DeclareDiscreteState(6)
        self._limited_pose_port = self.DeclareVectorOutputPort(
            "limited_pose",
            6,
            self._calc_limited_pose,
            prerequisites_of_calc={
                self._desired_pose_port.ticket(),
                self._pose_port.ticket(),
                self._blend_factor_port.ticket(),
                self.discrete_state_ticket(self._last),
            },
        )
        self.DeclareInitializationDiscreteUpdateEvent(self._start)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._remember)

    def get_desired_pose_input_port(self) -> InputPort:
        """The commanded pose, (6,)."""
        return self._desired_pose_port

    def get_pose_input_port(self) -> InputPort:
        """The measured pose, (6,)."""
        return self._pose_port

    def get_blend_factor_input_port(self) -> InputPort:
        """0 while the arm stands by, (1,)."""
        return self._blend_factor_port

    def get_limited_pose_output_port(self) -> OutputPort:
        """Where the arm is told to be, (6,)."""
        return self._limited_pose_port

    def _limited_pose(self, context: Context) -> np.ndarray:
        if self._blend_factor_port.Eval(context)[0] <= 0.0:
            return self._pose_port.Eval(context)
        last = context.get_discrete_state(self._last).value()
        desired = self._desired_pose_port.Eval(context)
        if not np.isfinite(desired).all():
            return last  # or it would be no number for ever
        change = desired - last
        change[3:] = (change[3:] + np.pi) % (2.0 * np.pi) - np.pi
        distance = float(np.linalg.norm(change[:3]))
        if distance <= self._step and (np.abs(change[3:]) <= self._angular_step).all():
            return desired
        if distance > self._step:
            change[:3] *= self._step / distance
        change[3:] = np.clip(change[3:], -self._angular_step, self._angular_step)
        return last + change

    def _calc_limited_pose(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._limited_pose(context))

    def _start(self, context: Context, discrete_state: DiscreteValues) -> EventStatus:
        discrete_state.set_value(self._pose_port.Eval(context))
        return EventStatus.Succeeded()

    def _remember(self, context: Context, discrete_state: DiscreteValues) -> EventStatus:
        discrete_state.set_value(self._limited_pose(context))
        return EventStatus.Succeeded()
