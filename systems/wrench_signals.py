"""Signals that are computed from contacts, forces and wrenches."""

from collections.abc import Sequence
from itertools import product

import numpy as np
from pydrake.common.value import Value
from pydrake.multibody.plant import ContactResults, MultibodyPlant
from pydrake.multibody.tree import RigidBody
from pydrake.systems.framework import Context, DiscreteValues, InputPort, LeafSystem

from guiderail.models.common.arrays import is_finite, norm
from guiderail.models.common.errors import InputError
from guiderail.models.common.transforms import POSE_SIZE, WRENCH_SIZE, wrench_of_generalized_force
from guiderail.models.control.wrench import ContactPointMean, center_of_pressure
from guiderail.systems.support import declarations as declare
from guiderail.systems.support.declarations import input_getter, output_getter
from guiderail.systems.support.drake_multibody import check_bodies

ZERO, ONE = np.zeros(1), np.ones(1)  # values of flags, because converting a list takes longer than the contact check


class PoseWrench(LeafSystem):
    """Transform generalized forces along pose coordinates into the wrench at the tool center.

        f = τ_xyz,  [ez, Rz(a) ey, Rz(a) Ry(b) ex]ᵀ t = τ_abc

    f is the force, t the torque and τ the generalized force (see `wrench_of_generalized_force`). On a gantry, the joint
    positions are the tool's pose coordinates. The wrench of the environment on the tool, without the tool's weight and
    inertia, is therefore computed from the plant's generalized contact forces.

    ``pose`` is X_TP, the pose of the tool center P in a frame T, as (6,) [x y z a b c] in meters and radians.
    ``generalized_force`` is (6,), along and about these coordinates [N, Nm]. ``wrench`` is (6,), [fx fy fz tx ty tz] at
    P in the axes of T [N, Nm].
    """

    def __init__(self) -> None:
        super().__init__()
        self._pose_port = self.DeclareVectorInputPort("pose", POSE_SIZE)
        self._generalized_force_port = self.DeclareVectorInputPort("generalized_force", POSE_SIZE)
        sources = [self._pose_port, self._generalized_force_port]
        declare.output(self, "wrench", WRENCH_SIZE, self._wrench, sources)

    get_pose_input_port = input_getter("pose", "pose X_TP, (6,)")
    get_generalized_force_input_port = input_getter("generalized_force", "generalized forces, (6,) [N, Nm]")
    get_wrench_output_port = output_getter("wrench", "wrench at P in the axes of T, (6,), force first")

    def _wrench(self, context: Context) -> np.ndarray:
        return wrench_of_generalized_force(self._pose_port.Eval(context), self._generalized_force_port.Eval(context))


class WrenchTare(LeafSystem):
    """Subtract the mean of the first measurements, which are taken in free motion, from all later measurements.

        y_k = 0 for k < s + n,  y_k = u_k − (1/n) Σ u_j over j = s … s + n − 1 afterwards

    k counts samples since the initialization. The first s samples are skipped, because filters settle during this time.
    The next n finite samples are averaged; samples that are not finite are not counted. A contact force during these n
    samples would be subtracted as well.

    Both ports are (6,), force first [N, Nm].

    Args:
        period: Sampling period [s], positive.
        skipped: Number s of skipped samples, at least 0.
        averaged: Number n of averaged samples, at least 1.
    """

    def __init__(self, period: float, skipped: int, averaged: int):
        super().__init__()
        self._skipped, self._averaged = skipped, averaged
        self._count = self.DeclareDiscreteState(1)  # number k of samples so far
        self._offset = self.DeclareDiscreteState(WRENCH_SIZE)  # mean of the averaged samples so far
        self._measured_wrench_port = self.DeclareVectorInputPort("measured_wrench", WRENCH_SIZE)
        sources = [self._measured_wrench_port, self._count, self._offset]
        declare.output(self, "tared_wrench", WRENCH_SIZE, self._tared_wrench, sources)
        declare.update(self, period, self._update, declare.reset_to_default(self))

    get_measured_wrench_input_port = input_getter("measured_wrench", "wrench with a bias, (6,)")
    get_tared_wrench_output_port = output_getter("tared_wrench", "wrench without the bias, (6,)")

    def is_tared(self, context: Context) -> bool:
        """Return True if all samples of the mean have been taken; `context` is this system's."""
        return context.get_discrete_state().value(self._count).item() >= self._skipped + self._averaged

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        if self.is_tared(context):
            return
        count = context.get_discrete_state().value(self._count).item()
        if count >= self._skipped:
            offset = context.get_discrete_state().value(self._offset)
            sample = self._measured_wrench_port.Eval(context)
            if not is_finite(sample):
                return
            discrete_state.set_value(self._offset, offset + (sample - offset) / (count - self._skipped + 1.0))
        discrete_state.set_value(self._count, [count + 1.0])

    def _tared_wrench(self, context: Context) -> np.ndarray:
        if not self.is_tared(context):
            return np.zeros(WRENCH_SIZE)
        return self._measured_wrench_port.Eval(context) - context.get_discrete_state().value(self._offset)


