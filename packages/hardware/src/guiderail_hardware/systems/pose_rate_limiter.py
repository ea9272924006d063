"""Rate limiter of a desired pose."""

import numpy as np
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from guiderail.models.common.arrays import as_number, is_finite
from guiderail.models.common.errors import InputError
from guiderail.models.common.transforms import pose_difference
from guiderail.systems.support import declarations as declare
from guiderail.systems.support.declarations import input_getter, output_getter


class PoseRateLimiter(LeafSystem):
    """Follow a desired pose with limited speed, starting from the measured pose.

    While the blend factor is zero or NaN, the output is the measured pose. While the factor is positive, the output
    moves from there, or from the pose measured at initialization, towards the desired pose. In each period, the
    position moves along a straight line by at most speed times period, and each angle changes separately in the shorter
    direction. If the desired pose can be reached within the speed limits, it is output unchanged. If the measured pose
    is not finite while the factor is zero, or the desired pose while the factor is positive, the last output is
    repeated.

    .. pydrake_system::

        name: PoseRateLimiter
        input_ports:
        - desired_pose
        - pose
        - blend_factor
        output_ports:
        - limited_pose

    ``desired_pose``, ``pose`` (measured) and ``limited_pose`` are (6,), [x y z Rz Ry Rx] in meters and radians.
    ``blend_factor`` is (1,), from a `TorqueSafetyLimiter`.

    Args:
        period: Sampling period [s], positive.
        speed: Speed limit of the tool center [m/s], positive.
        angular_speed: Speed limit of each angle [rad/s], positive.

    Raises:
        InputError: If an argument is out of range. At initialization, if the measured pose is not finite.
    """

    def __init__(self, *, period: float, speed: float = 0.25, angular_speed: float = 1.5):
        super().__init__()
        declare.check_period(period)
        if not all(0.0 < as_number(limit, "a speed limit") < np.inf for limit in (speed, angular_speed)):
            raise InputError(f"the speed limits must be positive and finite, not {speed} m/s and {angular_speed} rad/s")
        self._step, self._angular_step = speed * period, angular_speed * period
        self._desired_pose_port = self.DeclareVectorInputPort("desired_pose", 6)
        self._pose_port = self.DeclareVectorInputPort("pose", 6)
        self._blend_factor_port = self.DeclareVectorInputPort("blend_factor", 1)
        self._last_pose = declare.unset_state(self, 6)
        sources = [self._desired_pose_port, self._pose_port, self._blend_factor_port, self._last_pose]
        declare.output(self, "limited_pose", 6, self._limited_pose, sources)
        declare.update(self, period, self._update, self._reset)

    get_desired_pose_input_port = input_getter("desired_pose", "commanded pose, (6,)")
    get_pose_input_port = input_getter("pose", "measured pose, (6,)")
    get_blend_factor_input_port = input_getter("blend_factor", "blend factor, (1,); 0 while the arm is not controlled")
    get_limited_pose_output_port = output_getter("limited_pose", "rate-limited pose, (6,)")

    def _limited_pose(self, context: Context) -> np.ndarray:
        last = declare.initialized(self, context, self._last_pose)
        if not self._blend_factor_port.Eval(context)[0] > 0.0:  # NaN counts as 0
            measured = self._pose_port.Eval(context)
            return measured if is_finite(measured) else last
        desired = self._desired_pose_port.Eval(context)
        if not np.isfinite(desired).all():
            return last  # NaN would remain in the state
        change = pose_difference(desired, last)
        distance = float(np.linalg.norm(change[:3]))
        if distance <= self._step and (np.abs(change[3:]) <= self._angular_step).all():
            return desired
        change[:3] *= self._step / max(distance, self._step)
        change[3:] = np.clip(change[3:], -self._angular_step, self._angular_step)
        return last + change

    def _reset(self, context: Context, discrete_state: DiscreteValues) -> None:
        discrete_state.set_value(declare.start_pose(self._pose_port.Eval(context)))

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        discrete_state.set_value(self._limited_pose(context))
