"""Watchdog that checks the status messages of a robot driver."""

from collections.abc import Sequence

import numpy as np
from pydrake.common.value import Value
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from guiderail.models.common.errors import InputError
from guiderail.systems.support import declarations as declare
from guiderail.systems.support.declarations import input_getter, output_getter
from guiderail_hardware.models.joint_dynamics import JointDynamics
from guiderail_hardware.models.joint_status import JointStatus, StatusLimits
from guiderail_hardware.models.state_estimator import Estimate, EstimatorState, StateEstimator


class StatusWatchdog(LeafSystem):
    """Check each status message of a robot, output the last accepted status, and report faults (`StateEstimator`).

    If the clock input is connected, delays of this program are not attributed to the robot, and a delay that is too
    long is reported as a separate fault. An initialization does not reset the state, because an arm in motion could not
    be damped without the estimated velocity.

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
        - reported_speed

    ``status`` is abstract: the newest `JointStatus`, or None. ``torque`` is (n,), the torques that are sent after this
    check [Nm]. ``clock`` is (1,), the wall-clock time of this check [s]; if it is not connected, checks are one period
    apart. ``estimated_state`` is (2n,), positions and velocities [rad, rad/s], and ``external_torque`` is (n,) [Nm].
    Both are values of the last accepted status, and zero before the first; velocities are limited as described in
    `StateEstimator`. ``velocity`` is (n,), the velocity for damping [rad/s]: estimated from several sources, predicted
    while no status is accepted, and zero where it is unknown. ``fault`` is (1,), a code of `Fault`. ``age`` is (1,),
    the age of the last accepted status relative to the earliest arrival [s]; infinite before the first.
    ``reported_speed`` is (1,), the largest joint speed of the last readable status [rad/s]; NaN without a recent one.

    Args:
        plant: Finalized model of only the arm and its payload; provides the inertia.
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
        self._estimator = StateEstimator(limits, torque_tolerance, period=period)
        self._dynamics, self._num_joints = JointDynamics(plant), plant.num_positions()
        n = self._num_joints
        if len(limits.velocity) != n:
            raise InputError(f"an arm of {n} joints needs as many velocity limits, not {len(limits.velocity)}")
        self._status_port = self.DeclareAbstractInputPort("status", Value[object]())
        self._torque_port = self.DeclareVectorInputPort("torque", n)
        self._clock_port = self.DeclareVectorInputPort("clock", 1)
        self._state = self.DeclareDiscreteState(EstimatorState.initial(n).vector())
        self._last_clock = self.DeclareDiscreteState([np.nan])  # value of the clock input at the last check
        self._plant_context = declare.plant_context(self, plant, self._joint_state, [self._state])
        sources = [self._state, self._status_port, self._clock_port, self._last_clock]
        self._estimate = declare.cache(self, "estimate", self._evaluate, sources)
        declare.part_output(
            self, "estimated_state", self._estimate, lambda estimate: estimate.state.accepted_values[: 2 * n], 2 * n
        )
        declare.part_output(self, "velocity", self._estimate, lambda estimate: estimate.state.velocity, n)
        declare.part_output(
            self, "external_torque", self._estimate, lambda estimate: estimate.state.accepted_values[2 * n :], n
        )
        declare.part_output(self, "fault", self._estimate, lambda estimate: float(estimate.fault))
        declare.part_output(self, "age", self._estimate, lambda estimate: estimate.age)
        declare.part_output(
            self, "reported_speed", self._estimate, lambda estimate: estimate.state.reported_speed(period)
        )
        declare.update(self, period, self._update)

    get_status_input_port = input_getter("status", "newest `JointStatus`; any other object counts as none")
    get_torque_input_port = input_getter("torque", "torques that are sent after this check, (n,) [Nm]")
    get_clock_input_port = input_getter("clock", "wall-clock time, (1,) [s]; optional")
    get_estimated_state_output_port = output_getter("estimated_state", "accepted joint state, (2n,) [rad, rad/s]")
    get_velocity_output_port = output_getter("velocity", "velocity for damping, (n,) [rad/s]")
    get_external_torque_output_port = output_getter("external_torque", "accepted external torques, (n,) [Nm]")
    get_fault_output_port = output_getter("fault", "present or recent fault, (1,), a code of `Fault`")
    get_age_output_port = output_getter("age", "age of the accepted status, (1,) [s]")
    get_reported_speed_output_port = output_getter("reported_speed", "largest reported joint speed, (1,) [rad/s]")

    def forget_torque(self, context: Context) -> None:
        """Treat the torques since the last check as unknown, because a command was not sent.

        `context` is this system's.
        """
        context.SetDiscreteState(self._state, self._estimator.forget_torque(self._state_of(context)).vector())

    def _state_of(self, context: Context) -> EstimatorState:
        return EstimatorState.from_vector(context.get_discrete_state().value(self._state), self._num_joints)

    def _joint_state(self, context: Context) -> np.ndarray:
        state = self._state_of(context)
        return np.concatenate([state.accepted_values[: self._num_joints], state.velocity])

    def _clock(self, context: Context) -> float:
        return float(self._clock_port.Eval(context)[0]) if self._clock_port.HasValue(context) else np.nan

    def _evaluate(self, context: Context) -> Estimate:
        value, state, clock = self._status_port.Eval(context), self._state_of(context), self._clock(context)
        # If the clock input has not changed, its value belongs to the previous check.
        is_new_clock = np.isfinite(clock) and clock != context.get_discrete_state().value(self._last_clock).item()
        now = clock if is_new_clock else state.check_time
        status = value if isinstance(value, JointStatus) else None
        M, drag = self._dynamics.evaluate(self._plant_context.Eval(context))
        return self._estimator.evaluate(state, status, now, M, drag)

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        state = self._estimator.advance(self._estimate.Eval(context), self._torque_port.Eval(context))
        discrete_state.set_value(self._state, state.vector())
        discrete_state.set_value(self._last_clock, [self._clock(context)])