class CenterOfPressure(LeafSystem):
    """Center of pressure of a contact force along z, relative to the tool center.

        center_of_pressure = (−τ_y, τ_x) / f_z if f_z ≥ min_force, otherwise 0

    A point force along z at p has the torque τ = p × f, so the center of pressure is p for any magnitude of the force.

    ``wrench`` is (6,), force and torque about the tool center [N, Nm]. ``center_of_pressure`` is (2,), x and y [m].

    Args:
        min_force: Force along z below which the output is 0 [N], positive and finite.

    Raises:
        InputError: If `min_force` is out of range.
    """

    def __init__(self, min_force: float):
        super().__init__()
        _check_min_force(min_force)
        self._wrench_port = self.DeclareVectorInputPort("wrench", WRENCH_SIZE)
        declare.output(
            self,
            "center_of_pressure",
            2,
            lambda context: center_of_pressure(self._wrench_port.Eval(context), min_force),
            [self._wrench_port],
        )

    get_wrench_input_port = input_getter("wrench", "wrench about the tool center, (6,) [N, Nm]")
    get_center_of_pressure_output_port = output_getter("center_of_pressure", "center of pressure, (2,) [m]")


class MeanContactPoint(LeafSystem):
    """Average the points of contact of a tool on a fixed surface, relative to the tool center (`ContactPointMean`).

        n' = min(n + 1, τ / h),  m' = m + (p + c − m) / n'   if f_z ≥ min_force, otherwise unchanged
        mean_contact_point = m − p if n > 0, otherwise 0

    p is the tool's position in x and y, c its center of pressure (`CenterOfPressure`), and h the period.

    ``pose`` is X_TP and ``wrench`` the wrench about P in the axes of T, both (6,) [m, rad, N, Nm]. Samples that are not
    finite are skipped. ``mean_contact_point`` is (2,), x and y [m], in the axes of T.

    Args:
        min_force: Force along z below which a sample is not used [N], positive and finite.
        period: Control period h [s], positive.
        time_constant: Time τ over which points are averaged [s], finite, at least the period.

    Raises:
        InputError: If an argument is out of range.
    """

    def __init__(self, min_force: float, *, period: float, time_constant: float):
        super().__init__()
        _check_min_force(min_force)
        if not period <= time_constant < np.inf:
            raise InputError(f"a mean of contact points needs a time of at least {period} s, not {time_constant} s")
        self._min_force, self._largest = min_force, time_constant / period
        self._mean, self._count = self.DeclareDiscreteState(2), self.DeclareDiscreteState(1)
        self._pose_port = self.DeclareVectorInputPort("pose", POSE_SIZE)
        self._wrench_port = self.DeclareVectorInputPort("wrench", WRENCH_SIZE)
        sources = [self._pose_port, self._mean, self._count]
        declare.output(
            self,
            "mean_contact_point",
            2,
            lambda context: self._stored(context).relative_to(self._pose_port.Eval(context)),
            sources,
        )
        declare.update(self, period, self._update, declare.reset_to_default(self))

    get_pose_input_port = input_getter("pose", "pose of the tool, (6,)")
    get_wrench_input_port = input_getter("wrench", "wrench about the tool center, (6,) [N, Nm]")
    get_mean_contact_point_output_port = output_getter("mean_contact_point", "mean point of contact, (2,) [m]")

    def _stored(self, context: Context) -> ContactPointMean:
        state = context.get_discrete_state()
        return ContactPointMean(self._min_force, self._largest, state.value(self._mean), state.value(self._count)[0])

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        stored = self._stored(context)
        stored.add(self._pose_port.Eval(context), self._wrench_port.Eval(context))
        discrete_state.set_value(self._mean, stored.mean)
        discrete_state.set_value(self._count, [stored.count])


