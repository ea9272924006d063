"""Watches what a robot's driver says, and passes on only what can be believed."""

from dataclasses import dataclass

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import (
    BasicVector,
    Context,
    DiscreteValues,
    EventStatus,
    InputPort,
    LeafSystem,
    OutputPort,
)

from guiderail.models.control.joint_status import Fault, JointStatus, LastStatus, StatusLimits, check_status
from guiderail.systems.support.caching import declare_cache
from guiderail.systems.support.sampling import check_period

# Entries of the state besides the last readable status itself.
_CLOCK, _TOLD, _TIME, _OFFSET, _HEARD_AT, _FAULT, _FAULT_AT, _DOUBTED_AT, _KNOWN_TIME, _KNOWN_OFFSET = range(10)
_SOUND = (Fault.NONE, Fault.DEADLINE_MISSED)  # what is no fault of the status itself
# After the first three the clocks are synchronized anew, and how late a status is nobody knows: damping by speeds of
# long ago drives an arm. So does damping by the inertia of another posture. Only a status that agrees with what was
# known before is as good as any.
_DOUBTFUL = (Fault.STALE, Fault.OUT_OF_ORDER, Fault.FUTURE, Fault.POSITION_JUMP)
_FRESH = 0.5  # of the greatest age: speeds no older than that are damped without swinging
# A status that comes earlier than the clocks' offset says was delayed less than those that the offset is from. If that
# were taken over at once, a single one from elsewhere would make all others late.
_SOONER = 0.2
_FORGOTTEN = (0.0, np.nan, np.nan, 0.0, 0.0, float(Fault.NO_STATUS), 0.0, np.nan, np.nan, 0.0)


@dataclass(frozen=True)
class _Verdict:
    """Of the newest status: what is wrong with it, whether it is new and believed, what is believed then, (3n,), how
    old that is [s], and by which clock's offset [s] it was judged.
    """

    fault: Fault
    is_new: bool
    is_believed: bool
    believed: np.ndarray
    age: float
    offset: float


