"""Measurement of external joint torques by an arm with joint torque sensors."""

from dataclasses import dataclass

import numpy as np
from pydrake.common.value import AbstractValue, Value
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex, RigidBody
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem, ValueProducer

from guiderail.models.common.arrays import as_numbers
from guiderail.systems.disturbances import DRIFT_TIME
from guiderail.systems.support import declarations as declare
from guiderail.systems.support.declarations import input_getter, output_getter
from guiderail.systems.support.drake_multibody import check_bodies

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