def _check_min_force(min_force: float) -> None:
    if not 0.0 < min_force < np.inf:
        raise InputError(f"a center of pressure needs a positive, finite minimum force, not {min_force} N")


class ForceMonitor(LeafSystem):
    """Compute the magnitudes of an impedance's force and of the contact force, and detect a saturated wrench.

        impedance_force = ‖f‖,  at rest f = K (x_d − x);   contact_force = ‖f_c‖

    K is the stiffness, x_d the desired and x the measured pose. A bound of the impedance bounds the first of the two.
    At rest both are equal; in an impact the contact force is larger, and depends on the time step of a simulation.

    ``impedance_wrench`` and ``contact_wrench`` are (6,), force [N] first, then torque [Nm]. ``impedance_force`` and
    ``contact_force`` are (1,), the norms of their forces [N]. ``saturation`` (1,) is 1 if any of the six components of
    the impedance wrench is within 0.1 % of its limit, otherwise 0.

    Args:
        limits: Limit of the magnitude of each component of the impedance wrench, (6,) [N, Nm], positive.
    """

    def __init__(self, limits: np.ndarray):
        super().__init__()
        self._saturated = 0.999 * np.asarray(limits)  # magnitudes from which a component counts as saturated
        self._impedance_wrench_port = self.DeclareVectorInputPort("impedance_wrench", 6)
        self._declare_force("impedance_force", self._impedance_wrench_port)
        self._declare_force("contact_force", self.DeclareVectorInputPort("contact_wrench", 6))
        declare.scalar_output(self, "saturation", self._saturation, [self._impedance_wrench_port])

    get_impedance_wrench_input_port = input_getter("impedance_wrench", "wrench that the impedance applies, (6,)")
    get_contact_wrench_input_port = input_getter("contact_wrench", "wrench of the contact on the tool, (6,)")
    get_impedance_force_output_port = output_getter("impedance_force", "norm of the force of the impedance, (1,) [N]")
    get_contact_force_output_port = output_getter("contact_force", "norm of the force of the contact, (1,) [N]")
    get_saturation_output_port = output_getter("saturation", "flag that a component is at its limit, (1,)")

    def _declare_force(self, name: str, wrench: InputPort) -> None:
        declare.scalar_output(self, name, lambda context: norm(wrench.Eval(context)[:3]), [wrench])

    def _saturation(self, context: Context) -> float:
        return float((np.abs(self._impedance_wrench_port.Eval(context)) >= self._saturated).any())


class MeanForce(LeafSystem):
    """Compute the mean force of the last control step from the running sum of the forces of all plant steps.

        force = (force_sum − force_sum at the last control step) / substeps

    A control step consists of many plant steps. The force of the last plant step does not include contacts that ended
    earlier in the control step, and during an impact it depends on the length of the plant step. The mean avoids both.

    ``force_sum`` is (D,), the sum over all plant steps so far [N]. ``force`` is (D,), the mean over the plant steps
    since the last control step [N]. ``magnitude`` is (1,), its norm [N].

    Args:
        size: Number D of force components, at least 1.
        substeps: Number of plant steps per control step, at least 1.
        period: Control period [s], positive.
    """

    def __init__(self, size: int, substeps: int, period: float):
        super().__init__()
        self._scale = 1.0 / substeps
        self._force_sum_port = self.DeclareVectorInputPort("force_sum", size)
        self._last_sum = declare.sample(self, self._force_sum_port, period)
        sources = [self._force_sum_port, self._last_sum]
        declare.output(self, "force", size, self._mean, sources)
        declare.scalar_output(self, "magnitude", lambda context: float(np.linalg.norm(self._mean(context))), sources)

    get_force_sum_input_port = input_getter("force_sum", "sum of the forces of all plant steps so far, (D,) [N]")
    get_force_output_port = output_getter("force", "mean force of the control step, (D,) [N]")
    get_magnitude_output_port = output_getter("magnitude", "norm of the mean force, (1,) [N]")

    def _mean(self, context: Context) -> np.ndarray:
        return (self._force_sum_port.Eval(context) - context.get_discrete_state().value(self._last_sum)) * self._scale