class StatusWatchdog(LeafSystem):
    """Judges every status of a robot, passes the last sound one on, and says what is wrong.

    `check_status` names the fault. A fault is reported until statuses have been sound for the settling time, so that
    after a start, or after a driver's restart, nobody acts on the first one already. The two clocks are synchronized
    when the first status comes, after that by the statuses that come soonest, slowly where all come later, and anew
    after a fault or a silence: then the next status is judged by the one that was at fault, if its numbers were sound.
    Where the clock on the wall is told, this program's own delays are no robot's fault, and one that is too long is a
    fault of its own. After a silence or a jump, of a clock or a position, nothing is believed before the settling time
    is over, but what agrees with the clock and the positions as they were before: a single status from elsewhere blinds
    nobody.

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

    ``status`` is an abstract value: the newest `JointStatus`, or None. ``clock`` is (1,), the time on the wall at this
    check [s]; unconnected, each check is a period after the one before. ``estimated_state`` is (2n,), positions and velocities
    [rad, rad/s], and ``external_torque`` (n,) [Nm], both of the last sound status and zero before it. ``fault`` is
    (1,), a code of `Fault`. ``age`` is (1,), how old the last sound status is, by the soonest that came [s], and
    ``is_new`` (1,) is 1 at the check at which it came.
    """

    def __init__(self, limits: StatusLimits, *, period: float):
        """
        Args:
            limits: what a status must keep to.
            period: at which statuses are checked [s], positive: how often they come.

        Raises:
            InputError: if an argument is out of range.
        """
        super().__init__()
        check_period(period)
        self._limits, self._period = limits, period
        self._num_joints = num_joints = len(limits.velocity)
        self._status_port = self.DeclareAbstractInputPort("status", Value[object]())
        self._clock_port = self.DeclareVectorInputPort("clock", 1)
        self._memory = self.DeclareDiscreteState(_FORGOTTEN)
        self._last = self.DeclareDiscreteState(3 * num_joints)  # readable, whether sound or not
        self._believed = self.DeclareDiscreteState(3 * num_joints)
        tickets = {
            self._status_port.ticket(),
            self._clock_port.ticket(),
            self.discrete_state_ticket(self._memory),
            self.discrete_state_ticket(self._last),
            self.discrete_state_ticket(self._believed),
        }
        self._verdict = declare_cache(self, "verdict", self._judge, prerequisites_of_calc=tickets)
        verdict = {self._verdict.ticket()}
        self._estimated_state_port = self.DeclareVectorOutputPort(
            "estimated_state", 2 * num_joints, self._calc_estimated_state, prerequisites_of_calc=verdict
        )
        self._external_torque_port = self.DeclareVectorOutputPort(
            "external_torque", num_joints, self._calc_external_torque, prerequisites_of_calc=verdict
        )
        self._fault_port = self.DeclareVectorOutputPort(
            "fault", 1, self._calc_fault, prerequisites_of_calc=verdict | tickets
        )
        self._age_port = self.DeclareVectorOutputPort("age", 1, self._calc_age, prerequisites_of_calc=verdict)
        self._is_new_port = self.DeclareVectorOutputPort("is_new", 1, self._calc_is_new, prerequisites_of_calc=verdict)
        self.DeclareInitializationDiscreteUpdateEvent(self._forget)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._remember)

    def get_status_input_port(self) -> InputPort:
        """The newest status, an abstract `JointStatus`; any other object is none."""
        return self._status_port

    def get_clock_input_port(self) -> InputPort:
        """The time on the wall, (1,) [s]; optional."""
        return self._clock_port

    def get_estimated_state_output_port(self) -> OutputPort:
        """Positions and velocities of the last sound status, (2n,) [rad, rad/s]."""
        return self._estimated_state_port

    def get_external_torque_output_port(self) -> OutputPort:
        """External torques of the last sound status, (n,) [Nm]."""
        return self._external_torque_port

    def get_fault_output_port(self) -> OutputPort:
        """What is, or shortly was, wrong with the status, (1,): a code of `Fault`."""
        return self._fault_port

    def get_age_output_port(self) -> OutputPort:
        """How old the last sound status is, (1,) [s]."""
        return self._age_port

    def get_is_new_output_port(self) -> OutputPort:
        """1 where a sound status has just come, (1,)."""
        return self._is_new_port

    def _memory_of(self, context: Context) -> np.ndarray:
        return context.get_discrete_state(self._memory).value()

    def _now(self, context: Context) -> float:
        memory = self._memory_of(context)
        if self._clock_port.HasValue(context):
            told = float(self._clock_port.Eval(context)[0])
            # What was told for the last check is no time for the status that came after it.
            if told != memory[_TOLD]:
                return told
        return float(memory[_CLOCK])

    def _judge(self, context: Context) -> _Verdict:
        found = self._status_port.Eval(context)
        status = found if isinstance(found, JointStatus) else None
        memory, values = self._memory_of(context), context.get_discrete_state(self._last).value()
        last = LastStatus(float(memory[_TIME]), float(memory[_OFFSET]), values)
        believed = context.get_discrete_state(self._believed).value().copy()
        now, is_known = self._now(context), not np.isfinite(memory[_DOUBTED_AT])
        known = LastStatus(float(memory[_KNOWN_TIME]), float(memory[_KNOWN_OFFSET]), believed)
        if status is not None and not is_known and self._agrees(status, known, now):
            last, is_known = known, True
        fault = check_status(status, last, now, self._limits)
        if not fault and now - memory[_CLOCK] > self._limits.max_check_interval:
            fault = Fault.DEADLINE_MISSED
        since = memory[_KNOWN_TIME] + memory[_KNOWN_OFFSET]
        age = max(now - since, 0.0) if np.isfinite(since) else now
        if status is None or fault in (Fault.MALFORMED, Fault.WRONG_SIZE, Fault.NOT_FINITE):
            return _Verdict(fault, False, False, believed, age, last.offset)
        newest = status.values()
        is_overtaken = status.time <= last.time and not fault
        is_new = not is_overtaken and (status.time != last.time or not np.array_equal(newest, last.values))
        is_believed = is_new and fault in _SOUND and is_known
        if is_believed:
            believed = newest
            age = max(now - (status.time + last.offset), 0.0) if np.isfinite(last.time) else 0.0
        return _Verdict(fault, is_new, is_believed, believed, age, last.offset)

    def _agrees(self, status: JointStatus, known: LastStatus, now: float) -> bool:
        """Whether a status is sound and fresh by what was known."""
        is_fresh = status.time > known.time and now - (status.time + known.offset) <= _FRESH * self._limits.max_age
        return is_fresh and check_status(status, known, now, self._limits) == Fault.NONE

    def _forget(self, context: Context, discrete_state: DiscreteValues) -> EventStatus:
        discrete_state.set_value(self._memory, _FORGOTTEN)
        for group in (self._last, self._believed):
            discrete_state.set_value(group, np.zeros(3 * self._num_joints))
        return EventStatus.Succeeded()

    def _remember(self, context: Context, discrete_state: DiscreteValues) -> EventStatus:
        verdict, memory = self._verdict.Eval(context), self._memory_of(context).copy()
        now = self._now(context)
        if verdict.is_new:
            status: JointStatus = self._status_port.Eval(context)
            wanted = now - status.time
            is_in_step = verdict.fault in _SOUND and np.isfinite(memory[_TIME])
            is_late = verdict.fault == Fault.STALE and now - memory[_HEARD_AT] <= self._limits.max_age
            if is_in_step or is_late:
                later = wanted - verdict.offset
                slowly = self._limits.clock_drift * self._period
                wanted = verdict.offset + (min(later, slowly) if later > 0.0 else _SOONER * later)
            memory[_TIME], memory[_OFFSET], memory[_HEARD_AT] = status.time, wanted, now
            discrete_state.set_value(self._last, status.values())
            if verdict.is_believed:
                memory[_KNOWN_TIME], memory[_KNOWN_OFFSET] = status.time, wanted
                discrete_state.set_value(self._believed, verdict.believed)
        # Added up instead of read, so that what is remembered can be carried over to a diagram with another clock.
        memory[_CLOCK] = now + self._period
        memory[_TOLD] = self._clock_port.Eval(context)[0] if self._clock_port.HasValue(context) else np.nan
        if verdict.fault:
            memory[_FAULT], memory[_FAULT_AT] = verdict.fault, now
        elif memory[_CLOCK] - memory[_FAULT_AT] > self._limits.settling_time:
            memory[_FAULT] = Fault.NONE
        if verdict.fault in _DOUBTFUL:
            memory[_DOUBTED_AT] = now
        elif memory[_CLOCK] - memory[_DOUBTED_AT] > self._limits.settling_time:
            memory[_DOUBTED_AT] = np.nan
        discrete_state.set_value(self._memory, memory)
        return EventStatus.Succeeded()

    def _calc_estimated_state(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._verdict.Eval(context).believed[: 2 * self._num_joints])

    def _calc_external_torque(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._verdict.Eval(context).believed[2 * self._num_joints :])

    def _calc_fault(self, context: Context, output: BasicVector) -> None:
        output.SetAtIndex(0, float(self._verdict.Eval(context).fault or self._memory_of(context)[_FAULT]))

    def _calc_age(self, context: Context, output: BasicVector) -> None:
        output.SetAtIndex(0, self._verdict.Eval(context).age)

    def _calc_is_new(self, context: Context, output: BasicVector) -> None:
        output.SetAtIndex(0, float(self._verdict.Eval(context).is_believed))
