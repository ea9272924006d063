"""Buffer of the last outputs of a movement primitive (thesis, equation 5.3)."""

import numpy as np
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

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
