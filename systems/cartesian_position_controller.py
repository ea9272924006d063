"""Cartesian position control for an arm that takes joint positions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydrake.common.value import Value
from pydrake.multibody.inverse_kinematics import (
    DifferentialInverseKinematicsParameters,
    DifferentialInverseKinematicsStatus,
    DoDifferentialInverseKinematics,
)
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import Frame, JacobianWrtVariable
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, EventStatus, LeafSystem, ValueProducer

from guiderail.models.damped_inverse import damped_joint_velocities, follows, is_regular
from guiderail.models.errors import InputError
from guiderail.models.pose_coordinates import pose_to_transform, transform_to_pose


@dataclass(frozen=True)
class SpeedLimits:
    """How fast the tool centre may be commanded to move, [m/s] and [rad/s], positive."""

    translational: float = 0.25
    rotational: float = 1.0

    def __post_init__(self) -> None:
        if not (self.translational > 0.0 and self.rotational > 0.0):
            raise InputError("the tool's speed limits must be positive")


class CartesianPositionController(LeafSystem):
    """Joint positions whose tool centre moves to a desired pose, by Drake's differential inverse kinematics.

    Every period it asks for the velocity that would reach the desired pose within it, no faster than the limits,
    and moves its own joint command by v·period. The optimization behind it keeps the direction of the tool's motion
    and every joint's limits of position and velocity; where both can't be had, the command slows down or stays. Near a
    singular posture a damped pseudoinverse takes over, see `models.damped_inverse`: the tool leaves its direction a
    little, the joints stay slow, and the posture that is returned to leads out.

    .. pydrake_system::

        name: CartesianPositionController
        input_ports:
        - desired_pose
        - positions
        output_ports:
        - joint_positions
        - pose
        - stuck

    `desired_pose` is X_TP as (6,) [x y z Rz Ry Rx]; what is not finite is no command, and the arm stays. `positions`
    is (n,), measured; it is read once, at initialization, and the command starts there. `joint_positions` is the
    command, (n,) [rad]. `pose` is where the command puts the tool centre, (6,). `stuck` is (1,): 1 while the desired
    direction can't be followed. All outputs are state or follow from it: nothing feeds through.
    """

    def __init__(
        self,
        plant: MultibodyPlant,
        target: Frame,
        tool_centre: Frame,
        *,
        posture: np.ndarray,
        period: float = 0.01,
        speed_limits: SpeedLimits = SpeedLimits(),
        posture_gain: float = 0.5,
    ):
        """
        Args:
            plant: the arm alone, finalized; its joints' limits are kept.
            target: T, fixed in the world.
            tool_centre: P.
            posture: joint positions (n,) that the arm returns to as far as the tool lets it.
            period: [s], positive; 100 Hz unless given.
            speed_limits: of the tool centre.
            posture_gain: how quickly it returns [1/s], not negative.

        Raises:
            InputError: if an argument is out of range.
        """
        super().__init__()
        num_joints = plant.num_positions()
        if not period > 0.0 or not posture_gain >= 0.0:
            raise InputError("a position controller's period must be positive, and its posture's gain not negative")
        if np.shape(posture) != (num_joints,):
            raise InputError(f"a position controller's posture must have {num_joints} joints")
        self._plant, self._target, self._tool_centre = plant, target, tool_centre
        self._period, self._speed_limits = period, speed_limits
        self._posture, self._posture_gain = np.array(posture, dtype=float), posture_gain
        parameters = DifferentialInverseKinematicsParameters(num_joints, num_joints)
        parameters.set_time_step(period)
        parameters.set_nominal_joint_position(np.asarray(posture, dtype=float))
        parameters.set_joint_centering_gain(posture_gain * np.eye(num_joints))
        parameters.set_joint_position_limits((plant.GetPositionLowerLimits(), plant.GetPositionUpperLimits()))
        parameters.set_joint_velocity_limits((plant.GetVelocityLowerLimits(), plant.GetVelocityUpperLimits()))
        self._parameters = parameters

        self._desired_pose = self.DeclareVectorInputPort("desired_pose", 6)
        self._positions = self.DeclareVectorInputPort("positions", num_joints)
        self._command = self.DeclareDiscreteState(num_joints)
        self._is_stuck = self.DeclareDiscreteState(1)
        state = {self.discrete_state_ticket(self._command)}
        self._kinematics = self.DeclareCacheEntry(
            "kinematics",
            ValueProducer(
                allocate=lambda: Value(plant.CreateDefaultContext()),
                calc=lambda context, value: plant.SetPositions(value.get_mutable_value(), self._joint_command(context)),
            ),
            state,
        )
        self._joint_positions = self.DeclareStateOutputPort("joint_positions", self._command)
        self._pose = self.DeclareVectorOutputPort("pose", 6, self._calc_pose, state)
        self._stuck = self.DeclareStateOutputPort("stuck", self._is_stuck)
        self.DeclareInitializationDiscreteUpdateEvent(self._start_where_the_arm_is)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._step)

    def get_desired_pose_input_port(self):
        """Where the tool centre shall be, (6,)."""
        return self._desired_pose

    def get_positions_input_port(self):
        """Measured joint positions, (n,)."""
        return self._positions

    def get_joint_positions_output_port(self):
        """The joint command, (n,)."""
        return self._joint_positions

    def get_pose_output_port(self):
        """Where the joint command puts the tool centre, (6,)."""
        return self._pose

    def get_stuck_output_port(self):
        """1 while the desired direction can't be followed, (1,)."""
        return self._stuck

    def _joint_command(self, context: Context) -> np.ndarray:
        return context.get_discrete_state(self._command).value()

    def _start_where_the_arm_is(self, context: Context, discrete_state: DiscreteValues) -> EventStatus:
        discrete_state.get_mutable_value(self._command)[:] = self._positions.Eval(context)
        discrete_state.get_mutable_value(self._is_stuck)[:] = 0.0
        return EventStatus.Succeeded()

    def _step(self, context: Context, discrete_state: DiscreteValues) -> EventStatus:
        desired = self._desired_pose.Eval(context)
        if not np.isfinite(desired).all():
            return EventStatus.DidNothing()
        plant, plant_context = self._plant, self._kinematics.Eval(context)
        X_TP = self._tool_centre.CalcPose(plant_context, self._target)
        X_TPd = pose_to_transform(desired)
        turn = (X_TPd.rotation() @ X_TP.rotation().inverse()).ToAngleAxis()
        V = np.concatenate(
            [
                _limited(turn.angle() * turn.axis() / self._period, self._speed_limits.rotational),
                _limited((X_TPd.translation() - X_TP.translation()) / self._period, self._speed_limits.translational),
            ]
        )
        J = plant.CalcJacobianSpatialVelocity(
            plant_context, JacobianWrtVariable.kV, self._tool_centre, np.zeros(3), self._target, self._target
        )
        q = self._joint_command(context)
        velocities, is_stuck = self._joint_velocities(q, V, J)
        discrete_state.get_mutable_value(self._is_stuck)[:] = float(is_stuck)
        if velocities is not None:
            # The solver keeps limits to its own tolerance only; what is sent keeps them exactly.
            lower, upper = plant.GetPositionLowerLimits(), plant.GetPositionUpperLimits()
            moved = np.clip(q + self._period * velocities, lower, upper)
            discrete_state.get_mutable_value(self._command)[:] = moved
        return EventStatus.Succeeded()

    def _joint_velocities(self, q: np.ndarray, V: np.ndarray, J: np.ndarray) -> tuple[np.ndarray | None, bool]:
        """For the tool velocity V, or None where there are none; and whether V's direction can't be followed."""
        if is_regular(J):
            result = DoDifferentialInverseKinematics(q, np.zeros_like(q), V, J, self._parameters)
            return result.joint_velocities, result.status != DifferentialInverseKinematicsStatus.kSolutionFound
        velocities = damped_joint_velocities(J, V, self._posture_gain * (self._posture - q))
        velocities /= max(1.0, float((np.abs(velocities) / self._plant.GetVelocityUpperLimits()).max()))
        return velocities, not follows(J, velocities, V)

    def _calc_pose(self, context: Context, output: BasicVector) -> None:
        X_TP = self._tool_centre.CalcPose(self._kinematics.Eval(context), self._target)
        output.SetFromVector(transform_to_pose(X_TP))


def _limited(velocity: np.ndarray, limit: float) -> np.ndarray:
    """The same direction, no faster than the limit."""
    speed = float(np.linalg.norm(velocity))
    return velocity if speed <= limit else velocity * (limit / speed)
