"""Cartesian position control for an arm that takes joint positions."""

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
from guiderail.models.control.damped_inverse import damped_joint_velocities, follows
from guiderail.systems.support.caching import declare_plant_context
from guiderail.systems.support.command_watch import CommandCheck
from guiderail.systems.support.sampling import check_period


@dataclass(frozen=True)
class SpeedLimits:
    """Greatest commanded speeds of the tool centre.

    Attributes:
        translational: [m/s], positive.
        rotational: [rad/s], positive.
    """

    translational: float = 0.25
    rotational: float = 1.0

    def __post_init__(self) -> None:
        if not (self.translational > 0.0 and self.rotational > 0.0):
            raise InputError("the tool's speed limits must be positive")


class CartesianPositionController(LeafSystem):
    """Commands joint positions that move an arm's tool centre P to a desired pose, by differential inverse kinematics.

        q[k+1] = clip(q[k] + v·period), J v = the velocity that reaches the desired pose in one period, within limits

    (`pydrake.multibody.inverse_kinematics.DoDifferentialInverseKinematics`; in closed form while no limit of a joint
    binds, which is the same optimum). The optimization keeps the direction of the tool's motion and every joint's
    limits of position and velocity; where both can't be had, the motion slows down or stops. A joint that begins beyond
    a limit of its position may come back, no faster than ever, and goes no farther. Where commands stop, the
    joint command is held: while the desired pose is not finite, older than a timeout or more than a period from the
    future (`CommandCheck`). Near a singular posture a damped pseudoinverse takes over (`models.damped_inverse`): the
    tool leaves its direction a little, the joints stay slow, and the return to the posture leads out.

    .. pydrake_system::

        name: CartesianPositionController
        input_ports:
        - desired_pose
        - positions
        - command_time (optional)
        output_ports:
        - joint_positions
        - pose
        - stuck
        - command_timed_out

    ``desired_pose`` is X_TP as (6,) [x y z Rz Ry Rx] in metres and radians. ``positions`` is (n,), measured; it is read
    at initialization, and the joint command starts there. ``command_time`` is (1,), when ``desired_pose`` was given
    [s]; unconnected, commands never get stale. ``joint_positions`` is the joint command, (n,) [rad]. ``pose`` is (6,),
    where the joint command puts the tool centre. ``stuck`` is 1 while the desired direction can't be followed,
    ``command_timed_out`` 1 while the joint command is held; both (1,). All outputs are state or follow from it: nothing feeds
    through.
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
        timeout: float = 0.1,
    ):
        """
        Args:
            plant: the arm alone, finalized; its joints' limits are kept.
            target: T, fixed in the world.
            tool_centre: P.
            posture: joint positions (n,) that the null space returns to, finite.
            period: between two joint commands [s], positive; 100 Hz unless given.
            speed_limits: of the tool centre.
            posture_gain: of the return to the posture [1/s], not negative.
            timeout: age beyond which a desired pose is stale [s], positive.

        Raises:
            InputError: if an argument is out of range. At initialization, if a measured position is not finite.
        """
        super().__init__()
        check_period(period)
        num_joints = plant.num_positions()
        if not 0.0 <= posture_gain < np.inf:
            raise InputError(f"a position controller's posture gain must not be negative, not {posture_gain}")
        if np.shape(posture) != (num_joints,):
            raise InputError(f"a position controller's posture must have {num_joints} joints")
        if not np.isfinite(posture).all():
            raise InputError(f"a position controller's posture must be finite joint positions, not {posture}")
        self._plant, self._target, self._tool_centre = plant, target, tool_centre
        self._period, self._speed_limits = period, speed_limits
        self._posture, self._posture_gain = np.array(posture, dtype=float), posture_gain
        parameters = DifferentialInverseKinematicsParameters(num_joints, num_joints)
        parameters.set_time_step(period)
        parameters.set_nominal_joint_position(np.asarray(posture, dtype=float))
        parameters.set_joint_centering_gain(posture_gain * np.eye(num_joints))
        self._position_limits = plant.GetPositionLowerLimits(), plant.GetPositionUpperLimits()
        self._velocity_limits = plant.GetVelocityLowerLimits(), plant.GetVelocityUpperLimits()
        parameters.set_joint_velocity_limits(self._velocity_limits)
        self._parameters = parameters

        self._desired_pose_port = self.DeclareVectorInputPort("desired_pose", 6)
        self._positions_port = self.DeclareVectorInputPort("positions", num_joints)
        self._command_time_port = self.DeclareVectorInputPort("command_time", 1)
        self._check = CommandCheck(self._desired_pose_port, self._command_time_port, period=period, timeout=timeout)
        self._command = self.DeclareDiscreteState(num_joints)
        self._is_stuck = self.DeclareDiscreteState(1)
        self._is_holding = self.DeclareDiscreteState(1)
        command = {self.discrete_state_ticket(self._command)}
        self._plant_context = declare_plant_context(self, plant, self._set_plant_state, prerequisites_of_calc=command)
        self._joint_positions_port = self.DeclareStateOutputPort("joint_positions", self._command)
        self._pose_port = self.DeclareVectorOutputPort(
            "pose", 6, self._calc_pose, prerequisites_of_calc={self._plant_context.ticket()}
        )
        self._stuck_port = self.DeclareStateOutputPort("stuck", self._is_stuck)
        self._command_timed_out_port = self.DeclareStateOutputPort("command_timed_out", self._is_holding)
        self.DeclareInitializationDiscreteUpdateEvent(self._start_at_measured_positions)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._step)

    def get_desired_pose_input_port(self) -> InputPort:
        """The desired pose of the tool centre, (6,)."""
        return self._desired_pose_port

    def get_positions_input_port(self) -> InputPort:
        """Measured joint positions, (n,) [rad]."""
        return self._positions_port

    def get_command_time_input_port(self) -> InputPort:
        """When the desired pose was given, (1,) [s]; optional."""
        return self._command_time_port

    def get_joint_positions_output_port(self) -> OutputPort:
        """The joint command, (n,) [rad]."""
        return self._joint_positions_port

    def get_pose_output_port(self) -> OutputPort:
        """Where the joint command puts the tool centre, (6,)."""
        return self._pose_port

    def get_stuck_output_port(self) -> OutputPort:
        """1 while the desired direction can't be followed, (1,)."""
        return self._stuck_port

    def get_command_timed_out_output_port(self) -> OutputPort:
        """1 while the joint command is held, (1,)."""
        return self._command_timed_out_port

    def _set_plant_state(self, context: Context, plant_context: Context) -> None:
        self._plant.SetPositions(plant_context, self._joint_command(context))

    def _joint_command(self, context: Context) -> np.ndarray:
        return context.get_discrete_state(self._command).value()

    def _start_at_measured_positions(self, context: Context, discrete_state: DiscreteValues) -> EventStatus:
        measured = self._positions_port.Eval(context)
        if not np.isfinite(measured).all():
            raise InputError(
                f"a joint command begins where the arm is: its measured positions must be finite, not {measured}"
            )
        discrete_state.set_value(self._command, measured)
        discrete_state.set_value(self._is_stuck, [0.0])
        discrete_state.set_value(self._is_holding, [0.0])
        return EventStatus.Succeeded()

    def _step(self, context: Context, discrete_state: DiscreteValues) -> EventStatus:
        is_valid = self._check.is_valid(context, context.get_time())
        discrete_state.set_value(self._is_holding, [float(not is_valid)])
        if not is_valid:
            return EventStatus.Succeeded()
        plant, plant_context = self._plant, self._plant_context.Eval(context)
        X_TP = self._tool_centre.CalcPose(plant_context, self._target)
        V = self._desired_velocity(X_TP, pose_to_transform(self._desired_pose_port.Eval(context)))
        J = plant.CalcJacobianSpatialVelocity(
            plant_context, JacobianWrtVariable.kV, self._tool_centre, np.zeros(3), self._target, self._target
        )
        q = self._joint_command(context)
        # With q among them no limit asks for a leap of a joint that is beyond it, nor forbids every motion.
        limits = np.minimum(self._position_limits[0], q), np.maximum(self._position_limits[1], q)
        velocities, is_stuck = self._joint_velocities(q, V, J, limits)
        discrete_state.set_value(self._is_stuck, [float(is_stuck)])
        if velocities is not None:
            # The solver keeps limits to its own tolerance only; what is sent keeps them exactly.
            discrete_state.set_value(self._command, np.clip(q + self._period * velocities, *limits))
        return EventStatus.Succeeded()

    def _desired_velocity(self, X_TP: RigidTransform, X_TPd: RigidTransform) -> np.ndarray:
        """Of the tool centre, [rotational, translational] (6,): reaches X_TPd in one period, within the limits."""
        turn = (X_TPd.rotation() @ X_TP.rotation().inverse()).ToAngleAxis()
        return np.concatenate(
            [
                _limited(turn.angle() * turn.axis() / self._period, self._speed_limits.rotational),
                _limited((X_TPd.translation() - X_TP.translation()) / self._period, self._speed_limits.translational),
            ]
        )

    def _joint_velocities(
        self, q: np.ndarray, V: np.ndarray, J: np.ndarray, position_limits: tuple[np.ndarray, np.ndarray]
    ) -> tuple[np.ndarray | None, bool]:
        """For the tool velocity V, or None where there are none; and whether V's direction can't be followed."""
        velocities, is_regular = damped_joint_velocities(J, V, self._posture_gain * (self._posture - q))
        if not is_regular:
            velocities /= max(1.0, float((np.abs(velocities) / self._velocity_limits[1]).max()))
            return velocities, not follows(J, velocities, V)
        if _within(velocities, self._velocity_limits) and _within(q + self._period * velocities, position_limits):
            return velocities, False  # no limit binds: the optimum, without the time that its solver takes
        self._parameters.set_joint_position_limits(position_limits)
        result = DoDifferentialInverseKinematics(q, np.zeros_like(q), V, J, self._parameters)
        return result.joint_velocities, result.status != DifferentialInverseKinematicsStatus.kSolutionFound

    def _calc_pose(self, context: Context, output: BasicVector) -> None:
        X_TP = self._tool_centre.CalcPose(self._plant_context.Eval(context), self._target)
        output.SetFromVector(transform_to_pose(X_TP))


def _within(values: np.ndarray, limits: tuple[np.ndarray, np.ndarray]) -> bool:
    return bool((limits[0] <= values).all() and (values <= limits[1]).all())


def _limited(velocity: np.ndarray, limit: float) -> np.ndarray:
    """The same direction, no faster than the limit."""
    speed = float(np.linalg.norm(velocity))
    return velocity if speed <= limit else velocity * (limit / speed)
