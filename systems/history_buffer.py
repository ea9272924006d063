"""Buffer of the last outputs of a movement primitive (thesis, equation 5.3)."""

import numpy as np
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from guiderail.models.common.arrays import as_numbers, is_finite
from guiderail.models.common.errors import InputError
from guiderail.models.common.transforms import nearest_pose
from guiderail.models.laws.primitive import appended
from guiderail.systems.support import declarations as declare
from guiderail.systems.support.declarations import as_count, input_getter, output_getter

MAX_NUMBERS = 1_000_000  # largest number of stored numbers (8 MB)


class HistoryBuffer(LeafSystem):
    """Buffer of the last P outputs, the via-points of sKGRL's movement primitive.

        history = [y_{t−P} … y_{t−1}]    (T_p of equation 5.3)

    At every control step, the newest output replaces the oldest. An initialization fills all P entries with
    ``initial_output``, the measured pose if ``output`` is a command. A history of measured outputs has the same signal
    at both ports.

    .. pydrake_system::

        name: HistoryBuffer
        input_ports:
        - output
        - initial_output
        output_ports:
        - history

    ``output`` and ``initial_output`` are (O,), ``history`` is (P*O,), row-major, oldest first, in the units of
    ``output``. ``history`` is a discrete state without direct feedthrough, so that the feedback loop with the primitive
    is not algebraic.

    Args:
        num_outputs: Size O of an output, at least 1.
        length: Number P of stored outputs, at least 1; P·O is at most a million.
        period: Control period [s], positive.
        near: Pose (6,), [x y z Rz Ry Rx], such as the first mean of the reference; None: outputs are stored unchanged.
            With it, the angles of the first output are those of its orientation nearest to `near`, and the angles of
            each output those nearest to the output before (`nearest_pose`), so that the history has no jumps. Without
            it, `LcNsKmpSystem` refuses a start more than half a turn from its reference.

    Raises:
        InputError: If an argument is out of range; at initialization, if ``initial_output`` is not connected or not
            finite.
    """

    def __init__(self, num_outputs: int, length: int, period: float, near: np.ndarray | None = None):
        super().__init__()
        num_outputs, length = as_count(num_outputs, "num_outputs of a history"), as_count(length, "length of a history")
        if length * num_outputs > MAX_NUMBERS:
            raise InputError(f"a history has at most {MAX_NUMBERS} numbers, not {length} times {num_outputs}")
        self._shape = (length, num_outputs)
        self._near = None if near is None else as_numbers(near, "near")
        if self._near is not None and not (num_outputs == 6 and self._near.shape == (6,) and is_finite(self._near)):
            raise InputError("near is a finite pose (6,) of a history with 6 outputs: leave it out for other outputs")

        self._output_port = self.DeclareVectorInputPort("output", num_outputs)
        self._initial_output_port = self.DeclareVectorInputPort("initial_output", num_outputs)
        self._state = declare.unset_state(self, length * num_outputs)
        declare.output(
            self,
            "history",
            length * num_outputs,
            lambda context: declare.initialized(self, context, self._state),
            [self._state],
        )
        declare.update_after_start(self, period, self._shift, self._fill)

    get_output_input_port = input_getter("output", "output to store, (O,)")
    get_initial_output_input_port = input_getter("initial_output", "output that fills the history, (O,)")
    get_history_output_port = output_getter("history", "last P outputs, (P*O,), oldest first")

    def _fill(self, context: Context, discrete_state: DiscreteValues) -> None:
        if not self._initial_output_port.HasValue(context):
            raise InputError(
                "a history begins at its input 'initial_output': connect the measured pose, because the motion would "
                "begin elsewhere"
            )
        initial = self._initial_output_port.Eval(context)
        if not is_finite(initial):
            raise InputError(f"the output that fills a history at the start must be finite, not {initial}")
        discrete_state.set_value(
            self._state, np.tile(initial if self._near is None else nearest_pose(initial, self._near), self._shape[0])
        )

    def _shift(self, context: Context, discrete_state: DiscreteValues) -> None:
        stored = declare.initialized(self, context, self._state).reshape(self._shape)
        history = appended(stored, self._output_port.Eval(context), is_pose=self._near is not None)
        discrete_state.set_value(self._state, history.ravel())
