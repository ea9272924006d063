"""How much of its past a movement primitive follows: less in contact, more in free space (thesis, section 5.5)."""

from collections.abc import Sequence

import numpy as np
from pydrake.systems.framework import (
    BasicVector,
    Context,
    DiscreteValues,
    EventStatus,
    InputPort,
    LeafSystem,
    OutputPort,
)

from guiderail.models.errors import InputError


class HistoryLengthSchedule(LeafSystem):
    """Shortens the history of sKGRL while the robot touches something, and lengthens it again when it is free.

    Lengths are tried one after the other, never skipped: one shorter at every control step in contact, one longer after
    every `patience` control steps in free space. Contact begins where the measured force exceeds `touch` and ends where
    it falls below `release`; in between it stays what it was, so that noise about a threshold changes nothing.

    .. pydrake_system::

        name: HistoryLengthSchedule
        input_ports:
        - wrench
        output_ports:
        - history_length

    ``wrench`` (W,) is measured, its first three numbers a force [N] (both, where there are only two).
    ``history_length`` (1,) is P; it is state, and begins with the longest.
    """

    def __init__(
        self,
        lengths: Sequence[int],
        period: float,
        *,
        touch: float = 2.0,
        release: float = 1.0,
        patience: int = 10,
        wrench_size: int = 6,
    ):
        """
        Args:
            lengths: the lengths there are, in any order, each at least 1: with no history at all a command would not
                begin where the last one ended.
            period: seconds between control steps, positive.
            touch, release: N, 0 ≤ release ≤ touch.
            patience: control steps in free space until the history grows by one length, at least 1.
            wrench_size: W, at least 1.

        Raises:
            InputError: if an argument is out of range.
        """
        super().__init__()
        if not len(lengths) or min(lengths) < 1:
            raise InputError(f"history lengths are whole numbers from 1, at least one of them, not {list(lengths)}")
        if not 0.0 <= release <= touch:
            raise InputError(f"contact must end below the force where it begins: 0 <= {release} <= {touch} is not so")
        if patience < 1 or wrench_size < 1 or not period > 0:
            raise InputError(
                f"patience, wrench size and period must be at least 1, 1 and more than 0, "
                f"not {patience}, {wrench_size} and {period}"
            )
        self._lengths = sorted({int(length) for length in lengths}, reverse=True)
        self._touch, self._release, self._patience = touch, release, patience
        self._wrench_port = self.DeclareVectorInputPort("wrench", wrench_size)
        # [index into the lengths, longest first; 1 in contact; control steps since the last change in free space]
        self._state = self.DeclareDiscreteState(3)
        self._length_port = self.DeclareVectorOutputPort(
            "history_length", 1, self._calc_length, {self.discrete_state_ticket(self._state)}
        )
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)

    def get_wrench_input_port(self) -> InputPort:
        """The measured wrench, (W,), force first."""
        return self._wrench_port

    def get_history_length_output_port(self) -> OutputPort:
        """P, (1,)."""
        return self._length_port

    def _update(self, context: Context, discrete_state: DiscreteValues) -> EventStatus:
        index, touching, waited = context.get_discrete_state(self._state).value()
        force = float(np.linalg.norm(self._wrench_port.Eval(context)[:3]))
        touching = force > (self._release if touching else self._touch)
        if touching:
            index, waited = min(index + 1, len(self._lengths) - 1), 0
        else:
            waited += 1
            if waited >= self._patience:
                index, waited = max(index - 1, 0), 0
        discrete_state.set_value(self._state, [index, touching, waited])
        return EventStatus.Succeeded()

    def _calc_length(self, context: Context, output: BasicVector) -> None:
        output.SetAtIndex(0, self._lengths[int(context.get_discrete_state(self._state).value()[0])])
