"""Cartesian impedance control of a torque-controlled arm."""

from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
from pydrake.autodiffutils import AutoDiffXd
from pydrake.math import RigidTransform_, RollPitchYaw_
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import Frame, JacobianWrtVariable
from pydrake.systems.framework import BasicVector, BasicVector_, Context

from guiderail.models.common.arrays import as_numbers, is_finite
from guiderail.models.common.errors import InputError
from guiderail.models.control.cartesian_impedance import ArmImpedance, JointTorques, impedance_torques
from guiderail.models.control.wrench import MAX_WRENCH_SIZE, WrenchBound
from guiderail.systems.support import declarations as declare
from guiderail.systems.support.declarations import input_getter, output_getter
from guiderail.systems.support.drake_multibody import (
    check_plant,
    effort_limits,
    orientation_error,
    pose_to_transform,
    transform_to_pose,
)
from guiderail.systems.support.last_valid import CommandValidity, LastValidBound, LastValidPose
from guiderail.systems.support.scalar_conversion import ConvertibleSystem, differentiable_torques, values_of

MAX_STIFFNESS = 1e8  # largest stiffness [N/m, Nm/rad]; above it, wrenches could overflow


@dataclass(frozen=True)
class ImpedanceGains:
    """Stiffness, damping and limits of a Cartesian impedance, and its null-space posture.

    Args:
        stiffness: Stiffness matrix (6, 6), symmetric, positive definite, [translational, rotational] in N/m and Nm/rad,
            along the axes of the target frame T.
        wrench_limits: Limits (6,) of the wrench along these axes [N, Nm], positive and finite.
        damping_ratio: Damping ratio of every mode, positive and finite.
        posture: Joint positions (n,) that the null-space control returns to [rad], finite.
        posture_stiffness: Stiffness of the return to the posture [Nm/rad], not negative, finite.
        posture_damping: Decay rate of null-space motion [1/s], not negative, finite. Its torque is this rate times M v,
            which dissipates energy in every posture.
        bound: Bound of the wrench along these axes; None: `wrench_limits`.

    Raises:
        InputError: If an argument is out of range or of another shape.
    """

    stiffness: np.ndarray
    wrench_limits: np.ndarray
    posture: np.ndarray
    damping_ratio: float = 1.0
    posture_stiffness: float = 10.0
    posture_damping: float = 5.0
    bound: WrenchBound | None = None

    def __post_init__(self) -> None:
        K = as_numbers(self.stiffness, "a Cartesian stiffness")
        is_symmetric = K.shape == (6, 6) and np.allclose(K, K.T)
        if not is_symmetric or not (np.abs(K) <= MAX_STIFFNESS).all() or not (np.linalg.eigvalsh(K) > 0.0).all():
            raise InputError(
                f"a Cartesian stiffness must be a symmetric, positive definite 6 × 6 matrix, at most {MAX_STIFFNESS:g}"
            )
        limits = as_numbers(self.wrench_limits, "the wrench limits of an impedance")
        if limits.shape != (6,) or not ((limits > 0.0) & (limits < np.inf)).all():
            raise InputError(f"an impedance needs six positive, finite wrench limits, not {self.wrench_limits}")
        posture_gains = (self.posture_stiffness, self.posture_damping)
        if not 0.0 < self.damping_ratio < np.inf or not all(0.0 <= gain < np.inf for gain in posture_gains):
            raise InputError(
                "an impedance's damping ratio must be positive, its posture's gains not negative, and all of them "
                "finite"
            )
        posture = as_numbers(self.posture, "the posture of an impedance")
        if not np.isfinite(posture).all():
            raise InputError(f"an impedance's posture must be finite joint positions, not {self.posture}")
        for name, array in (("stiffness", K), ("wrench_limits", limits), ("posture", posture)):
            array.flags.writeable = False  # a copy: writing must not change a running controller
            object.__setattr__(self, name, array)


@dataclass(frozen=True)
class Payload:
    """Point mass at the tool that a controller compensates, in addition to its plant.

    Args:
        mass: Mass [kg], not negative, finite.
        center: Center of mass in the frame of the tool center, (3,) [m].

    Raises:
        InputError: If an argument is out of range or of another shape.
    """

    mass: float = 0.0
    center: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        center = as_numbers(self.center, "the center of a payload")
        if not 0.0 <= self.mass < np.inf or center.shape != (3,) or not np.isfinite(center).all():
            raise InputError(f"a payload has a finite mass of at least 0 and a center of three numbers, not {self}")


