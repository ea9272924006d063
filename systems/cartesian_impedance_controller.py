"""A Cartesian impedance for a torque-controlled arm."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydrake.common.value import Value
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import Frame, JacobianWrtVariable
from pydrake.systems.framework import BasicVector, Context, LeafSystem, ValueProducer

from guiderail.models.cartesian_impedance import JointTorques, impedance_torques
from guiderail.models.errors import InputError
from guiderail.models.pose_coordinates import orientation_error, pose_to_transform, transform_to_pose
from guiderail.systems.command_watch import CommandWatch


@dataclass(frozen=True)
class ImpedanceGains:
    """What an impedance is made of.

    Args:
        stiffness: (6, 6), symmetric, positive definite, [translational, rotational] in N/m and Nm/rad.
        wrench_limits: (6,) of the wrench along the stiffness frame's axes [N, Nm], positive.
        damping_ratio: of every mode, positive.
        posture: joint positions (n,) that the null space returns to.
        posture_stiffness: [Nm/rad], not negative.
        posture_damping: how fast motion dies that doesn't move the tool [1/s], not negative; the torque is this times
            M v, the one damping that takes energy out of the null space in every posture.
    """

    stiffness: np.ndarray
    wrench_limits: np.ndarray
    posture: np.ndarray
    damping_ratio: float = 1.0
    posture_stiffness: float = 10.0
    posture_damping: float = 5.0

    def __post_init__(self) -> None:
        K = np.asarray(self.stiffness, dtype=float)
        if K.shape != (6, 6) or not np.allclose(K, K.T) or not (np.linalg.eigvalsh(K) > 0.0).all():
            raise InputError("a Cartesian stiffness must be a symmetric, positive definite 6 × 6 matrix")
        if np.shape(self.wrench_limits) != (6,) or not (np.asarray(self.wrench_limits) > 0.0).all():
            raise InputError(f"an impedance needs six positive wrench limits, not {self.wrench_limits}")
        if not self.damping_ratio > 0.0 or not min(self.posture_stiffness, self.posture_damping) >= 0.0:
            raise InputError("an impedance's damping ratio must be positive, and its posture's gains not negative")


class CartesianImpedanceController(LeafSystem):
    """Lets a tool centre P give way around a desired pose as a spring and a damper would.

    τ = Jᵀ clip(K e − D V) + N τ_posture + g(q), clipped to the motors' limits; the law is in
    `models.cartesian_impedance`. K may be given in the axes of any frame. The orientation's error is a
    quaternion's, so that no orientation is singular. D follows from K and the arm's inertia at its present posture.

    A watchdog holds the last sound command where they stop: see `CommandWatch`.

    .. pydrake_system::

        name: CartesianImpedanceController
        input_ports:
        - desired_pose
        - state
        - command_time (optional)
        output_ports:
        - torque
        - pose
        - impedance_wrench
        - saturation
        - holding

    `desired_pose` and `pose` are X_TP as (6,) [x y z Rz Ry Rx]. `state` is (2n,), joint positions and velocities.
    `command_time` is (1,), the time at which `desired_pose` was given [s]; unconnected, commands never grow old.
    `torque` is (n,) [Nm]. `impedance_wrench` is (6,), force first, in the axes of T. `saturation` is 1 while the wrench
    or a motor is at its limit, `holding` 1 while the watchdog holds; both (1,).
    """

    def __init__(
        self,
        plant: MultibodyPlant,
        target: Frame,
        tool_centre: Frame,
        gains: ImpedanceGains,
        *,
        period: float,
        stiffness_frame: Frame | None = None,
        compensate_gravity: bool = True,
        timeout: float = 0.1,
    ):
        """
        Args:
            plant: the arm with what it carries and nothing else, finalized; only its kinematics and inertia are used.
            target: T, fixed in the world.
            tool_centre: P.
            gains: the impedance.
            period: at which the watchdog looks [s], positive.
            stiffness_frame: whose axes `gains` are along; T unless given. Energy can only be gained from a spring
                whose axes are turned, so a frame that the tool carries along is passive as long as it hardly turns.
            compensate_gravity: False where the robot's own controller does it.
            timeout: age from which a desired pose no longer counts [s], positive.

        Raises:
            InputError: if an argument is out of range.
        """
        super().__init__()
        num_joints = plant.num_positions()
        if np.shape(gains.posture) != (num_joints,):
            raise InputError(f"an impedance's posture must have {num_joints} joints, not {np.shape(gains.posture)}")
        self._plant, self._target, self._tool_centre, self._gains = plant, target, tool_centre, gains
        self._stiffness_frame = stiffness_frame
        self._compensate_gravity = compensate_gravity
        self._torque_limits = plant.GetEffortUpperLimits()

        self._desired_pose = self.DeclareVectorInputPort("desired_pose", 6)
        self._state = self.DeclareVectorInputPort("state", 2 * num_joints)
        self._command_time = self.DeclareVectorInputPort("command_time", 1)
        self._watch = CommandWatch(
            self,
            self._desired_pose,
            self._command_time,
            lambda context: self._pose.Eval(context),
            period=period,
            timeout=timeout,
        )

        self._kinematics = self.DeclareCacheEntry(
            "kinematics",
            ValueProducer(
                allocate=lambda: Value(plant.CreateDefaultContext()),
                calc=lambda context, value: plant.SetPositionsAndVelocities(
                    value.get_mutable_value(), self._state.Eval(context)
                ),
            ),
            {self._state.ticket()},
        )
        self._law = self.DeclareCacheEntry(
            "law",
            ValueProducer(
                allocate=lambda: Value(object()),
                calc=lambda context, value: value.set_value(self._calc_law(context)),
            ),
            self._watch.tickets | {self._state.ticket()},
        )
        law = {self._law.ticket()}
        self._torque = self.DeclareVectorOutputPort("torque", num_joints, self._calc_torque, law)
        self._pose = self.DeclareVectorOutputPort("pose", 6, self._calc_pose, {self._state.ticket()})
        self._wrench = self.DeclareVectorOutputPort("impedance_wrench", 6, self._calc_wrench, law)
        self._saturation = self.DeclareVectorOutputPort("saturation", 1, self._calc_saturation, law)
        self._holding = self.DeclareVectorOutputPort("holding", 1, self._watch.calc_holding, self._watch.commands)

    def get_desired_pose_input_port(self):
        """Where the tool centre shall be, (6,)."""
        return self._desired_pose

    def get_state_input_port(self):
        """Joint positions and velocities, (2n,)."""
        return self._state

    def get_command_time_input_port(self):
        """When the desired pose was given, (1,) [s]; optional."""
        return self._command_time

    def get_torque_output_port(self):
        """Joint torques, (n,) [Nm]."""
        return self._torque

    def get_pose_output_port(self):
        """Where the tool centre is, (6,)."""
        return self._pose

    def get_impedance_wrench_output_port(self):
        """What the spring and the damper apply at P in the axes of T, (6,), force first."""
        return self._wrench

    def get_saturation_output_port(self):
        """1 at a limit, (1,)."""
        return self._saturation

    def get_holding_output_port(self):
        """1 while the watchdog holds, (1,)."""
        return self._holding

    def _calc_law(self, context: Context) -> JointTorques:
        plant, gains = self._plant, self._gains
        plant_context = self._kinematics.Eval(context)
        X_TPd = pose_to_transform(self._watch.pose(context))
        X_TP = self._tool_centre.CalcPose(plant_context, self._target)
        R_TAxes = None
        if self._stiffness_frame is not None:
            R_TAxes = self._stiffness_frame.CalcPose(plant_context, self._target).rotation().matrix()
        eta, epsilon = orientation_error(X_TPd.rotation(), X_TP.rotation())
        J = plant.CalcJacobianSpatialVelocity(
            plant_context, JacobianWrtVariable.kV, self._tool_centre, np.zeros(3), self._target, self._target
        )
        M = plant.CalcMassMatrix(plant_context)
        q, v = plant.GetPositions(plant_context), plant.GetVelocities(plant_context)
        return impedance_torques(
            K=gains.stiffness,
            damping_ratio=gains.damping_ratio,
            wrench_limits=gains.wrench_limits,
            R_axes=R_TAxes,
            p_error=X_TPd.translation() - X_TP.translation(),
            eta=eta,
            epsilon=epsilon,
            J=J[[3, 4, 5, 0, 1, 2]],
            M=M,
            v=v,
            posture_torque=gains.posture_stiffness * (gains.posture - q) - gains.posture_damping * (M @ v),
            gravity_torque=self._gravity_torque(plant_context),
            torque_limits=self._torque_limits,
        )

    def _gravity_torque(self, plant_context: Context) -> np.ndarray:
        if not self._compensate_gravity:
            return np.zeros(self._plant.num_velocities())
        return -self._plant.CalcGravityGeneralizedForces(plant_context)

    def _calc_torque(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._law.Eval(context).torque)

    def _calc_pose(self, context: Context, output: BasicVector) -> None:
        X_TP = self._tool_centre.CalcPose(self._kinematics.Eval(context), self._target)
        output.SetFromVector(transform_to_pose(X_TP))

    def _calc_wrench(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._law.Eval(context).wrench)

    def _calc_saturation(self, context: Context, output: BasicVector) -> None:
        output.SetAtIndex(0, float(self._law.Eval(context).is_saturated))
