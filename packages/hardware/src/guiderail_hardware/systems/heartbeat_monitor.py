"""Monitor of the heartbeats of robot-side safety monitors."""

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from guiderail.models.common.arrays import as_number
from guiderail.models.common.errors import InputError
from guiderail.systems.support import declarations as declare
from guiderail.systems.support.declarations import input_getter, output_getter
from guiderail_hardware.models.joint_status import MAX_SENDERS, Fault, Heartbeat

FORGET_TIME = 1.0  # age of a heartbeat above which its sender is ignored while another monitor is alive [s]


class HeartbeatMonitor(LeafSystem):
    """Raise a fault when a robot-side safety monitor reports a stop or its heartbeat times out.

    The age of each sender's heartbeat is checked, so that the exit of one monitor is detected while another monitor is
    alive. So that a monitor can be replaced, a heartbeat older than `FORGET_TIME` is ignored while another monitor is
    alive. No fault is raised before the first heartbeat, so that a robot without a safety monitor can be used.

    .. pydrake_system::

        name: HeartbeatMonitor
        input_ports:
        - heartbeats
        - status_fault
        output_ports:
        - fault

    ``heartbeats`` is abstract: a tuple with the newest `Heartbeat` of each sender. ``status_fault`` and ``fault`` are
    (1,), codes of `Fault`; a status fault takes precedence.

    Args:
        period: Sampling period [s], positive.
        timeout: Largest accepted age of a heartbeat [s], positive and less than `FORGET_TIME`. With a larger timeout,
            the exit of one monitor would never be detected while another monitor is alive.

    Raises:
        InputError: If an argument is out of range.
    """

    def __init__(self, *, period: float, timeout: float):
        super().__init__()
        if not 0.0 < as_number(timeout, "timeout") < FORGET_TIME:
            raise InputError(f"the heartbeat timeout must be positive and less than {FORGET_TIME} s, not {timeout} s")
        self._period, self._timeout = period, timeout
        self._heartbeats_port = self.DeclareAbstractInputPort("heartbeats", Value[object]())
        self._status_fault_port = self.DeclareVectorInputPort("status_fault", 1)
        # [sender; its last sequence number; time since that heartbeat in s] of each sender; NaN if unused.
        self._state = self.DeclareDiscreteState(np.full(3 * MAX_SENDERS, np.nan))
        declare.scalar_output(self, "fault", self._fault, [self._heartbeats_port, self._status_fault_port, self._state])
        declare.update(self, period, self._update, declare.reset_to_default(self))

    get_heartbeats_input_port = input_getter("heartbeats", "newest `Heartbeat` of each sender; other types are ignored")
    get_status_fault_input_port = input_getter("status_fault", "status fault, (1,), a code of `Fault`")
    get_fault_output_port = output_getter("fault", "combined fault, (1,), a code of `Fault`")

    def is_alive(self, context: Context) -> bool:
        """Return True if a heartbeat of any monitor has been received and has not timed out."""
        return bool((self._senders(context)[:, 2] <= self._timeout).any())

    def _heartbeats(self, context: Context) -> tuple[Heartbeat, ...]:
        value = self._heartbeats_port.Eval(context)
        return value if isinstance(value, tuple) else ()

    def _senders(self, context: Context) -> np.ndarray:
        """Return sender, sequence and age of each known monitor, (m, 3), updated with the newest heartbeats."""
        senders = context.get_discrete_state().value(self._state).reshape(MAX_SENDERS, 3)
        known = {sender: (sequence, age) for sender, sequence, age in senders.tolist() if not np.isnan(sender)}
        for heartbeat in self._heartbeats(context):
            if heartbeat.sender not in known or heartbeat.sequence > known[heartbeat.sender][0]:
                known[heartbeat.sender] = (heartbeat.sequence, 0.0)
        rows = sorted((age, sender, sequence) for sender, (sequence, age) in known.items())[:MAX_SENDERS]
        return np.array([(sender, sequence, age) for age, sender, sequence in rows]).reshape(len(rows), 3)

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        state, senders = np.full(3 * MAX_SENDERS, np.nan), self._senders(context)
        senders[:, 2] += self._period
        state[: senders.size] = senders.ravel()
        discrete_state.set_value(state)

    def _fault(self, context: Context) -> float:
        fault = float(self._status_fault_port.Eval(context)[0])
        if fault == Fault.NONE and self._is_stopping_or_missing(context):
            return float(Fault.MONITOR_STOP)
        return fault

    def _is_stopping_or_missing(self, context: Context) -> bool:
        ages = {sender: age for sender, _, age in self._senders(context).tolist()}
        is_alive = {sender: age <= self._timeout for sender, age in ages.items()}
        is_stopping = any(beat.is_stopping and is_alive.get(beat.sender) for beat in self._heartbeats(context))
        is_missing = any(not alive and ages[sender] <= FORGET_TIME for sender, alive in is_alive.items())
        return is_stopping or is_missing or (bool(ages) and not any(is_alive.values()))
