"""Watchdog that checks the status messages of a robot driver."""

from collections.abc import Sequence

import numpy as np
from pydrake.common.value import Value
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem

from guiderail.models.common.errors import InputError
from guiderail.models.control.joint_status import JointStatus, StatusLimits
from guiderail.models.control.state_estimator import Estimate, EstimatorState, StateEstimator
from guiderail.systems.support.declarations import (
    check_period,
    declare_cache,
    declare_plant_context,
    input_getter,
    output_getter,
)
from guiderail.systems.support.drake_multibody import JointDynamics


class StatusWatchdog(LeafSystem):
    """Check each status of a robot, output the last accepted one, and report faults (`StateEstimator`).

    If the clock input is connected, delays of this program are not attributed to the robot, and a delay that is too
    long is reported as a separate fault.

    .. pydrake_system::

        name: StatusWatchdog
        input_ports:
        - status
        - torque
        - clock (optional)
        output_ports:
        - estimated_state
        - velocity
        - external_torque
        - fault
        - age

    ``status`` is abstract: the newest `JointStatus`, or None. ``torque`` is (n,), the torques that are sent after this
    check [Nm]. ``clock`` is (1,), the wall-clock time of this check [s]; if it is not connected, checks are one period
    apart. ``estimated_state`` is (2n,), positions and velocities [rad, rad/s], and ``external_torque`` is (n,) [Nm];
    both are taken from the last accepted status, and zero before the first. ``velocity`` is (n,), the velocity for
    damping [rad/s]: estimated from several sources, predicted while no status is accepted, and zero where it is
    unknown. ``fault`` is (1,), a code of `Fault`. ``age`` is (1,), the age of the last accepted status relative to the
    earliest arrival [s].

    Args:
        plant: Model of the arm and its payload alone, finalized; its inertia is used.
        limits: Plausibility limits of a status.
        torque_tolerance: Largest error of each joint's torque (n,) [Nm], positive.
        period: Period of the check, and of the status messages [s], positive.

    Raises:
        InputError: If an argument is out of range.
    """

    def __init__(
        self, plant: MultibodyPlant, limits: StatusLimits, torque_tolerance: Sequence[float], *, period: float
    ):
        super().__init__()
        check_period(period)
        self._estimator = StateEstimator(limits, torque_tolerance, period=period)
        self._plant, self._dynamics, self._num_joints = plant, JointDynamics(plant), plant.num_positions()
        n = self._num_joints
        if len(limits.velocity) != n:
            raise InputError(f"an arm of {n} joints needs as many velocity limits, not {len(limits.velocity)}")
        self._status_port = self.DeclareAbstractInputPort("status", Value[object]())
        self._torque_port = self.DeclareVectorInputPort("torque", n)
        self._clock_port = self.DeclareVectorInputPort("clock", 1)
        self._state = self.DeclareDiscreteState(EstimatorState.initial(n).vector())
        self._last_clock = self.DeclareDiscreteState([np.nan])  # value of the clock input at the last check
        state = {self.discrete_state_ticket(self._state)}
        self._plant_context = declare_plant_context(self, plant, self._set_plant_state, prerequisites_of_calc=state)
        self._estimate = declare_cache(
            self,
            "estimate",
            self._evaluate,
            prerequisites_of_calc=state
            | {self._status_port.ticket(), self._clock_port.ticket(), self.discrete_state_ticket(self._last_clock)},
        )
        estimate = {self._estimate.ticket()}
        self._estimated_state_port = self.DeclareVectorOutputPort(
            "estimated_state", 2 * n, self._calc_estimated_state, prerequisites_of_calc=estimate
        )
        self._velocity_port = self.DeclareVectorOutputPort(
            "velocity", n, self._calc_velocity, prerequisites_of_calc=estimate
        )
        self._external_torque_port = self.DeclareVectorOutputPort(
            "external_torque", n, self._calc_external_torque, prerequisites_of_calc=estimate
        )
        self._fault_port = self.DeclareVectorOutputPort("fault", 1, self._calc_fault, prerequisites_of_calc=estimate)
        self._age_port = self.DeclareVectorOutputPort("age", 1, self._calc_age, prerequisites_of_calc=estimate)
        self.DeclareInitializationDiscreteUpdateEvent(self._reset)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)

    get_status_input_port = input_getter("status", "newest `JointStatus`; any other object counts as none")
    get_torque_input_port = input_getter("torque", "torques that are sent after this check, (n,) [Nm]")
    get_clock_input_port = input_getter("clock", "wall-clock time, (1,) [s]; optional")
    get_estimated_state_output_port = output_getter("estimated_state", "accepted joint state, (2n,) [rad, rad/s]")
    get_velocity_output_port = output_getter("velocity", "velocity for damping, (n,) [rad/s]")
    get_external_torque_output_port = output_getter("external_torque", "accepted external torques, (n,) [Nm]")
    get_fault_output_port = output_getter("fault", "present or recent fault, (1,), a code of `Fault`")
    get_age_output_port = output_getter("age", "age of the accepted status, (1,) [s]")

    def _state_of(self, context: Context) -> EstimatorState:
        return EstimatorState.from_vector(context.get_discrete_state(self._state).value(), self._num_joints)

    def _set_plant_state(self, context: Context, plant_context: Context) -> None:
        state = self._state_of(context)
        self._plant.SetPositions(plant_context, state.accepted_values[: self._num_joints])
        self._plant.SetVelocities(plant_context, state.velocity)

    def _clock(self, context: Context) -> float:
        return float(self._clock_port.Eval(context)[0]) if self._clock_port.HasValue(context) else np.nan

    def _evaluate(self, context: Context) -> Estimate:
        value, state, clock = self._status_port.Eval(context), self._state_of(context), self._clock(context)
        # An unchanged clock input belongs to the previous check.
        is_new_clock = np.isfinite(clock) and clock not in context.get_discrete_state(self._last_clock).value()
        now = clock if is_new_clock else state.check_time
        status = value if isinstance(value, JointStatus) else None
        M, drag = self._dynamics.evaluate(self._plant_context.Eval(context))
        return self._estimator.evaluate(state, status, now, M, drag)

    def _reset(self, context: Context, discrete_state: DiscreteValues) -> None:
        discrete_state.set_value(self._state, EstimatorState.initial(self._num_joints).vector())
        discrete_state.set_value(self._last_clock, [np.nan])

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        state = self._estimator.advance(self._estimate.Eval(context), self._torque_port.Eval(context))
        discrete_state.set_value(self._state, state.vector())
        discrete_state.set_value(self._last_clock, [self._clock(context)])

    def _calc_estimated_state(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._estimate.Eval(context).state.accepted_values[: 2 * self._num_joints])

    def _calc_velocity(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._estimate.Eval(context).state.velocity)

    def _calc_external_torque(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._estimate.Eval(context).state.accepted_values[2 * self._num_joints :])

    def _calc_fault(self, context: Context, output: BasicVector) -> None:
        output.SetAtIndex(0, float(self._estimate.Eval(context).fault))

    def _calc_age(self, context: Context, output: BasicVector) -> None:
        output.SetAtIndex(0, self._estimate.Eval(context).age)
