"""Watchdog that checks the status messages of a robot driver."""

from dataclasses import dataclass

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem

from guiderail.models.control.joint_status import Fault, JointStatus, LastStatus, StatusLimits, check_status
from guiderail.systems.support.declarations import check_period, declare_cache, input_getter, output_getter

# Indices into the state, all times in s: local time of the next check, last value of the clock input; time stamp, clock
# offset and local time of the last readable status; the last fault and its local time; the local time of the last
# doubtful fault (NaN if none); time stamp and clock offset of the accepted status.
(
    _CHECK_TIME,
    _CLOCK_INPUT,
    _STATUS_TIME,
    _OFFSET,
    _RECEIPT_TIME,
    _FAULT,
    _FAULT_TIME,
    _DOUBT_TIME,
    _ACCEPTED_TIME,
    _ACCEPTED_OFFSET,
) = range(10)
INITIAL_STATE = (0.0, np.nan, np.nan, 0.0, 0.0, float(Fault.NO_STATUS), 0.0, np.nan, np.nan, 0.0)
ACCEPTABLE_FAULTS = (Fault.NONE, Fault.DEADLINE_MISSED)  # the status itself is valid
# After these faults a status is accepted only if it agrees with the accepted one. After the first three the clocks are
# synchronized again, so the true age of a status is unknown; damping by an old velocity, or by the inertia of another
# posture, would drive the arm.
RECOVERABLE_FAULTS = (Fault.STALE, Fault.OUT_OF_ORDER, Fault.FUTURE, Fault.POSITION_JUMP)
FRESH_FRACTION = 0.5  # fraction of the maximum age up to which damping by a velocity does not oscillate
# Fraction by which the clock offset follows a status that arrives earlier than expected. With 1, a single stray message
# would make all others late.
EARLY_FRACTION = 0.2


@dataclass(frozen=True)
class _Evaluation:
    """Result of checking the newest status.

    Attributes:
        fault: Fault of the status, or `Fault.NONE`.
        is_new: True if the status was not evaluated before.
        is_accepted: True if the status is new and becomes the accepted one.
        accepted: Values of the accepted status, (3n,).
        age: Age of the accepted status [s].
        offset: Clock offset with which the status was checked [s].
    """

    fault: Fault
    is_new: bool
    is_accepted: bool
    accepted: np.ndarray
    age: float
    offset: float