class ContactDetector(LeafSystem):
    """Detect contact between bodies and obstacles at the last plant step and since the start of the episode.

    The contact results are evaluated at every plant step, so collisions that are shorter than a control step are
    detected. All outputs are state without direct feedthrough, delayed by one plant step.

    ``contact_results`` is the plant's output. ``collision`` (1,) is 1 while bodies and obstacles are in contact.
    ``has_collided`` (1,) is 1 from the first contact of the episode on. ``contact_force`` is (1,), the norm of the
    largest contact force between the two sets [N]. Point contact and hydroelastic contact both count.

    Args:
        plant: Finalized plant.
        bodies: Bodies of the plant that must not touch `obstacles`, at least one.
        obstacles: Obstacles, at least one, none in both sets.
        period: Plant step [s], positive.
    """

    def __init__(
        self, plant: MultibodyPlant, bodies: Sequence[RigidBody], obstacles: Sequence[RigidBody], period: float
    ):
        super().__init__()
        check_bodies(plant, "bodies", bodies)
        check_bodies(plant, "obstacles", obstacles)
        body_indices, obstacle_indices = ({int(body.index()) for body in group} for group in (bodies, obstacles))
        self._pairs = {*product(body_indices, obstacle_indices), *product(obstacle_indices, body_indices)}
        self._body_of = {
            geometry: int(body.index())
            for body in (*bodies, *obstacles)
            for geometry in plant.GetCollisionGeometriesForBody(body)
        }
        self._contact_results_port = self.DeclareAbstractInputPort("contact_results", Value(ContactResults()))
        self._collision, self._has_collided, self._contact_force = (self.DeclareDiscreteState(1) for _ in range(3))
        self.DeclareStateOutputPort("collision", self._collision)
        self.DeclareStateOutputPort("has_collided", self._has_collided)
        self.DeclareStateOutputPort("contact_force", self._contact_force)
        declare.update(self, period, self._update, declare.reset_to_default(self))

    get_contact_results_input_port = input_getter("contact_results", "plant's contact results")
    get_collision_output_port = output_getter("collision", "flag of a contact at the last plant step, (1,)")
    get_has_collided_output_port = output_getter("has_collided", "flag of a contact in this episode, (1,)")
    get_contact_force_output_port = output_getter("contact_force", "largest contact force, (1,) [N]")

    def _largest_force(self, context: Context) -> float | None:
        """Return the largest force [N] between the two sets, or None without contact."""
        results: ContactResults = self._contact_results_port.Eval(context)
        largest: float | None = None
        for i in range(results.num_point_pair_contacts()):
            pair = results.point_pair_contact_info(i)
            if (int(pair.bodyA_index()), int(pair.bodyB_index())) in self._pairs:
                f = pair.contact_force()
                largest = max(largest or 0.0, float(f @ f) ** 0.5)
        for i in range(results.num_hydroelastic_contacts()):
            info = results.hydroelastic_contact_info(i)
            surface = info.contact_surface()
            if (self._body_of.get(surface.id_M()), self._body_of.get(surface.id_N())) in self._pairs:
                f = info.F_Ac_W().translational()
                largest = max(largest or 0.0, float(f @ f) ** 0.5)
        return largest

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        force = self._largest_force(context)
        if force is None:
            discrete_state.set_value(self._collision, ZERO)
            discrete_state.set_value(self._contact_force, ZERO)
        else:
            discrete_state.set_value(self._collision, ONE)
            discrete_state.set_value(self._contact_force, [force])
            discrete_state.set_value(self._has_collided, ONE)
