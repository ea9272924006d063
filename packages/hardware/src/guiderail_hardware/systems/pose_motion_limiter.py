"""Limiter of velocity, acceleration and jerk of a desired pose."""

import numpy as np
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem
from ruckig import ControlInterface, InputParameter, Result, Ruckig, RuckigError, Synchronization, Trajectory
from scipy.spatial.transform import Rotation

from guiderail.models.common.arrays import is_finite
from guiderail.models.common.errors import InputError
from guiderail.systems.support import declarations as declare
from guiderail.systems.support.declarations import input_getter, output_getter
from guiderail_hardware.models.motion_limits import MotionLimits

# Modes in order of preference: synchronized axes, independent axes, braking to rest. For numerical reasons, the axes
# cannot be synchronized for about one of 10,000 adversarial commands.
MODES = (
    (ControlInterface.Position, Synchronization.Time),
    (ControlInterface.Position, Synchronization.No),
    (ControlInterface.Velocity, Synchronization.No),
)
POSE_AXES = [5, 4, 3]  # indices of Rx, Ry, Rz in a pose, in the order of SciPy's extrinsic angles "xyz"


class PoseMotionLimiter(LeafSystem):
    """Follow a desired pose with limited velocity, acceleration and jerk, starting from the measured pose at rest.

    While the blend factor is zero or NaN, the output is the measured pose. When the factor becomes positive, the output
    moves from the measured pose to the desired pose on the time-optimal trajectory within the limits. The trajectory is
    computed again in each period (Berscheid and Kröger, "Jerk-limited Real-time Trajectory Generation with Arbitrary
    Target States", RSS 2021). The orientation is represented by the rotation vector relative to the start of the motion
    (`MotionLimits.rotation_vector_limits`). The limit of each axis is 1/√3 of the limit of the norm.

    A desired pose that is not finite, or that is rotated by 0.9 π or more from the start, is ignored: the output comes
    to rest at the last valid desired pose. If the desired pose is too far away for the computation of a trajectory,
    such as 10 km, the motion is braked to rest. If the measured pose is not finite while the blend factor is zero, the
    last output is repeated.

    .. pydrake_system::

        name: PoseMotionLimiter
        input_ports:
        - desired_pose
        - pose
        - blend_factor
        output_ports:
        - limited_pose

    ``desired_pose``, ``pose`` (measured) and ``limited_pose`` are (6,), [x y z Rz Ry Rx] in meters and radians.
    ``blend_factor`` is (1,), from a `TorqueSafetyLimiter`.

    Args:
        limits: Limits of the motion.
        period: Sampling period [s], positive.

    Raises:
        InputError: If the period is out of range. At initialization, if the measured pose is not finite. At an
            evaluation, if no trajectory within the limits is found, not even one to rest.
    """

    def __init__(self, limits: MotionLimits, *, period: float):
        super().__init__()
        self._period = period
        per_axis = zip(limits.linear, limits.rotation_vector_limits(), strict=True)
        self._limits = [np.repeat([linear, angular], 3) / np.sqrt(3.0) for linear, angular in per_axis]
        self._desired_pose_port = self.DeclareVectorInputPort("desired_pose", 6)
        self._pose_port = self.DeclareVectorInputPort("pose", 6)
        self._blend_factor_port = self.DeclareVectorInputPort("blend_factor", 1)
        # [position and rotation vector; velocity; acceleration; last valid target; quaternion at the start]
        self._state = declare.unset_state(self, 28)
        ports = (self._desired_pose_port, self._pose_port, self._blend_factor_port)
        self._next_state = declare.cache(self, "next_state", self._calc_next_state, [*ports, self._state])
        declare.output(self, "limited_pose", 6, self._limited_pose, [self._next_state])
        declare.update(self, period, self._update, self._reset)

    get_desired_pose_input_port = input_getter("desired_pose", "commanded pose, (6,)")
    get_pose_input_port = input_getter("pose", "measured pose, (6,)")
    get_blend_factor_input_port = input_getter("blend_factor", "blend factor, (1,); 0 while the arm is not controlled")
    get_limited_pose_output_port = output_getter("limited_pose", "pose within the limits of the motion, (6,)")

    def _calc_next_state(self, context: Context) -> np.ndarray:
        state = declare.initialized(self, context, self._state).copy()
        if not self._blend_factor_port.Eval(context)[0] > 0.0:  # NaN counts as 0
            measured = self._pose_port.Eval(context)
            if is_finite(measured):
                return _at_rest(measured)
            state[6:18], state[18:24] = 0.0, state[:6]
            return state
        start = Rotation.from_quat(state[24:])
        desired = self._desired_pose_port.Eval(context)
        if np.isfinite(desired).all():
            rotation_vector = (start.inv() * Rotation.from_euler("xyz", desired[POSE_AXES])).as_rotvec()
            # At an angle of π, the rotation vector jumps to the opposite direction.
            if np.linalg.norm(rotation_vector) < 0.9 * np.pi:
                state[18:24] = np.concatenate([desired[:3], rotation_vector])
        motion = InputParameter(6)
        motion.current_position, motion.current_velocity, motion.current_acceleration = state[:18].reshape(3, 6)
        motion.target_position = state[18:24]
        motion.max_velocity, motion.max_acceleration, motion.max_jerk = self._limits
        state[:18] = np.concatenate(_plan(motion).at_time(self._period))
        return state

    def _limited_pose(self, context: Context) -> np.ndarray:
        state = self._next_state.Eval(context)
        angles = (Rotation.from_quat(state[24:]) * Rotation.from_rotvec(state[3:6])).as_euler("xyz")
        return np.concatenate([state[:3], angles[::-1]])

    def _reset(self, context: Context, discrete_state: DiscreteValues) -> None:
        discrete_state.set_value(_at_rest(declare.start_pose(self._pose_port.Eval(context))))

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        discrete_state.set_value(self._next_state.Eval(context))


def _plan(motion: InputParameter) -> Trajectory:
    """Return a trajectory to the target, or to rest if no trajectory to the target is found.

    Raises:
        InputError: If no trajectory is found.
    """
    for motion.control_interface, motion.synchronization in MODES:
        trajectory = Trajectory(6)
        try:
            # A new instance on every call: an instance stored in a system would be reported as leaked at exit.
            if Ruckig(6).calculate(motion, trajectory) in (Result.Working, Result.Finished):
                return trajectory
        except (RuckigError, ValueError):
            # The bindings raise a ValueError for the result code -101 (too long duration), for which they have no name.
            continue
    raise InputError(f"no trajectory from {motion.current_position} is within the limits of the motion")


def _at_rest(pose: np.ndarray) -> np.ndarray:
    """Return the state (28,) of a trajectory at rest at a pose (6,)."""
    state = np.zeros(28)
    state[:3] = state[18:21] = pose[:3]
    state[24:] = Rotation.from_euler("xyz", pose[POSE_AXES]).as_quat()
    return state
