"""Watches whoever stands by at a robot, to stop it where commands stop."""

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

from guiderail.models.common.errors import InputError
from guiderail.models.control.joint_status import Fault, Heartbeat
from guiderail.systems.support.sampling import check_period

# Entries of the state: the number of the last word, NaN before the first; and for how long there was no new one.
_NUMBER, _SILENCE = range(2)


class HeartbeatMonitor(LeafSystem):
    """Adds to the faults of a robot's status that its deputy has stopped it, or has fallen silent.

    A deputy that was never heard is not missed.

    .. pydrake_system::

        name: HeartbeatMonitor
        input_ports:
        - word
        - status_fault
        output_ports:
        - fault

    ``word`` is an abstract value: the newest `Heartbeat`, or None. ``status_fault`` and ``fault`` are (1,), codes of
    `Fault`; one of the status comes first.
    """

    def __init__(self, *, period: float, command_timeout: float):
        """
        Args:
            period: at which is checked [s], positive.
            patience: for how long a deputy may say nothing [s], positive.

        Raises:
            InputError: if an argument is out of range.
        """
        super().__init__()
        check_period(period)
        if not 0.0 < command_timeout < np.inf:
            raise InputError(f"the time for which a deputy may say nothing must be positive, not {command_timeout} s")
        self._period, self._patience = period, command_timeout
        self._word_port = self.DeclareAbstractInputPort("word", Value[object]())
        self._status_fault_port = self.DeclareVectorInputPort("status_fault", 1)
        self._memory = self.DeclareDiscreteState([np.nan, 0.0])
        self._fault_port = self.DeclareVectorOutputPort(
            "fault",
            1,
            self._calc_fault,
            prerequisites_of_calc={
                self._word_port.ticket(),
                self._status_fault_port.ticket(),
                self.discrete_state_ticket(self._memory),
            },
        )
        self.DeclareInitializationDiscreteUpdateEvent(self._forget)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._remember)

    def get_word_input_port(self) -> InputPort:
        """The deputy's newest word, an abstract `Heartbeat`; any other object is none."""
        return self._word_port

    def get_status_fault_input_port(self) -> InputPort:
        """What is wrong with the status, (1,)."""
        return self._status_fault_port

    def get_fault_output_port(self) -> OutputPort:
        """What is wrong with the status or the deputy, (1,): a code of `Fault`."""
        return self._fault_port

    def is_heard(self, context: Context) -> bool:
        """Whether there was a word, and the last one is not too long ago."""
        return self._word(context) is not None and not self._is_silent(context)

    def _is_silent(self, context: Context) -> bool:
        word = self._word(context)
        number, silence = context.get_discrete_state(self._memory).value()
        return word is not None and word.number == number and silence > self._patience

    def _word(self, context: Context) -> Heartbeat | None:
        found = self._word_port.Eval(context)
        return found if isinstance(found, Heartbeat) else None

    def _forget(self, context: Context, discrete_state: DiscreteValues) -> EventStatus:
        discrete_state.set_value([np.nan, 0.0])
        return EventStatus.Succeeded()

    def _remember(self, context: Context, discrete_state: DiscreteValues) -> EventStatus:
        word = self._word(context)
        number, silence = context.get_discrete_state(self._memory).value()
        if word is not None and word.number != number:
            discrete_state.set_value([word.number, 0.0])
        else:
            discrete_state.set_value([number, silence + self._period])
        return EventStatus.Succeeded()

    def _calc_fault(self, context: Context, output: BasicVector) -> None:
        fault = float(self._status_fault_port.Eval(context)[0])
        word = self._word(context)
        if fault == Fault.NONE and word is not None and (word.is_acting or self._is_silent(context)):
            fault = float(Fault.MONITOR_STOP)
        output.SetAtIndex(0, fault)
