"""Cartesian position control of an arm with joint position commands."""

from dataclasses import dataclass

import numpy as np
from pydrake.math import RigidTransform
from pydrake.multibody.inverse_kinematics import (
    DifferentialInverseKinematicsParameters,
    DifferentialInverseKinematicsStatus,
    DoDifferentialInverseKinematics,
)
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import Frame, JacobianWrtVariable
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from guiderail.models.common.arrays import as_numbers, norm
from guiderail.models.common.errors import InputError
from guiderail.models.control.damped_inverse import damped_joint_velocities, is_following
from guiderail.systems.support import declarations as declare
from guiderail.systems.support.declarations import input_getter, output_getter
from guiderail.systems.support.drake_multibody import check_plant, pose_to_transform, transform_to_pose
from guiderail.systems.support.last_valid import CommandValidity

POSTURE_GAIN = 0.5  # gain of the return to the posture [1/s]
TIMEOUT = 0.1  # age above which a desired pose is stale [s]


@dataclass(frozen=True)
class SpeedLimits:
    """Speed limits of the tool center.

    Attributes:
        translational: Translational speed limit [m/s], positive.
        rotational: Rotational speed limit [rad/s], positive.

    Raises:
        InputError: If a limit is not positive.
    """

    translational: float = 0.25
    rotational: float = 1.0

    def __post_init__(self) -> None:
        if not (self.translational > 0.0 and self.rotational > 0.0):
            raise InputError("the tool's speed limits must be positive")


