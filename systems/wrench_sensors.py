"""Measurement of the wrench on a tool: at the wrist, or from the joint torques of an arm."""

from dataclasses import dataclass

import numpy as np
from pydrake.common.value import AbstractValue, Value
from pydrake.math import RotationMatrix
from pydrake.multibody.math import SpatialAcceleration, SpatialForce, SpatialVelocity
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex, Frame, JacobianWrtVariable, Joint, RigidBody, WeldJoint
from pydrake.systems.framework import (
    BasicVector,
    Context,
    DiagramBuilder,
    DiscreteValues,
    EventStatus,
    LeafSystem,
    ValueProducer,
)

from guiderail.models.common.arrays import as_numbers, is_finite
from guiderail.models.common.errors import InputError
from guiderail.models.control.wrench import external_wrench
from guiderail.systems.disturbances import DRIFT_TIME
from guiderail.systems.support import declarations as declare
from guiderail.systems.support.declarations import input_getter, output_getter
from guiderail.systems.support.drake_multibody import check_bodies, check_plant


class WrenchSensor(LeafSystem):
    """Measure the wrench of the environment on a tool at the center of compliance, low-pass filtered.

        F = M A + bias(V) − M [0, g] − F_wrist,  τ y' = F − y

    F is the `external_wrench` on a tool with spatial inertia M, velocity V and acceleration A. F_wrist is the reaction
    of the wrist, a joint. The tool consists of the child body of the wrist and all bodies welded to it. F is
    transformed to the center of compliance P and expressed in axes that are fixed in the world. y is the output.

    The inputs are the plant's outputs of the same names. ``wrench`` is (6,), [fx fy fz tx ty tz] in N and Nm. It is a
    discrete state without direct feedthrough, delayed by one sample, and zero after an initialization.

    Args:
        plant: Finalized plant, connected to this system.
        wrist: Joint whose reaction is measured; its child is the first body of `tool`.
        tool: Bodies on the child side of the wrist: the child of the wrist first, then all bodies welded to it.
        center: Center of compliance P, fixed to a body of `tool`.
        R_WAxes: Orientation in the world of the axes in which the wrench is expressed.
        period: Sampling period [s], positive; ideally the plant's time step.
        time_constant: Time constant τ of the filter [s], not negative; 0 disables it.

    Raises:
        InputError: If the time constant is out of range, a body is of another plant, the first body of `tool` is not
            the child of the wrist, `center` is not fixed to a body of `tool`, or a body welded to the tool is missing
            in `tool`.
    """

    def __init__(
        self,
        plant: MultibodyPlant,
        wrist: Joint,
        tool: list[RigidBody],
        center: Frame,
        R_WAxes: RotationMatrix,
        period: float,
        time_constant: float,
    ):
        super().__init__()
        if not 0.0 <= time_constant < np.inf:
            raise InputError(f"a wrench sensor's time constant must be finite and not negative, not {time_constant} s")
        check_bodies(plant, "tool", tool)
        check_plant(plant, center=center)
        if wrist.child_body().index() != tool[0].index():
            raise InputError(f"the first body of a wrench sensor's tool must be the child of {wrist.name()}")
        indices = {int(body.index()) for body in tool}
        if int(center.body().index()) not in indices:
            raise InputError(f"the center {center.name()} must be fixed to a body of a wrench sensor's tool")
        missing = _tool_indices(plant, wrist) - indices
        if missing:
            names = ", ".join(plant.get_body(BodyIndex(index)).name() for index in sorted(missing))
            raise InputError(f"a wrench sensor's tool must contain all bodies that are welded to it: add {names}")
        nominal = plant.CreateDefaultContext()
        self._wrist = int(wrist.index())
        self._tool = int(tool[0].index())
        X_ToolWrist = wrist.frame_on_child().CalcPose(nominal, tool[0].body_frame())
        X_ToolP = center.CalcPose(nominal, tool[0].body_frame())
        # The inertia and the two wrench transforms are constant in the frame of the tool.
        self._M_Tool = plant.CalcSpatialInertia(
            nominal, tool[0].body_frame(), [body.index() for body in tool]
        ).CopyToFullMatrix6()
        self._wrist_to_tool = _wrench_transform(X_ToolWrist.rotation().matrix(), X_ToolWrist.translation())
        self._tool_to_center = _wrench_transform(np.eye(3), -X_ToolP.translation())
        self._R_AxesW = R_WAxes.inverse().matrix()
        has_weight = plant.is_gravity_enabled(tool[0].model_instance())
        self._gravity_W = plant.gravity_field().gravity_vector() if has_weight else np.zeros(3)
        self._decay = float(np.exp(-period / time_constant)) if time_constant > 0.0 else 0.0

        self._reaction_forces_port = self.DeclareAbstractInputPort("reaction_forces", Value([SpatialForce()]))
        self._body_poses_port = self.DeclareAbstractInputPort(
            "body_poses", plant.get_body_poses_output_port().Allocate()
        )
        self._body_spatial_velocities_port = self.DeclareAbstractInputPort(
            "body_spatial_velocities", Value([SpatialVelocity()])
        )
        self._body_spatial_accelerations_port = self.DeclareAbstractInputPort(
            "body_spatial_accelerations", Value([SpatialAcceleration()])
        )
        self._state = self.DeclareDiscreteState(6)
        self.DeclareStateOutputPort("wrench", self._state)
        declare.update(self, period, self._sample, declare.reset_to_default(self))

    def connect(self, builder: DiagramBuilder, plant: MultibodyPlant) -> None:
        """Connect all inputs to the output ports of the plant."""
        builder.Connect(plant.get_reaction_forces_output_port(), self._reaction_forces_port)
        builder.Connect(plant.get_body_poses_output_port(), self._body_poses_port)
        builder.Connect(plant.get_body_spatial_velocities_output_port(), self._body_spatial_velocities_port)
        builder.Connect(plant.get_body_spatial_accelerations_output_port(), self._body_spatial_accelerations_port)

    get_reaction_forces_input_port = input_getter("reaction_forces", "plant's joint reaction forces")
    get_body_poses_input_port = input_getter("body_poses", "plant's body poses")
    get_body_spatial_velocities_input_port = input_getter("body_spatial_velocities", "plant's body velocities")
    get_body_spatial_accelerations_input_port = input_getter("body_spatial_accelerations", "plant's body accelerations")
    get_wrench_output_port = output_getter("wrench", "filtered wrench on the tool, (6,), force first")

    def _sample(self, context: Context, discrete_state: DiscreteValues) -> None:
        newest = self._measure(context)
        last = context.get_discrete_state().value(self._state)
        discrete_state.set_value(newest + self._decay * (last - newest))

    def _measure(self, context: Context) -> np.ndarray:
        F_reaction = self._wrist_to_tool @ self._reaction_forces_port.Eval(context)[self._wrist].get_coeffs()
        R_WTool = self._body_poses_port.Eval(context)[self._tool].rotation().matrix()
        V_W = self._body_spatial_velocities_port.Eval(context)[self._tool].get_coeffs()
        A_W = self._body_spatial_accelerations_port.Eval(context)[self._tool].get_coeffs()
        torque_force = external_wrench(
            F_reaction,
            self._M_Tool,
            (V_W.reshape(2, 3) @ R_WTool).ravel(),
            (A_W.reshape(2, 3) @ R_WTool).ravel(),
            self._gravity_W @ R_WTool,
        )
        at_center = (self._tool_to_center @ torque_force).reshape(2, 3)
        return (at_center[::-1] @ (self._R_AxesW @ R_WTool).T).ravel()


