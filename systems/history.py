"""History of a movement primitive's outputs, and its length (thesis, equation 5.3 and section 5.5)."""

from collections.abc import Sequence

import numpy as np
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from guiderail.models.common.errors import InputError
from guiderail.models.common.transforms import nearest_pose
from guiderail.models.laws.primitive import appended
from guiderail.systems.support import declarations as declare
from guiderail.systems.support.declarations import input_getter, output_getter


class HistoryBuffer(LeafSystem):
    """Buffer of the last P outputs, the via-points of sKGRL's movement primitive.

        history = [y_{t−P} … y_{t−1}]    (T_p of equation 5.3)

    At every control step, the newest output replaces the oldest. An initialization fills all P entries with
    ``initial_output``, the measured pose if ``output`` is a command. A history of measured outputs has the same signal
    at both ports.

    ``output`` and ``initial_output`` are (O,), ``history`` is (P*O,), row-major, oldest first, in the units of
    ``output``. ``history`` is a discrete state without direct feedthrough, so that the feedback loop with the primitive
    is not algebraic.

    Args:
        num_outputs: Size O of an output, at least 1.
        length: Number P of stored outputs, at least 1.
        period: Control period [s], positive.
        near: Pose (6,), [x y z Rz Ry Rx], such as the first mean of the reference; None: outputs are stored unchanged.
            With it, the angles of the first output are those of its orientation nearest to `near`, and the angles of
            each output those nearest to the output before (`nearest_pose`), so that the history has no jumps. Without
            it, `LcNsKmpSystem` refuses a start more than half a turn from its reference.

    Raises:
        InputError: At initialization, if ``initial_output`` is not finite.
    """

    def __init__(self, num_outputs: int, length: int, period: float, near: np.ndarray | None = None):
        super().__init__()
        self._shape = (length, num_outputs)
        self._near = near
        self._output_port = self.DeclareVectorInputPort("output", num_outputs)
        self._initial_output_port = self.DeclareVectorInputPort("initial_output", num_outputs)
        self._state = declare.unset_state(self, length * num_outputs)
        declare.output(self, "history", length * num_outputs, self._history, [self._state])
        declare.update_after_start(self, period, self._shift, self._fill)

    get_output_input_port = input_getter("output", "output to store, (O,)")
    get_initial_output_input_port = input_getter("initial_output", "output that fills the history, (O,)")
    get_history_output_port = output_getter("history", "last P outputs, (P*O,), oldest first")

    def _history(self, context: Context) -> np.ndarray:
        return declare.initialized(self, context, self._state)

    def _fill(self, context: Context, discrete_state: DiscreteValues) -> None:
        initial = declare.start_pose(self._initial_output_port.Eval(context))
        first = initial if self._near is None else nearest_pose(initial, self._near)
        discrete_state.set_value(self._state, np.tile(first, self._shape[0]))

    def _shift(self, context: Context, discrete_state: DiscreteValues) -> None:
        stored = self._history(context).reshape(self._shape)
        history = appended(stored, self._output_port.Eval(context), is_pose=self._near is not None)
        discrete_state.set_value(self._state, history.ravel())


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