class CartesianPositionController(LeafSystem):
    """Move the tool center P to a desired pose by joint position commands from differential inverse kinematics.

        q[k+1] = clip(q[k] + v·period),  J v = V

    V is the velocity that reaches the desired pose in one period, scaled down to the speed limits.
    `pydrake.multibody.inverse_kinematics.DoDifferentialInverseKinematics` computes v; while no joint limit is active, a
    closed-form solution is the same optimum. The joints stay within their position and velocity limits, and the tool
    moves in the direction of V. If both are not possible at the speed of V, the tool slows down or stops. A joint that
    starts outside its position limits does not move farther out; it may return within its velocity limit.

    While the desired pose is not finite, older than 0.1 s, or more than one period in the future
    (`CommandValidity`), the joint command is constant. Near a singular posture, a damped pseudoinverse is used
    (`models.control.damped_inverse`). The joint velocities then stay small, the direction of the tool deviates
    slightly from V, and null-space control moves the arm out of the singularity.

    ``desired_pose`` is X_TP as (6,) [x y z Rz Ry Rx] in meters and radians. ``positions`` is (n,), measured joint
    positions [rad], read at initialization as the first joint command. ``command_time`` is (1,), the time stamp of
    ``desired_pose`` [s]; if it is not connected, commands never time out. ``joint_positions`` is the joint command,
    (n,) [rad]. ``pose`` is (6,), the pose of the tool center at the joint command. ``stuck`` (1,) is 1 if the tool
    could not move in the desired direction at the last valid command. ``command_timed_out`` (1,) is 1 while no valid
    command is available. All outputs depend only on state, without direct feedthrough.

    Args:
        plant: Finalized model of only the arm, with at least six joints; provides kinematics and joint limits.
        target: Frame T, fixed in the world.
        tool_center: Frame P.
        posture: Joint positions (n,) that the null-space control returns to [rad], finite.
        period: Period of the joint commands [s], positive.
        speed_limits: Speed limits of the tool center.

    Raises:
        InputError: If an argument is out of range. At initialization, if a measured position is not finite.
    """

    def __init__(
        self,
        plant: MultibodyPlant,
        target: Frame,
        tool_center: Frame,
        *,
        posture: np.ndarray,
        period: float = 0.01,
        speed_limits: SpeedLimits = SpeedLimits(),
    ):
        super().__init__()
        check_plant(plant, target, target=target, tool_center=tool_center)
        num_joints = plant.num_positions()
        if num_joints < 6:
            raise InputError(f"a position controller needs an arm of at least six joints, not {num_joints}")
        if not np.isfinite(posture).all():
            raise InputError(f"a position controller's posture must be finite joint positions, not {posture}")
        self._plant, self._target, self._tool_center = plant, target, tool_center
        self._period, self._speed_limits = period, speed_limits
        self._posture = as_numbers(posture, "posture")
        self._position_limits = plant.GetPositionLowerLimits(), plant.GetPositionUpperLimits()
        self._velocity_limits = plant.GetVelocityLowerLimits(), plant.GetVelocityUpperLimits()
        self._parameters = DifferentialInverseKinematicsParameters(num_joints, num_joints)
        self._parameters.set_time_step(period)
        self._parameters.set_nominal_joint_position(self._posture)
        self._parameters.set_joint_centering_gain(POSTURE_GAIN * np.eye(num_joints))
        self._parameters.set_joint_velocity_limits(self._velocity_limits)

        self._desired_pose_port = self.DeclareVectorInputPort("desired_pose", 6)
        self._positions_port = self.DeclareVectorInputPort("positions", num_joints)
        self._command_time_port = self.DeclareVectorInputPort("command_time", 1)
        self._validity = CommandValidity(self._command_time_port, period=period, timeout=TIMEOUT)
        self._command = declare.unset_state(self, num_joints)
        self._is_stuck = self.DeclareDiscreteState(1)
        self._has_timed_out = self.DeclareDiscreteState(1)
        self._plant_context = declare.plant_context(self, plant, self._joint_command, [self._command])
        declare.output(self, "joint_positions", num_joints, self._joint_command, [self._command])
        declare.output(self, "pose", 6, lambda context: transform_to_pose(self._X_TP(context)), [self._plant_context])
        self.DeclareStateOutputPort("stuck", self._is_stuck)
        self.DeclareStateOutputPort("command_timed_out", self._has_timed_out)
        declare.update(self, period, self._step, self._start_at_measured_positions)

    get_desired_pose_input_port = input_getter("desired_pose", "desired pose of the tool center, (6,)")
    get_positions_input_port = input_getter("positions", "measured joint positions, (n,) [rad]")
    get_command_time_input_port = input_getter("command_time", "time stamp of the desired pose, (1,) [s]; optional")
    get_joint_positions_output_port = output_getter("joint_positions", "joint command, (n,) [rad]")
    get_pose_output_port = output_getter("pose", "pose of the tool center at the joint command, (6,)")
    get_stuck_output_port = output_getter("stuck", "flag that the desired direction cannot be followed, (1,)")
    get_command_timed_out_output_port = output_getter("command_timed_out", "flag that no command is valid, (1,)")

    def _joint_command(self, context: Context) -> np.ndarray:
        return declare.initialized(self, context, self._command)

    def _X_TP(self, context: Context) -> RigidTransform:
        return self._tool_center.CalcPose(self._plant_context.Eval(context), self._target)

    def _start_at_measured_positions(self, context: Context, discrete_state: DiscreteValues) -> None:
        discrete_state.set_value(self._command, declare.start_pose(self._positions_port.Eval(context)))
        for flag in (self._is_stuck, self._has_timed_out):
            discrete_state.set_value(flag, [0.0])

    def _step(self, context: Context, discrete_state: DiscreteValues) -> None:
        desired_pose = self._desired_pose_port.Eval(context)
        is_valid = self._validity.is_valid(context, desired_pose, context.get_time())
        discrete_state.set_value(self._has_timed_out, [float(not is_valid)])
        if not is_valid:
            return
        plant, plant_context = self._plant, self._plant_context.Eval(context)
        V = self._desired_velocity(self._X_TP(context), pose_to_transform(desired_pose))
        J = plant.CalcJacobianSpatialVelocity(
            plant_context, JacobianWrtVariable.kV, self._tool_center, np.zeros(3), self._target, self._target
        )
        q = self._joint_command(context)
        # The limits are extended to q: a joint outside them neither jumps back nor makes the problem infeasible.
        limits = np.minimum(self._position_limits[0], q), np.maximum(self._position_limits[1], q)
        velocities, is_stuck = self._joint_velocities(q, V, J, limits)
        discrete_state.set_value(self._is_stuck, [float(is_stuck)])
        if velocities is not None:
            # The solver satisfies the limits only within its tolerance; the clipped command satisfies them exactly.
            # np.clip is slower, because it inspects its arguments in Python.
            next_q = q + self._period * velocities
            discrete_state.set_value(self._command, np.minimum(np.maximum(next_q, limits[0]), limits[1]))

    def _desired_velocity(self, X_TP: RigidTransform, X_TPd: RigidTransform) -> np.ndarray:
        """Return the tool velocity [rotational, translational] (6,) towards X_TPd, within the speed limits."""
        rotation = (X_TPd.rotation() @ X_TP.rotation().inverse()).ToAngleAxis()
        V = np.empty(6)
        V[:3] = _limited(rotation.angle() * rotation.axis() / self._period, self._speed_limits.rotational)
        V[3:] = _limited((X_TPd.translation() - X_TP.translation()) / self._period, self._speed_limits.translational)
        return V

    def _joint_velocities(
        self, q: np.ndarray, V: np.ndarray, J: np.ndarray, position_limits: tuple[np.ndarray, np.ndarray]
    ) -> tuple[np.ndarray | None, bool]:
        """Return the joint velocities for a tool velocity V, or None on failure, and True if V cannot be followed."""
        velocities, is_regular = damped_joint_velocities(J, V, POSTURE_GAIN * (self._posture - q))
        if not is_regular:
            lower, upper = self._velocity_limits
            velocities /= max(1.0, float(np.maximum(velocities / lower, velocities / upper).max()))
            return velocities, not is_following(J, velocities, V)
        if _within(velocities, self._velocity_limits) and _within(q + self._period * velocities, position_limits):
            return velocities, False  # no limit is active: the closed form is optimal, and faster
        self._parameters.set_joint_position_limits(position_limits)
        result = DoDifferentialInverseKinematics(q, np.zeros_like(q), V, J, self._parameters)
        return result.joint_velocities, result.status != DifferentialInverseKinematicsStatus.kSolutionFound


def _within(values: np.ndarray, limits: tuple[np.ndarray, np.ndarray]) -> bool:
    return bool((limits[0] <= values).all() and (values <= limits[1]).all())


def _limited(velocity: np.ndarray, limit: float) -> np.ndarray:
    """Return the velocity scaled down to the speed limit."""
    speed = norm(velocity)
    return velocity if speed <= limit else velocity * (limit / speed)