def _tool_indices(plant: MultibodyPlant, wrist: Joint) -> set[int]:
    """Return the indices of the child of the wrist and of all bodies welded to it, apart from the wrist itself."""
    joints = [plant.get_joint(index) for index in plant.GetJointIndices() if index != wrist.index()]
    welds = [
        {int(joint.parent_body().index()), int(joint.child_body().index())}
        for joint in joints
        if isinstance(joint, WeldJoint)
    ]
    found = {int(wrist.child_body().index())}
    while added := set().union(*(weld for weld in welds if weld & found)) - found:
        found |= added
    return found


def _wrench_transform(R: np.ndarray, p: np.ndarray) -> np.ndarray:
    """Return the (6, 6) matrix that transforms a wrench [torque, force] from frame B to frame A; X_AB = (R, p)."""
    p_cross = np.array([[0.0, -p[2], p[1]], [p[2], 0.0, -p[0]], [-p[1], p[0], 0.0]])
    return np.block([[R, p_cross @ R], [np.zeros((3, 3)), R]])


FRICTION_SPEED = 0.01  # joint speed at which friction has 76 % of its magnitude [rad/s]


@dataclass(frozen=True)
class JointTorqueErrors:
    """Errors of joint torque sensors and of the arm's model, constant during an episode.

    Attributes:
        gain: Relative error of each sensor, (n,).
        offset: Offset of each sensor, (n,) [Nm].
        friction: Friction torque that each sensor measures, (n,) [Nm].
        mass: Actual minus modelled mass of each body but the world, (B,) [kg].
        center: Actual minus modelled center of mass of each body but the world, (B, 3) [m].
    """

    gain: np.ndarray
    offset: np.ndarray
    friction: np.ndarray
    mass: np.ndarray
    center: np.ndarray


