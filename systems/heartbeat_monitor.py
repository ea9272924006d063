"""Monitor of the heartbeat of a robot-side safety monitor."""

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem

from guiderail.models.common.errors import InputError
from guiderail.models.control.joint_status import Fault, Heartbeat
from guiderail.systems.support.declarations import check_period, input_getter, output_getter


class HeartbeatMonitor(LeafSystem):
    """Raise a fault when the robot-side safety monitor reports a stop or its heartbeat times out.

    No fault is raised before the first heartbeat, so that a robot without a safety monitor can be used.

    .. pydrake_system::

        name: HeartbeatMonitor
        input_ports:
        - heartbeat
        - status_fault
        output_ports:
        - fault

    ``heartbeat`` is abstract: the newest `Heartbeat`, or None. ``status_fault`` and ``fault`` are (1,), codes of
    `Fault`; a status fault takes precedence.

    Args:
        period: Sampling period [s], positive.
        timeout: Largest accepted age of a heartbeat [s], positive.

    Raises:
        InputError: If an argument is out of range.
    """

    def __init__(self, *, period: float, timeout: float):
        super().__init__()
        check_period(period)
        if not 0.0 < timeout < np.inf:
            raise InputError(f"the heartbeat timeout must be positive, not {timeout} s")
        self._period, self._timeout = period, timeout
        self._heartbeat_port = self.DeclareAbstractInputPort("heartbeat", Value[object]())
        self._status_fault_port = self.DeclareVectorInputPort("status_fault", 1)
        # [sequence number of the newest heartbeat, NaN before the first; time since that heartbeat in s]
        self._state = self.DeclareDiscreteState([np.nan, 0.0])
        self._fault_port = self.DeclareVectorOutputPort(
            "fault",
            1,
            self._calc_fault,
            prerequisites_of_calc={
                self._heartbeat_port.ticket(),
                self._status_fault_port.ticket(),
                self.discrete_state_ticket(self._state),
            },
        )
        self.DeclareInitializationDiscreteUpdateEvent(self._reset)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)

    get_heartbeat_input_port = input_getter("heartbeat", "newest `Heartbeat`; any other object counts as none")
    get_status_fault_input_port = input_getter("status_fault", "status fault, (1,), a code of `Fault`")
    get_fault_output_port = output_getter("fault", "combined fault, (1,), a code of `Fault`")

    def is_alive(self, context: Context) -> bool:
        """Return True if a heartbeat has been received and has not timed out."""
        return self._heartbeat(context) is not None and not self._has_timed_out(context)

    def _heartbeat(self, context: Context) -> Heartbeat | None:
        value = self._heartbeat_port.Eval(context)
        return value if isinstance(value, Heartbeat) else None

    def _has_timed_out(self, context: Context) -> bool:
        heartbeat = self._heartbeat(context)
        last_sequence, age = context.get_discrete_state(self._state).value()
        return heartbeat is not None and heartbeat.sequence == last_sequence and age > self._timeout

    def _reset(self, context: Context, discrete_state: DiscreteValues) -> None:
        discrete_state.set_value([np.nan, 0.0])

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        heartbeat = self._heartbeat(context)
        last_sequence, age = context.get_discrete_state(self._state).value()
        if heartbeat is not None and heartbeat.sequence != last_sequence:
            discrete_state.set_value([heartbeat.sequence, 0.0])
        else:
            discrete_state.set_value([last_sequence, age + self._period])

    def _calc_fault(self, context: Context, output: BasicVector) -> None:
        fault = float(self._status_fault_port.Eval(context)[0])
        heartbeat = self._heartbeat(context)
        if fault == Fault.NONE and heartbeat is not None and (heartbeat.is_stopping or self._has_timed_out(context)):
            fault = float(Fault.MONITOR_STOP)
        output.SetAtIndex(0, fault)