class StatusWatchdog(LeafSystem):
    """Check each status of a robot, output the last accepted one, and report faults.

    `check_status` determines the fault. A fault is reported until all statuses have been valid for the settling time,
    so that the first status after a start or a restart of the driver is not acted upon. The clocks are synchronized
    with the first status. Afterwards the offset follows early statuses quickly and late ones slowly; after a fault or a
    timeout the clocks are synchronized again, and the next status is compared with the one that raised the fault if its
    values were finite. If the clock input is connected, delays of this program are not attributed to the robot, and a
    delay that is too long is a fault of its own. After a timeout or a jump of clock or position, a status within the
    settling time is accepted only if it agrees with clock and positions before the fault: a single stray message cannot
    invalidate the estimate.

    .. pydrake_system::

        name: StatusWatchdog
        input_ports:
        - status
        - clock (optional)
        output_ports:
        - estimated_state
        - external_torque
        - fault
        - age
        - is_new

    ``status`` is abstract: the newest `JointStatus`, or None. ``clock`` is (1,), the wall-clock time of this check [s];
    if it is not connected, checks are one period apart. ``estimated_state`` is (2n,), positions and velocities
    [rad, rad/s], and ``external_torque`` is (n,) [Nm]; both are those of the last accepted status and zero before it.
    ``fault`` is (1,), a code of `Fault`. ``age`` is (1,), the age of the last accepted status relative to the earliest
    arrival [s]. ``is_new`` (1,) is 1 at the check at which a status is accepted.

    Args:
        limits: Plausibility limits of a status.
        period: Period of the check, and of the status messages [s], positive.

    Raises:
        InputError: If an argument is out of range.
    """

    def __init__(self, limits: StatusLimits, *, period: float):
        super().__init__()
        check_period(period)
        self._limits, self._period = limits, period
        self._num_joints = num_joints = len(limits.velocity)
        self._status_port = self.DeclareAbstractInputPort("status", Value[object]())
        self._clock_port = self.DeclareVectorInputPort("clock", 1)
        self._state = self.DeclareDiscreteState(INITIAL_STATE)
        self._last_values = self.DeclareDiscreteState(3 * num_joints)  # of the last readable status, valid or not
        self._accepted = self.DeclareDiscreteState(3 * num_joints)
        tickets = {
            self._status_port.ticket(),
            self._clock_port.ticket(),
            self.discrete_state_ticket(self._state),
            self.discrete_state_ticket(self._last_values),
            self.discrete_state_ticket(self._accepted),
        }
        self._evaluation = declare_cache(self, "evaluation", self._evaluate, prerequisites_of_calc=tickets)
        evaluation = {self._evaluation.ticket()}
        self._estimated_state_port = self.DeclareVectorOutputPort(
            "estimated_state", 2 * num_joints, self._calc_estimated_state, prerequisites_of_calc=evaluation
        )
        self._external_torque_port = self.DeclareVectorOutputPort(
            "external_torque", num_joints, self._calc_external_torque, prerequisites_of_calc=evaluation
        )
        self._fault_port = self.DeclareVectorOutputPort(
            "fault", 1, self._calc_fault, prerequisites_of_calc=evaluation | tickets
        )
        self._age_port = self.DeclareVectorOutputPort("age", 1, self._calc_age, prerequisites_of_calc=evaluation)
        self._is_new_port = self.DeclareVectorOutputPort(
            "is_new", 1, self._calc_is_new, prerequisites_of_calc=evaluation
        )
        self.DeclareInitializationDiscreteUpdateEvent(self._reset)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)

    get_status_input_port = input_getter("status", "newest `JointStatus`; any other object counts as none")
    get_clock_input_port = input_getter("clock", "wall-clock time, (1,) [s]; optional")
    get_estimated_state_output_port = output_getter("estimated_state", "accepted joint state, (2n,) [rad, rad/s]")
    get_external_torque_output_port = output_getter("external_torque", "accepted external torques, (n,) [Nm]")
    get_fault_output_port = output_getter("fault", "present or recent fault, (1,), a code of `Fault`")
    get_age_output_port = output_getter("age", "age of the accepted status, (1,) [s]")
    get_is_new_output_port = output_getter("is_new", "flag that a status is accepted at this check, (1,)")

    def _state_of(self, context: Context) -> np.ndarray:
        return context.get_discrete_state(self._state).value()

    def _now(self, context: Context) -> float:
        state = self._state_of(context)
        if self._clock_port.HasValue(context):
            clock = float(self._clock_port.Eval(context)[0])
            # An unchanged clock input belongs to the previous check.
            if clock != state[_CLOCK_INPUT]:
                return clock
        return float(state[_CHECK_TIME])

    def _evaluate(self, context: Context) -> _Evaluation:
        value = self._status_port.Eval(context)
        status = value if isinstance(value, JointStatus) else None
        state, last_values = self._state_of(context), context.get_discrete_state(self._last_values).value()
        last = LastStatus(float(state[_STATUS_TIME]), float(state[_OFFSET]), last_values)
        accepted = context.get_discrete_state(self._accepted).value().copy()
        now, is_trusted = self._now(context), not np.isfinite(state[_DOUBT_TIME])
        last_accepted = LastStatus(float(state[_ACCEPTED_TIME]), float(state[_ACCEPTED_OFFSET]), accepted)
        if status is not None and not is_trusted and self._agrees(status, last_accepted, now):
            last, is_trusted = last_accepted, True
        fault = check_status(status, last, now, self._limits)
        if not fault and now - state[_CHECK_TIME] > self._limits.max_check_interval:
            fault = Fault.DEADLINE_MISSED
        accepted_at = state[_ACCEPTED_TIME] + state[_ACCEPTED_OFFSET]
        age = max(now - accepted_at, 0.0) if np.isfinite(accepted_at) else now
        if status is None or fault in (Fault.MALFORMED, Fault.WRONG_SIZE, Fault.NOT_FINITE):
            return _Evaluation(fault, False, False, accepted, age, last.offset)
        values = status.values()
        is_reordered = status.time <= last.time and not fault
        is_new = not is_reordered and (status.time != last.time or not np.array_equal(values, last.values))
        is_accepted = is_new and fault in ACCEPTABLE_FAULTS and is_trusted
        if is_accepted:
            accepted = values
            age = max(now - (status.time + last.offset), 0.0) if np.isfinite(last.time) else 0.0
        return _Evaluation(fault, is_new, is_accepted, accepted, age, last.offset)

    def _agrees(self, status: JointStatus, accepted: LastStatus, now: float) -> bool:
        """Return True if a status is valid and fresh relative to the accepted one."""
        max_age = FRESH_FRACTION * self._limits.max_age
        is_fresh = status.time > accepted.time and now - (status.time + accepted.offset) <= max_age
        return is_fresh and check_status(status, accepted, now, self._limits) == Fault.NONE

    def _reset(self, context: Context, discrete_state: DiscreteValues) -> None:
        discrete_state.set_value(self._state, INITIAL_STATE)
        for group in (self._last_values, self._accepted):
            discrete_state.set_value(group, np.zeros(3 * self._num_joints))

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        evaluation, state = self._evaluation.Eval(context), self._state_of(context).copy()
        now = self._now(context)
        if evaluation.is_new:
            status: JointStatus = self._status_port.Eval(context)
            offset = self._next_offset(now - status.time, evaluation, state, now)
            state[_STATUS_TIME], state[_OFFSET], state[_RECEIPT_TIME] = status.time, offset, now
            discrete_state.set_value(self._last_values, status.values())
            if evaluation.is_accepted:
                state[_ACCEPTED_TIME], state[_ACCEPTED_OFFSET] = status.time, offset
                discrete_state.set_value(self._accepted, evaluation.accepted)
        # Added up instead of read from the context, so that the state can be copied to a diagram with another time.
        state[_CHECK_TIME] = now + self._period
        state[_CLOCK_INPUT] = self._clock_port.Eval(context)[0] if self._clock_port.HasValue(context) else np.nan
        if evaluation.fault:
            state[_FAULT], state[_FAULT_TIME] = evaluation.fault, now
        elif state[_CHECK_TIME] - state[_FAULT_TIME] > self._limits.settling_time:
            state[_FAULT] = Fault.NONE
        if evaluation.fault in RECOVERABLE_FAULTS:
            state[_DOUBT_TIME] = now
        elif state[_CHECK_TIME] - state[_DOUBT_TIME] > self._limits.settling_time:
            state[_DOUBT_TIME] = np.nan
        discrete_state.set_value(self._state, state)

    def _next_offset(self, measured: float, evaluation: _Evaluation, state: np.ndarray, now: float) -> float:
        """Return the clock offset [s] after a status with the measured offset `measured`."""
        is_synchronized = evaluation.fault in ACCEPTABLE_FAULTS and np.isfinite(state[_STATUS_TIME])
        is_late = evaluation.fault == Fault.STALE and now - state[_RECEIPT_TIME] <= self._limits.max_age
        if not (is_synchronized or is_late):
            return measured
        delay = measured - evaluation.offset
        max_increase = self._limits.clock_drift * self._period
        return evaluation.offset + (min(delay, max_increase) if delay > 0.0 else EARLY_FRACTION * delay)

    def _calc_estimated_state(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._evaluation.Eval(context).accepted[: 2 * self._num_joints])

    def _calc_external_torque(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._evaluation.Eval(context).accepted[2 * self._num_joints :])

    def _calc_fault(self, context: Context, output: BasicVector) -> None:
        output.SetAtIndex(0, float(self._evaluation.Eval(context).fault or self._state_of(context)[_FAULT]))

    def _calc_age(self, context: Context, output: BasicVector) -> None:
        output.SetAtIndex(0, self._evaluation.Eval(context).age)

    def _calc_is_new(self, context: Context, output: BasicVector) -> None:
        output.SetAtIndex(0, float(self._evaluation.Eval(context).is_accepted))
