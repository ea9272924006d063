"""Bounds of an impedance's wrench: limits that change with a template, a reference governor, and an energy tank.

`diagrams/stations/impedance_control.py` adds all three. packages/cpp has the first two in C++ (`force.hpp`), and its
tests compare them.
"""

from contextlib import suppress
from typing import NamedTuple

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from guiderail.models.common.arrays import as_number, as_numbers, is_finite
from guiderail.models.common.errors import InputError
from guiderail.models.common.transforms import POSE_SIZE, pose_difference
from guiderail.models.control.wrench import (
    MAX_WRENCH_SIZE,
    POSE_ORDER,
    MovingInertia,
    WrenchBound,
    admissible_change,
    approach_bound,
    check_spring_damper,
    governed_error,
    spring_energy,
)
from guiderail.systems.support import declarations as declare
from guiderail.systems.support.declarations import ReadFlag, check_period, input_getter, output_getter
from guiderail.systems.support.last_valid import LastValidBound


class PhaseWrenchLimit(LeafSystem):
    """Output the wrench limit of a template's current state, with a bounded rate of change after a transition.

        b_k = b_{k-1} + s (B_q - b_{k-1}),  with the largest s <= 1 such that |b_k - b_{k-1}| <= r h

    B_q is the element-wise minimum of the bound of the robot and the limit of state q, r the largest rate and h the
    period. The rate of decreases is bounded as well, because the force would jump after a sudden decrease of the limit.
    An episode begins with the limit of its first state. While a number of the limit is NaN or negative, that of b is
    constant, or 0 before the first valid number.

    All ports are (8,), the limits of [fx fy fz tx ty tz], of the norm of the force and of the norm of the torque
    [N, Nm]. ``state_max_wrench`` is the limit of the state, the output ``max_wrench`` of an `SctStateMachine`.
    ``max_wrench`` is the limit of the task, whose changes apply at once. The output is the element-wise minimum of b
    and ``max_wrench``.

    Args:
        bound: Bound of the robot (8,) [N, Nm], finite and not negative, which applies in states without limits.
        max_rate: Largest rates of change (8,) [N/s, Nm/s], positive, finite.
        period: Sampling period [s], positive.

    Raises:
        InputError: If an argument is out of range. Two periods after the initialization, if nothing has read
            ``phase_max_wrench``.
    """

    def __init__(self, bound: np.ndarray, max_rate: np.ndarray, *, period: float):
        super().__init__()
        self._max_bound, rate = as_numbers(bound, "bound"), as_numbers(max_rate, "max_rate")
        is_allowed = (self._max_bound >= 0.0) & (rate > 0.0) & np.isfinite(self._max_bound) & np.isfinite(rate)
        if is_allowed.shape != (MAX_WRENCH_SIZE,) or not is_allowed.all():
            raise InputError(f"wrench limits need eight finite bounds and rates, not {bound} and {max_rate}")
        self._max_change = rate * period
        self._limit_port = self.DeclareVectorInputPort("state_max_wrench", MAX_WRENCH_SIZE)
        self._max_wrench_port = self.DeclareVectorInputPort("max_wrench", MAX_WRENCH_SIZE)
        # NaN until the first update: the source of the limit is initialized at the same instant as this system.
        self._bound = self.DeclareDiscreteState(np.full(MAX_WRENCH_SIZE, np.nan))
        self._read = ReadFlag(self)
        sources = [self._limit_port, self._max_wrench_port, self._bound]
        declare.output(self, "phase_max_wrench", MAX_WRENCH_SIZE, self._phase_max_wrench, sources)
        declare.update(self, period, self._update, self._reset)

    get_state_max_wrench_input_port = input_getter("state_max_wrench", "limit of the template's state, (8,)")
    get_max_wrench_input_port = input_getter("max_wrench", "wrench limit of the task, (8,); optional")
    get_phase_max_wrench_output_port = output_getter("phase_max_wrench", "limit in the present state, (8,)")

    def _limit(self, context: Context) -> np.ndarray:
        """Return the limit B_q at the port, (8,)."""
        limit = self._limit_port.Eval(context)
        if not (is_valid := limit >= 0.0).all():  # False for NaN
            last = context.get_discrete_state().value(self._bound)
            limit = np.where(is_valid, limit, np.where(np.isnan(last), 0.0, last))
        return np.minimum(self._max_bound, limit)

    def _present(self, context: Context) -> np.ndarray:
        bound = context.get_discrete_state().value(self._bound)
        return self._limit(context) if np.isnan(bound).any() else bound

    def _phase_max_wrench(self, context: Context) -> np.ndarray:
        bound = self._present(context)
        if self._max_wrench_port.HasValue(context):
            bound = np.minimum(bound, self._max_wrench_port.Eval(context))
        return self._read.marked(context, bound)

    def _reset(self, context: Context, discrete_state: DiscreteValues) -> None:
        # A state machine requires that its limit is read, which systems after this one may do only later. All systems
        # initialize at once, and the source of the limit may have no start yet.
        with suppress(InputError):
            self._limit_port.Eval(context)
        discrete_state.set_value(self._bound, np.full(MAX_WRENCH_SIZE, np.nan))

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        is_first = np.isnan(context.get_discrete_state().value(self._bound)).any()
        if not is_first and not self._read.is_set(context):
            raise InputError(
                f"no controller follows the limit of '{self.get_name()}': connect its output phase_max_wrench to the "
                "controller's input max_wrench"
            )
        bound = approach_bound(self._present(context), self._limit(context), self._max_change)
        discrete_state.set_value(self._bound, bound)