class CartesianImpedanceController(ConvertibleSystem):
    """Impedance controller: the tool center P of an arm acts as a spring and damper around a desired pose.

        τ = Jᵀ clip(K e − D V) + N τ_posture + g(q), clipped to the motors' limits

    J is the Jacobian of P, e the pose error, V the velocity of P and N the projector into the null space; see
    `impedance_torques`. The axes of K are those of T. The orientation error is computed from
    quaternions, so no orientation is singular. The damping D is computed from K and the arm's inertia in its present
    posture. While no valid command is available, the last valid command is followed (`LastValidPose`).

    Gains and payload are numeric parameters of the context: `set_gains` and `set_payload` change them between two steps
    of a simulation, and a context that is copied or restored has them.

    `ToAutoDiffXd` converts a controller without bound, for derivatives with respect to state, desired pose, gains and
    payload. The converted controller follows the present command, whether it is valid or not.

    ``desired_pose`` and ``pose`` are X_TP as (6,) [x y z Rz Ry Rx] in meters and radians. ``estimated_state`` is (2n,),
    joint positions and velocities [rad, rad/s]. ``command_time`` is (1,), the time stamp of ``desired_pose`` [s]; if it
    is not connected, commands never time out. ``max_wrench`` is (8,), limits of [fx fy fz tx ty tz] along the axes of
    the gains, of the norm of the force and of the norm of the torque [N, Nm]. It can lower the bound but not raise it.
    While a number of ``max_wrench`` is NaN or negative, its last valid value is used (`LastValidBound`).

    ``generalized_force`` is (n,), joint torques [Nm]. Its order, as that of ``estimated_state``, is the order of the
    plant's velocities. If the plant's actuators have another order, connect ``generalized_force`` to the plant's
    actuation port through a `MatrixGain` with the matrix ``plant.MakeActuationMatrix().T``. ``impedance_wrench`` is
    (6,), force first, in the axes of T. ``saturation`` (1,) is 1 while the wrench or a motor is at its limit.
    ``command_timed_out`` (1,) is 1 while no valid command is available.

    Args:
        plant: Finalized model of only the arm and its payload, with one actuator per joint; provides kinematics,
            inertia and effort limits.
        target: Frame T, fixed in the world.
        tool_center: Frame P.
        gains: Impedance parameters.
        period: Period of the command check [s], positive.
        compensate_gravity: False if the controller of the robot compensates gravity already.
        timeout: Age above which a desired pose is stale [s], positive and finite.

    Raises:
        InputError: If a frame belongs to another plant, T is not fixed in the world, or a joint does not have exactly
            one actuator. At an evaluation, if the estimated state is not finite. At a conversion, if the impedance is
            bounded or the scalar type is not AutoDiffXd.
    """

    def __init__(
        self,
        plant: MultibodyPlant,
        target: Frame,
        tool_center: Frame,
        gains: ImpedanceGains,
        *,
        period: float,
        compensate_gravity: bool = True,
        timeout: float = 0.1,
    ):
        super().__init__()
        check_plant(plant, target, target=target, tool_center=tool_center)
        num_joints = plant.num_positions()
        self._plant, self._target, self._tool_center, self._gains = plant, target, tool_center, gains
        self._default_parameters = [*_to_numbers(gains), np.zeros(4)]
        self._parameters = [self.DeclareNumericParameter(BasicVector(numbers)) for numbers in self._default_parameters]
        self._tuning = declare.cache(self, "gains_and_payload", self._calc_tuning, [self.all_parameters_ticket()])
        self._compensate_gravity = compensate_gravity
        self._torque_limits = effort_limits(plant)

        self._desired_pose_port = self.DeclareVectorInputPort("desired_pose", 6)
        self._estimated_state_port = self.DeclareVectorInputPort("estimated_state", 2 * num_joints)
        self._command_time_port = self.DeclareVectorInputPort("command_time", 1)
        validity = CommandValidity(self._command_time_port, period=period, timeout=timeout)
        self._followed_pose = LastValidPose(self, self._desired_pose_port, validity, self._pose)

        self._max_wrench_port = self.DeclareVectorInputPort("max_wrench", MAX_WRENCH_SIZE)
        self._plant_context = declare.plant_context(
            self, plant, self._estimated_state_port.Eval, [self._estimated_state_port]
        )
        bound = gains.bound or WrenchBound(gains.wrench_limits, np.inf, np.inf)
        self._requested_bound = LastValidBound(self, bound, self._max_wrench_port, period=period)
        sources = [*self._followed_pose.sources, self._estimated_state_port, *self._requested_bound.sources]
        self._law = declare.cache(self, "law", self._calc_law, [*sources, self._tuning])
        declare.part_output(self, "generalized_force", self._law, lambda law: law.torque, num_joints)
        declare.output(self, "pose", 6, self._pose, [self._estimated_state_port])
        declare.part_output(self, "impedance_wrench", self._law, lambda law: law.wrench, 6)
        declare.part_output(self, "saturation", self._law, lambda law: float(law.is_saturated))
        self._followed_pose.declare_timed_out_output(self)

    get_desired_pose_input_port = input_getter("desired_pose", "desired pose of the tool center, (6,)")
    get_estimated_state_input_port = input_getter("estimated_state", "joint state, (2n,) [rad, rad/s]")
    get_command_time_input_port = input_getter("command_time", "time stamp of the desired pose, (1,) [s]; optional")
    get_max_wrench_input_port = input_getter("max_wrench", "limits per axis and of the norms, (8,) [N, Nm]; optional")
    get_generalized_force_output_port = output_getter("generalized_force", "joint torques, (n,) [Nm]")
    get_pose_output_port = output_getter("pose", "measured pose of the tool center, (6,)")
    get_impedance_wrench_output_port = output_getter("impedance_wrench", "wrench of spring and damper, (6,)")
    get_saturation_output_port = output_getter("saturation", "flag that the wrench or a motor is at its limit, (1,)")
    get_command_timed_out_output_port = output_getter("command_timed_out", "flag that no command is valid, (1,)")

    def gains(self, context: Context) -> ImpedanceGains:
        """Return the gains; `context` is the context of the system."""
        gains, _ = self._tuning.Eval(context)
        return gains

    def set_gains(self, context: Context, gains: ImpedanceGains) -> None:
        """Set the gains in the context of the system.

        Raises:
            InputError: If the context is another system's, or the bound is not the one of the constructor; lower a
                bound at ``max_wrench``.
        """
        declare.check_own_context(self, context)
        if gains.bound is not self._gains.bound:
            raise InputError("the bound of an impedance is constant: keep it, and lower it at the port max_wrench")
        for index, numbers in zip(self._parameters, _to_numbers(gains), strict=False):
            context.get_mutable_numeric_parameter(index).SetFromVector(numbers)

    def set_payload(self, context: Context, payload: Payload) -> None:
        """Set the payload that is compensated, in the context of the system.

        Raises:
            InputError: If the context is another system's.
        """
        declare.check_own_context(self, context)
        numbers = np.array([payload.mass, *payload.center])
        context.get_mutable_numeric_parameter(self._parameters[-1]).SetFromVector(numbers)

    def _calc_tuning(self, context: Context) -> tuple[ImpedanceGains, Payload]:
        """Return gains and payload of the context; the gains of the constructor are not converted back."""
        numbers = [np.array(context.get_numeric_parameter(index).CopyToVector()) for index in self._parameters]
        *gains, payload = numbers
        mass, x, y, z = payload.tolist()
        if all(map(np.array_equal, gains, _to_numbers(self._gains))):
            return self._gains, Payload(mass, (x, y, z))
        stiffness, limits, posture, (ratio, posture_stiffness, posture_damping) = gains
        changed = replace(
            self._gains,
            stiffness=stiffness.reshape(6, 6),
            wrench_limits=limits,
            posture=posture,
            damping_ratio=float(ratio),
            posture_stiffness=float(posture_stiffness),
            posture_damping=float(posture_damping),
        )
        return changed, Payload(mass, (x, y, z))

    def _pose(self, context: Context) -> np.ndarray:
        return transform_to_pose(self._tool_center.CalcPose(self._plant_context.Eval(context), self._target))

    def _calc_law(self, context: Context) -> JointTorques:
        gains, payload = self._tuning.Eval(context)
        plant_context = self._plant_context.Eval(context)
        X_TPd = pose_to_transform(self._followed_pose.eval(context))
        law = self._law_arguments(self._plant, plant_context, X_TPd, gains, payload.mass, np.array(payload.center))
        return impedance_torques(law, self._bound(context))

    def _law_arguments(
        self, plant: Any, plant_context: Any, X_TPd: Any, gains: Any, mass: Any, center: np.ndarray
    ) -> ArmImpedance:
        """Return the arguments of the law, for a plant of any scalar type; `mass` and `center` are of the payload."""
        frames = (self._tool_center, self._target)
        tool_center, target = (plant.get_frame(frame.index()) for frame in frames)
        X_TP = tool_center.CalcPose(plant_context, target)
        eta, epsilon = orientation_error(X_TPd.rotation(), X_TP.rotation())
        J = plant.CalcJacobianSpatialVelocity(
            plant_context, JacobianWrtVariable.kV, tool_center, np.zeros(3), target, target
        )
        M = plant.CalcMassMatrix(plant_context)
        q, v = plant.GetPositions(plant_context), plant.GetVelocities(plant_context)
        gravity_torque = np.zeros_like(v)
        if self._compensate_gravity:
            gravity_torque = -plant.CalcGravityGeneralizedForces(plant_context)
        if mass > 0.0:
            world = plant.world_frame()
            J_center = plant.CalcJacobianTranslationalVelocity(
                plant_context, JacobianWrtVariable.kV, tool_center, center, world, world
            )
            M = M + mass * J_center.T @ J_center
            if self._compensate_gravity:
                weight = mass * plant.gravity_field().gravity_vector()
                gravity_torque = gravity_torque - J_center.T @ weight
        return ArmImpedance(
            K=gains.stiffness,
            damping_ratio=gains.damping_ratio,
            wrench_limits=gains.wrench_limits,
            p_error=X_TPd.translation() - X_TP.translation(),
            eta=eta,
            epsilon=epsilon,
            J=J[[3, 4, 5, 0, 1, 2]],
            M=M,
            v=v,
            posture_torque=gains.posture_stiffness * (gains.posture - q) - gains.posture_damping * (M @ v),
            gravity_torque=gravity_torque,
            torque_limits=self._torque_limits,
        )

    def declare_converted(self, system: Any, scalar: type) -> None:
        """Declare the ports, states and parameters of this system in `system`, a system of `AutoDiffXd`.

        Raises:
            InputError: If the impedance is bounded, or `scalar` is another type.
        """
        if scalar is not AutoDiffXd:
            raise InputError("an impedance has no symbolic form: convert it to AutoDiffXd, or evaluate it with floats")
        if self._gains.bound is not None:
            raise InputError("the law of a bounded impedance is not smooth: convert a controller without bound")
        default = self.CreateDefaultContext().get_discrete_state()
        for number in range(default.num_groups()):
            system.DeclareDiscreteState(default.value(number))
        parameters = [system.DeclareNumericParameter(BasicVector_[scalar](n)) for n in self._default_parameters]
        ports = [self.get_input_port(index) for index in range(self.num_input_ports())]
        inputs = {port.get_name(): system.DeclareVectorInputPort(port.get_name(), port.size()) for port in ports}
        state, desired_pose = inputs["estimated_state"], inputs["desired_pose"]
        plant = self._plant.ToAutoDiffXd()

        def calc_law(context: Any) -> tuple[JointTorques, np.ndarray]:
            if inputs["max_wrench"].HasValue(context):
                raise InputError("the law of a bounded impedance is not smooth: do not connect max_wrench")
            numbers = [context.get_numeric_parameter(index).CopyToVector() for index in parameters]
            stiffness, limits, posture, (ratio, posture_stiffness, posture_damping), payload = numbers
            gains = SimpleNamespace(
                stiffness=stiffness.reshape(6, 6),
                wrench_limits=limits,
                posture=posture,
                damping_ratio=ratio,
                posture_stiffness=posture_stiffness,
                posture_damping=posture_damping,
            )
            plant_context, pose, present = plant.CreateDefaultContext(), desired_pose.Eval(context), state.Eval(context)
            for name, values in (("state", present), ("desired pose", pose)):
                if not is_finite(values_of(values)):  # Drake would abort the process
                    raise InputError(f"derivatives of an impedance need a finite {name}, not {values_of(values)}")
            plant.SetPositionsAndVelocities(plant_context, present)
            X_TPd = RigidTransform_[scalar](RollPitchYaw_[scalar](pose[5], pose[4], pose[3]), pose[:3])
            tool_center, target = (plant.get_frame(frame.index()) for frame in (self._tool_center, self._target))
            X_TP = tool_center.CalcPose(plant_context, target)
            measured = [*X_TP.translation(), *RollPitchYaw_[scalar](X_TP.rotation()).vector()[::-1]]
            law = self._law_arguments(plant, plant_context, X_TPd, gains, payload[0], payload[1:])
            return differentiable_torques(law), np.array(measured)

        sources = [state, desired_pose, inputs["max_wrench"], system.all_parameters_ticket()]
        law = declare.cache(system, "law", calc_law, sources)
        declare.part_output(system, "generalized_force", law, lambda value: value[0].torque, len(self._torque_limits))
        declare.part_output(system, "pose", law, lambda value: value[1], 6)
        declare.part_output(system, "impedance_wrench", law, lambda value: value[0].wrench, 6)
        declare.part_output(system, "saturation", law, lambda value: scalar(float(value[0].is_saturated)))
        declare.scalar_output(system, "command_timed_out", lambda context: scalar(0.0), [system.nothing_ticket()])

    def _bound(self, context: Context) -> WrenchBound | None:
        return self._requested_bound.eval(context) if self._max_wrench_port.HasValue(context) else self._gains.bound


def _to_numbers(gains: ImpedanceGains) -> list[np.ndarray]:
    """Return the numeric parameters of gains: stiffness (36,), limits (6,), posture (n,), ratio and posture's gains."""
    scalars = [gains.damping_ratio, gains.posture_stiffness, gains.posture_damping]
    arrays = (gains.stiffness, gains.wrench_limits, gains.posture, scalars)
    return [np.asarray(numbers, dtype=float).ravel() for numbers in arrays]
