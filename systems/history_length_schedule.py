"""History length of sKGRL: short in contact, long in free space (thesis, section 5.5)."""

from collections.abc import Sequence

import numpy as np
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from guiderail.models.common.errors import InputError
from guiderail.systems.support import declarations as declare
from guiderail.systems.support.declarations import input_getter, output_getter


class HistoryLengthSchedule(LeafSystem):
    """Shorten the history of sKGRL in contact and lengthen it again in free space.

    In contact, the length changes to the next shorter of `lengths` at every control step. In free space, it changes to
    the next longer of `lengths` after every `dwell_steps` control steps. Contact is detected with hysteresis: it begins
    when the measured force exceeds `contact_threshold` and ends when the force is at most `release_threshold`. A force
    of NaN counts as contact.

    ``wrench`` is (W,), measured; its first three entries, or all entries if W is less than 3, are a force [N].
    ``history_length`` is (1,), the number P of stored outputs; it is discrete state, initially the longest length.

    Args:
        lengths: History lengths in any order, whole numbers of at least 1, at least one. 0 is refused, because without
            a history a command would not start at the end of the previous command.
        period: Control period [s], positive.
        contact_threshold: Force above which contact begins [N], finite.
        release_threshold: Force at or below which contact ends [N], from 0 to `contact_threshold`.
        dwell_steps: Number of control steps in free space before the next longer length, at least 1.
        wrench_size: Size W of the wrench, at least 1.

    Raises:
        InputError: If an argument is out of range.
    """

    def __init__(
        self,
        lengths: Sequence[int],
        period: float,
        *,
        contact_threshold: float = 2.0,
        release_threshold: float = 1.0,
        dwell_steps: int = 10,
        wrench_size: int = 6,
    ):
        super().__init__()
        if not len(lengths) or not all(length >= 1 and float(length).is_integer() for length in lengths):
            raise InputError(f"history lengths are whole numbers from 1, at least one of them, not {list(lengths)}")
        if not 0.0 <= release_threshold <= contact_threshold < np.inf:
            raise InputError(f"a contact begins above {contact_threshold} N: let it end at 0 to this force")
        self._lengths = sorted({int(length) for length in lengths}, reverse=True)
        self._contact_threshold, self._release_threshold = contact_threshold, release_threshold
        self._dwell_steps = dwell_steps
        self._wrench_port = self.DeclareVectorInputPort("wrench", wrench_size)
        # [index into `_lengths`, longest first; 1 in contact, else 0; steps in free space since contact or an increase]
        self._state = self.DeclareDiscreteState(3)
        declare.scalar_output(
            self,
            "history_length",
            lambda context: self._lengths[int(context.get_discrete_state().value(self._state)[0])],
            [self._state],
        )
        declare.update(self, period, self._update, declare.reset_to_default(self))

    get_wrench_input_port = input_getter("wrench", "measured wrench, (W,), force first")
    get_history_length_output_port = output_getter("history_length", "history length P, (1,)")

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        index, in_contact, num_free_steps = context.get_discrete_state().value(self._state)
        force = float(np.linalg.norm(self._wrench_port.Eval(context)[:3]))
        # `not force <=` instead of `force >`, so that NaN counts as contact.
        in_contact = not force <= (self._release_threshold if in_contact else self._contact_threshold)
        if in_contact:
            index, num_free_steps = min(index + 1, len(self._lengths) - 1), 0
        else:
            num_free_steps += 1
            if num_free_steps >= self._dwell_steps:
                index, num_free_steps = max(index - 1, 0), 0
        discrete_state.set_value(self._state, [index, in_contact, num_free_steps])
