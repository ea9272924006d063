"""Wrench limits that change with the state of a shared control template."""

import numpy as np
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from guiderail.models.common.arrays import as_numbers
from guiderail.models.common.errors import InputError
from guiderail.models.control.wrench import MAX_WRENCH_SIZE, approach_bound
from guiderail.systems.support import declarations as declare
from guiderail.systems.support.declarations import input_getter, output_getter


class PhaseWrenchLimit(LeafSystem):
    """Output the wrench limit of a template's current state, with a bounded rate of change after a transition.

        b_k = b_{k-1} + s (B_q - b_{k-1}),  with the largest s <= 1 such that |b_k - b_{k-1}| <= r h

    B_q is the limit of state q, r the largest rate and h the period. The rate of decreases is bounded as well, because
    the force would jump after a sudden decrease of the limit. An episode begins with the limit of its first state. If
    ``state`` is not the number of a state, B_q is the element-wise minimum of the limits of all states.

    .. pydrake_system::

        name: PhaseWrenchLimit
        input_ports:
        - state
        - max_wrench (optional)
        output_ports:
        - phase_max_wrench

    ``state`` is (1,), the number of the state. ``max_wrench`` and ``phase_max_wrench`` are (8,), the limits of
    [fx fy fz tx ty tz], of the norm of the force and of the norm of the torque [N, Nm]. ``max_wrench`` is the limit of
    the task, whose changes apply at once. The output is the element-wise minimum of b and ``max_wrench``.

    Args:
        limits: Limits of the n states (n, 8) [N, Nm], finite and not negative.
        max_rate: Largest rates of change (8,) [N/s, Nm/s], positive, finite.
        period: Sampling period [s], positive.

    Raises:
        InputError: If an argument is out of range.
    """

    def __init__(self, limits: np.ndarray, max_rate: np.ndarray, *, period: float):
        super().__init__()
        declare.check_period(period)
        self._limits, rate = as_numbers(limits, "limits"), as_numbers(max_rate, "max_rate")
        if self._limits.ndim != 2 or not len(self._limits) or self._limits.shape[1] != MAX_WRENCH_SIZE:
            raise InputError(
                f"the wrench limits of n states must have the shape (n, {MAX_WRENCH_SIZE}), not {self._limits.shape}"
            )
        if not ((self._limits >= 0.0) & (self._limits < np.inf)).all():
            raise InputError("the wrench limits of states must be finite and not negative")
        if rate.shape != (MAX_WRENCH_SIZE,) or not ((rate > 0.0) & (rate < np.inf)).all():
            raise InputError(
                f"the rates of wrench limits must be {MAX_WRENCH_SIZE} positive, finite numbers, not {max_rate}"
            )
        self._max_change = rate * period
        self._state_port = self.DeclareVectorInputPort("state", 1)
        self._max_wrench_port = self.DeclareVectorInputPort("max_wrench", MAX_WRENCH_SIZE)
        # NaN until the first update: the state at the port is initialized at the same instant as this system.
        self._bound = self.DeclareDiscreteState(np.full(MAX_WRENCH_SIZE, np.nan))
        sources = [self._state_port, self._max_wrench_port, self._bound]
        declare.output(self, "phase_max_wrench", MAX_WRENCH_SIZE, self._phase_max_wrench, sources)
        declare.update(self, period, self._update, declare.reset_to_default(self))

    get_state_input_port = input_getter("state", "number of the template's state, (1,)")
    get_max_wrench_input_port = input_getter("max_wrench", "wrench limit of the task, (8,); optional")
    get_phase_max_wrench_output_port = output_getter("phase_max_wrench", "limit in the present state, (8,)")

    def _limit(self, context: Context) -> np.ndarray:
        """Return the limit of the state at the port, (8,)."""
        state = declare.state_number(self._state_port, context, len(self._limits))
        return self._limits.min(axis=0) if state is None else self._limits[state]

    def _present(self, context: Context) -> np.ndarray:
        bound = context.get_discrete_state().value(self._bound)
        return self._limit(context) if np.isnan(bound).any() else bound

    def _phase_max_wrench(self, context: Context) -> np.ndarray:
        bound = self._present(context)
        if self._max_wrench_port.HasValue(context):
            bound = np.minimum(bound, self._max_wrench_port.Eval(context))
        return bound

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        bound = approach_bound(self._present(context), self._limit(context), self._max_change)
        discrete_state.set_value(self._bound, bound)