class ExternalTorqueSensor(LeafSystem):
    """Measure external joint torques with errors of sensors, friction and model.

        τ = τ_c + ε ∘ (τ_c + g(q)) + g'(q) − g(q) − c ∘ tanh(v / v₀) + b + d + σ ∘ w,  w ~ N(0, 1) once per period

    An arm computes its external torques as the measured torques minus the torques of its model. q and v are the joint
    positions and velocities. τ_c are the torques of contact forces. g(q) are the gravity torques of the model, and
    g'(q) the gravity torques of the actual bodies. ε are relative errors of the sensors, c friction torques with
    v₀ = `FRICTION_SPEED`, b offsets, and d a random walk. Inertial torques are compensated exactly. ε, c, b and the
    actual bodies are parameters, which `set_errors` sets at a reset.

    ``state`` is (2n,), positions and velocities of the joints [rad, rad/s]. ``contact_torque`` and ``external_torque``
    are (n,) [Nm].

    Args:
        plant: Finalized model of only the arm.
        payload_body: Body of the plant, not the world; a payload is rigidly attached at its center of mass.
        noise: Standard deviations σ, (n,) [Nm], not negative, finite.
        drift: Standard deviations of d after `DRIFT_TIME`, (n,) [Nm], not negative, finite.
        period: Period of noise and drift [s], positive.

    Raises:
        InputError: If the body is of another plant. At an evaluation, if a position is not finite.
    """

    def __init__(
        self, plant: MultibodyPlant, payload_body: RigidBody, noise: np.ndarray, drift: np.ndarray, *, period: float
    ):
        super().__init__()
        check_bodies(plant, "payload_body", [payload_body])
        n = plant.num_positions()
        self._noise, self._drift = as_numbers(noise, "noise"), as_numbers(drift, "drift")
        self._plant, self._step = plant, np.sqrt(period / DRIFT_TIME)
        self._bodies = [plant.get_body(BodyIndex(i)) for i in range(1, plant.num_bodies())]
        self._nominal = [body.default_mass() for body in self._bodies]
        nominal = plant.CreateDefaultContext()
        self._centers = [body.CalcCenterOfMassInBodyFrame(nominal) for body in self._bodies]
        self._payload_index = [int(body.index()) for body in self._bodies].index(int(payload_body.index()))
        bodies = len(self._bodies)
        self._gain, self._offset, self._friction, self._mass, self._center, self._seed = (
            self.DeclareNumericParameter(BasicVector(np.zeros(size))) for size in (n, n, n, bodies, 3 * bodies, 1)
        )
        self._count = self.DeclareDiscreteState(1)
        self._noise_sample, self._walk = self.DeclareDiscreteState(n), self.DeclareDiscreteState(n)
        self._state_port = self.DeclareVectorInputPort("state", 2 * n)
        self._contact_torque_port = self.DeclareVectorInputPort("contact_torque", n)
        self._model = declare.plant_context(self, plant, self._positions, [self._state_port])
        self._bodies_set = declare.cache(self, "actual_bodies", self._actual_bodies, [self.all_parameters_ticket()])
        # The value is [plant context, result of `_actual_bodies` that is set in it]. Masses and centers of mass change
        # only at a reset, positions at every step.
        self._actual = self.DeclareCacheEntry(
            description="actual_arm",
            value_producer=ValueProducer(
                allocate=lambda: Value([plant.CreateDefaultContext(), None]), calc=self._calc_actual
            ),
            prerequisites_of_calc={self._state_port.ticket(), self._bodies_set.ticket()},
        )
        sources = [self._contact_torque_port, self._model, self._actual, self._noise_sample, self._walk]
        declare.output(self, "external_torque", n, self._external_torque, sources)
        declare.update(self, period, self._update, declare.reset_to_default(self))

    get_state_input_port = input_getter("state", "positions and velocities of the joints, (2n,)")
    get_contact_torque_input_port = input_getter("contact_torque", "joint torques of contact forces, (n,) [Nm]")
    get_external_torque_output_port = output_getter("external_torque", "measured external torques, (n,) [Nm]")

    @property
    def bodies(self) -> tuple[RigidBody, ...]:
        """Bodies of the plant without the world, (B,), in the order of `JointTorqueErrors`."""
        return tuple(self._bodies)

    def set_errors(self, context: Context, errors: JointTorqueErrors, seed: int) -> None:
        """Set the errors of an episode, and the seed of noise and drift; `context` is this system's."""
        parameters = (self._gain, self._offset, self._friction, self._mass, self._center, self._seed)
        values = (errors.gain, errors.offset, errors.friction, errors.mass, errors.center.ravel(), np.array([seed]))
        for index, numbers in zip(parameters, values, strict=True):
            context.get_mutable_numeric_parameter(index).SetFromVector(numbers)

    def add_payload(self, context: Context, mass: float) -> None:
        """Add a payload of `mass` [kg] that the model of the arm does not contain; `context` is this system's."""
        masses = context.get_mutable_numeric_parameter(self._mass)
        masses.SetAtIndex(self._payload_index, masses.GetAtIndex(self._payload_index) + mass)

    def _positions(self, context: Context) -> np.ndarray:
        return self._state_port.Eval(context)[: len(self._noise)]

    def _actual_bodies(self, context: Context) -> list[tuple[float, np.ndarray]]:
        """Return the actual mass [kg] and center of mass (3,) [m] of each body."""
        masses = context.get_numeric_parameter(self._mass).value()
        centers = context.get_numeric_parameter(self._center).value().reshape(-1, 3)
        return [
            (max(nominal + mass, 0.0), nominal_center + center)
            for nominal, nominal_center, mass, center in zip(self._nominal, self._centers, masses, centers, strict=True)
        ]

    def _calc_actual(self, context: Context, value: AbstractValue) -> None:
        arm, actual = value.get_mutable_value(), self._bodies_set.Eval(context)
        self._plant.SetPositions(arm[0], self._positions(context))
        if arm[1] is not actual:
            for body, (mass, center) in zip(self._bodies, actual, strict=True):
                body.SetMass(arm[0], mass)
                body.SetCenterOfMassInBodyFrame(arm[0], center)
            arm[1] = actual

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        count = context.get_discrete_state().value(self._count)[0] + 1.0
        seed = context.get_numeric_parameter(self._seed).value()[0]
        noise, step = np.random.default_rng([int(seed), int(count)]).standard_normal((2, len(self._noise)))
        walk = context.get_discrete_state().value(self._walk)
        discrete_state.set_value(self._count, [count])
        discrete_state.set_value(self._noise_sample, self._noise * noise)
        discrete_state.set_value(self._walk, walk + self._step * self._drift * step)

    def _external_torque(self, context: Context) -> np.ndarray:
        n = len(self._noise)
        contact, velocities = self._contact_torque_port.Eval(context), self._state_port.Eval(context)[n:]
        gravity = self._plant.CalcGravityGeneralizedForces(self._model.Eval(context))
        actual = self._plant.CalcGravityGeneralizedForces(self._actual.Eval(context)[0])
        gain, offset, friction = (
            context.get_numeric_parameter(index).value() for index in (self._gain, self._offset, self._friction)
        )
        noise, walk = (context.get_discrete_state().value(index) for index in (self._noise_sample, self._walk))
        return (
            contact
            + gain * (contact + gravity)
            + (actual - gravity)
            - friction * np.tanh(velocities / FRICTION_SPEED)
            + offset
            + walk
            + noise
        )


