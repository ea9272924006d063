"""Energy tank that makes an impedance passive while its reference and its wrench bound change."""

from typing import NamedTuple

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from guiderail.models.common.arrays import as_number, is_finite
from guiderail.models.common.errors import InputError
from guiderail.models.common.transforms import POSE_SIZE, pose_difference
from guiderail.models.control.wrench import (
    MAX_WRENCH_SIZE,
    POSE_ORDER,
    WrenchBound,
    admissible_change,
    check_spring_damper,
    spring_energy,
)
from guiderail.systems.support import declarations as declare
from guiderail.systems.support.declarations import input_getter, output_getter
from guiderail.systems.support.last_valid_bound import LastValidBound


class _Admitted(NamedTuple):
    """Admitted reference (6,), limits (6,) in the order of pose coordinates, and energy of the tank [J]."""

    reference: np.ndarray
    limits: np.ndarray
    energy: float


class EnergyTank(LeafSystem):
    """Limit changes of a reference and a wrench bound, so that they use at most the energy in the tank.

        T' = T + Σ D Δx² / h − (U(x_r', F') − U(x_r, F)) ≥ 0

    T is the energy in the tank, and U the energy of the clipped spring at the measured pose x. A prime marks the values
    after a change. The energy that a change of the reference x_r or of the limits F adds to the spring is taken from
    the tank. The energy that the damper dissipates, at least Σ D Δx² / h for a displacement Δx in a period h, refills
    the tank up to its capacity. If the energy in the tank does not suffice, only a share of the change is applied. A
    decrease of a limit applies at once. Only work of the environment therefore increases the total energy of spring,
    tank and motion, and the environment cannot extract more than the initial energy (Ferraguti, Secchi, Fantuzzi 2013).

    ``desired_pose``, ``pose`` (measured) and ``reference_pose`` are (6,), [x y z Rz Ry Rx] in meters and radians. A
    desired pose that is not finite is output unchanged and uses no energy. While the measured pose is not finite, the
    reference and the energy are constant and no limit increases. ``max_wrench`` and ``admitted_wrench`` are (8,),
    limits of [fx fy fz tx ty tz], of the norm of the force and of the norm of the torque [N, Nm]. While a number of
    ``max_wrench`` is NaN or negative, its last valid value applies (`LastValidBound`). ``energy`` is (1,), the energy
    in the tank [J].

    Args:
        stiffness: Stiffness (6,) of each coordinate of the pose [N/m, Nm/rad], positive.
        damping: Smallest damping (6,) of each coordinate [N s/m, Nm s/rad], not negative.
        bound: Bound of the wrench, with finite limits per axis.
        capacity: Initial and largest energy [J], positive, finite.
        period: Sampling period [s], positive.

    Raises:
        InputError: If an argument is out of range.
    """

    def __init__(
        self, stiffness: np.ndarray, damping: np.ndarray, bound: WrenchBound, *, capacity: float, period: float
    ):
        super().__init__()
        self._stiffness, self._damping = check_spring_damper(stiffness, damping, "an energy tank")
        if not 0.0 < as_number(capacity, "capacity") < np.inf:
            raise InputError(f"an energy tank's capacity must be positive and finite, not {capacity} J")
        if not is_finite(bound.axes):
            raise InputError(f"an energy tank needs finite limits of the wrench per axis, not {bound.axes}")
        self._capacity, self._period = capacity, period
        self._desired_pose_port = self.DeclareVectorInputPort("desired_pose", POSE_SIZE)
        self._pose_port = self.DeclareVectorInputPort("pose", POSE_SIZE)
        self._max_wrench_port = self.DeclareVectorInputPort("max_wrench", MAX_WRENCH_SIZE)
        self._last_reference = self.DeclareDiscreteState(POSE_SIZE)
        self._last_limits = self.DeclareDiscreteState(POSE_SIZE)
        self._last_pose = self.DeclareDiscreteState(POSE_SIZE)
        self._content = self.DeclareDiscreteState([capacity])
        self._requested_bound = LastValidBound(self, bound, self._max_wrench_port, period=period)
        inputs = (self._desired_pose_port, self._pose_port, *self._requested_bound.sources)
        states = (self._last_reference, self._last_limits, self._last_pose, self._content)
        self._admitted = declare.cache_entry(self, "admitted", self._calc_admitted, [*inputs, *states])
        declare.output(self, "reference_pose", POSE_SIZE, self._reference_pose, [self._admitted])
        declare.output(self, "admitted_wrench", MAX_WRENCH_SIZE, self._admitted_wrench, [self._admitted])
        self.DeclareStateOutputPort("energy", self._content)
        declare.update(self, period, self._update, self._reset)

    get_desired_pose_input_port = input_getter("desired_pose", "desired pose, (6,)")
    get_pose_input_port = input_getter("pose", "measured pose, (6,)")
    get_max_wrench_input_port = input_getter("max_wrench", "limits per axis and of the norms, (8,) [N, Nm]; optional")
    get_reference_pose_output_port = output_getter("reference_pose", "reference that the tank admits, (6,)")
    get_admitted_wrench_output_port = output_getter("admitted_wrench", "bound that the tank admits, (8,)")
    get_energy_output_port = output_getter("energy", "energy in the tank, (1,) [J]")

    def refill(self, context: Context) -> None:
        """Fill the tank to its capacity, for a new motion; `context` is the context of this system."""
        context.get_mutable_discrete_state().set_value(self._content, [self._capacity])

    def _calc_admitted(self, context: Context, value: AbstractValue) -> None:
        pose, desired = self._pose_port.Eval(context), self._desired_pose_port.Eval(context)
        states = context.get_discrete_state()
        reference, last_limits = states.value(self._last_reference), states.value(self._last_limits)
        last_pose, content = states.value(self._last_pose), states.value(self._content).item()
        if not is_finite(desired):
            desired = reference
        requested = self._requested_bound.eval(context).in_pose_order.axes
        limits, K = np.minimum(last_limits, requested), self._stiffness
        if not is_finite(pose):  # NaN would fill the tank and remain in its state
            value.set_value(_Admitted(reference, limits, content))
            return
        if not is_finite(reference):  # the pose was not finite at initialization: the reference starts here
            reference = pose
        displacement = pose_difference(pose, last_pose) if is_finite(last_pose) else np.zeros(POSE_SIZE)
        dissipated = float(self._damping.dot(displacement * displacement)) / self._period
        error, desired_error = pose_difference(reference, pose), pose_difference(desired, pose)
        # Energy of tank and spring together.
        energy = min(self._capacity, content + dissipated) + spring_energy(K, last_limits, error)
        share, stored = admissible_change(K, (limits, requested), (error, desired_error), energy)
        if share == 1.0:
            next_reference, admitted = desired, requested
        else:
            next_reference = pose + error + share * (desired_error - error)
            admitted = limits + share * (requested - limits)
        value.set_value(_Admitted(next_reference, admitted, min(self._capacity, max(energy - stored, 0.0))))

    def _reference_pose(self, context: Context) -> np.ndarray:
        desired = self._desired_pose_port.Eval(context)
        return self._admitted.Eval(context).reference if is_finite(desired) else desired

    def _admitted_wrench(self, context: Context) -> list[float]:
        bound, limits = self._requested_bound.eval(context), self._admitted.Eval(context).limits.tolist()
        return [*(limits[i] for i in POSE_ORDER), bound.force, bound.torque]

    def _reset(self, context: Context, discrete_state: DiscreteValues) -> None:
        pose = self._pose_port.Eval(context)
        discrete_state.set_value(self._last_reference, pose)
        discrete_state.set_value(self._last_limits, self._requested_bound.eval(context).in_pose_order.axes)
        discrete_state.set_value(self._last_pose, pose)
        discrete_state.set_value(self._content, [self._capacity])

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        admitted = self._admitted.Eval(context)
        discrete_state.set_value(self._last_reference, admitted.reference)
        discrete_state.set_value(self._last_limits, admitted.limits)
        discrete_state.set_value(self._last_pose, self._pose_port.Eval(context))
        discrete_state.set_value(self._content, [admitted.energy])