class ReferenceGovernor(LeafSystem):
    """Move a desired pose towards the measured pose, so that the force of a spring and damper stays inside a bound.

        x_r = x + e_r,  K e_r inside the bound reduced by (K h + D) |v|

    x_r is the output, x and v are the measured pose and velocity, K and D the stiffness and damping of the six
    coordinates, and h is the time step. The spring accelerates the mass m so that each contact has at most the speed
    F / (2 √(k m)), with the force bound F and the contact stiffness k (see `slow_down`). If no limit is active, the
    desired pose is output unchanged up to rounding.

    ``desired_pose`` and ``reference_pose`` are (6,), [x y z Rz Ry Rx] in meters and radians. ``state`` is (12,), the
    measured pose and its velocity [m/s, rad/s]. ``max_wrench`` is (8,), the limits of [fx fy fz tx ty tz], of the norm
    of the force and of the norm of the torque [N, Nm]; it can lower the bound but not raise it. NaN and negative
    numbers count as 0: the spring then exerts no force, and only the damper of the plant acts.

    Args:
        stiffness: Stiffness (6,) of each coordinate of the pose [N/m, Nm/rad], positive.
        damping: Damping (6,) of each coordinate [N s/m, Nm s/rad], not negative.
        inertia: Moving mass, and its smallest moment of inertia about the tool center.
        step: Time step of the plant [s], positive.
        bound: Bound of the wrench.

    Raises:
        InputError: If an argument is out of range.
    """

    def __init__(
        self, stiffness: np.ndarray, damping: np.ndarray, inertia: MovingInertia, step: float, bound: WrenchBound
    ):
        super().__init__()
        check_period(step)
        self._stiffness, self._damping = check_spring_damper(stiffness, damping, "a reference governor")
        if not all(0.0 < as_number(value, "inertia") < np.inf for value in inertia):
            raise InputError(f"the moving mass and moment of inertia must be positive and finite, not {tuple(inertia)}")
        self._inertia, self._step, self._bound = inertia, step, bound
        self._desired_pose_port = self.DeclareVectorInputPort("desired_pose", POSE_SIZE)
        self._state_port = self.DeclareVectorInputPort("state", 2 * POSE_SIZE)
        self._max_wrench_port = self.DeclareVectorInputPort("max_wrench", MAX_WRENCH_SIZE)
        sources = [self._desired_pose_port, self._state_port, self._max_wrench_port]
        declare.output(self, "reference_pose", POSE_SIZE, self._reference_pose, sources)

    get_desired_pose_input_port = input_getter("desired_pose", "desired pose, (6,)")
    get_state_input_port = input_getter("state", "measured pose and its velocity, (12,)")
    get_max_wrench_input_port = input_getter("max_wrench", "limits per axis and of the norms, (8,) [N, Nm]; optional")
    get_reference_pose_output_port = output_getter("reference_pose", "reference of the spring, (6,)")

    def _reference_pose(self, context: Context) -> np.ndarray:
        state, bound = self._state_port.Eval(context), self._bound
        if self._max_wrench_port.HasValue(context):
            bound = bound.lowered_to(self._max_wrench_port.Eval(context))
        pose, velocity = state[:POSE_SIZE], state[POSE_SIZE:]
        error = governed_error(
            self._stiffness,
            self._damping,
            self._desired_pose_port.Eval(context) - pose,
            velocity,
            self._inertia,
            self._step,
            bound.in_pose_order,
        )
        return pose + error


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