MAX_TORQUE = 1e4  # torque to which samples are clipped [Nm], far above the joint torques of an arm


class JointTorqueWrench(LeafSystem):
    """Estimate the wrench of the environment on a tool from external joint torques, low-pass filtered.

        F = (Jᵀ)⁺ τ_external,  t_f y' = F − y

    J is the Jacobian of the tool center, and y the output. τ_external are the measured joint torques minus the torques
    of the arm's weight and inertia. The controller of an arm with torque sensors provides τ_external. The pseudoinverse
    is damped, so that the estimate tends to zero near a singular posture instead of diverging.

    ``positions`` [rad] and ``external_torque`` [Nm] are (n,), in the order of the plant's joint positions. ``wrench``
    is (6,), at the tool center P in the axes of T, [fx fy fz tx ty tz] in N and Nm. It is a discrete state without
    direct feedthrough, delayed by one sample, and zero after an initialization. The first sample initializes the
    filter, because a filter that starts at zero would not have settled when the wrench is tared. Samples that are not
    finite are skipped. Torques are clipped to `MAX_TORQUE`, so that the effect of a single false sample of any size
    decays within a few time constants.

    Args:
        plant: Finalized model of only the arm.
        target: Frame T.
        tool_center: Frame P.
        period: Sampling period [s], positive.
        time_constant: Time constant t_f of the filter [s], not negative, finite; 0 disables it.
        damping: Damping of the pseudoinverse, not negative, finite; positive if a posture may be singular.

    Raises:
        InputError: If an argument is out of range.
        LinAlgError: At an update, if the damping is 0 and the posture is singular.
    """

    def __init__(
        self,
        plant: MultibodyPlant,
        target: Frame,
        tool_center: Frame,
        *,
        period: float,
        time_constant: float,
        damping: float = 1e-4,
    ):
        super().__init__()
        if not (0.0 <= time_constant < np.inf and 0.0 <= damping < np.inf):
            raise InputError("a wrench estimate's time constant and damping must be finite and not negative")
        check_plant(plant, target=target, tool_center=tool_center)
        num_joints = plant.num_positions()
        self._plant, self._target, self._tool_center = plant, target, tool_center
        self._damping = damping * np.eye(6)
        self._decay = float(np.exp(-period / time_constant)) if time_constant > 0.0 else 0.0
        self._positions_port = self.DeclareVectorInputPort("positions", num_joints)
        self._external_torque_port = self.DeclareVectorInputPort("external_torque", num_joints)
        self._state = self.DeclareDiscreteState(6)
        self._has_sample = self.DeclareDiscreteState(1)
        self.DeclareStateOutputPort("wrench", self._state)
        self._plant_context = declare.plant_context(self, plant, self._positions_port.Eval, [self._positions_port])
        declare.update(self, period, self._sample, declare.reset_to_default(self))

    get_positions_input_port = input_getter("positions", "measured joint positions, (n,) [rad]")
    get_external_torque_input_port = input_getter("external_torque", "external joint torques, (n,) [Nm]")
    get_wrench_output_port = output_getter("wrench", "filtered wrench on the tool, (6,), force first")

    def _sample(self, context: Context, discrete_state: DiscreteValues) -> EventStatus:
        external_torque = self._external_torque_port.Eval(context)
        # NaN would remain in the state of the filter.
        if not is_finite(self._positions_port.Eval(context)) or not is_finite(external_torque):
            return EventStatus.DidNothing()
        plant_context, target = self._plant_context.Eval(context), self._target
        J = self._plant.CalcJacobianSpatialVelocity(
            plant_context, JacobianWrtVariable.kV, self._tool_center, np.zeros(3), target, target
        )
        # [torque, force], because the rows of the Jacobian are [rotational, translational]
        F = np.linalg.solve(J @ J.T + self._damping, J @ np.clip(external_torque, -MAX_TORQUE, MAX_TORQUE))
        newest = np.concatenate([F[3:], F[:3]])
        if context.get_discrete_state().value(self._has_sample)[0]:
            last = context.get_discrete_state().value(self._state)
            newest = newest + self._decay * (last - newest)
        discrete_state.set_value(self._state, newest)
        discrete_state.set_value(self._has_sample, np.ones(1))
        return EventStatus.Succeeded()
