"""Wrench limits that change with the state of a shared control template."""

from contextlib import suppress

import numpy as np
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from guiderail.models.common.arrays import as_numbers
from guiderail.models.common.errors import InputError
from guiderail.models.control.wrench import MAX_WRENCH_SIZE, approach_bound
from guiderail.systems.support import declarations as declare
from guiderail.systems.support.declarations import input_getter, output_getter
from guiderail.systems.support.required_output import ReadFlag


class PhaseWrenchLimit(LeafSystem):
    """Output the wrench limit of a template's current state, with a bounded rate of change after a transition.

        b_k = b_{k-1} + s (B_q - b_{k-1}),  with the largest s <= 1 such that |b_k - b_{k-1}| <= r h

    B_q is the element-wise minimum of the bound of the robot and the limit of state q, r the largest rate and h the
    period. The rate of decreases is bounded as well, because the force would jump after a sudden decrease of the limit.
    An episode begins with the limit of its first state. While a number of the limit is NaN or negative, that of b is
    constant, or 0 before the first valid number.

    All ports are (8,), the limits of [fx fy fz tx ty tz], of the norm of the force and of the norm of the torque
    [N, Nm]. ``state_max_wrench`` is the limit of the state, the output ``max_wrench`` of an `SctStateMachine`.
    ``max_wrench`` is the limit of the task, whose changes apply at once. The output is the element-wise minimum of b
    and ``max_wrench``.

    Args:
        bound: Bound of the robot (8,) [N, Nm], finite and not negative, which applies in states without limits.
        max_rate: Largest rates of change (8,) [N/s, Nm/s], positive, finite.
        period: Sampling period [s], positive.

    Raises:
        InputError: If an argument is out of range. Two periods after the initialization, if nothing has read
            ``phase_max_wrench``.
    """

    def __init__(self, bound: np.ndarray, max_rate: np.ndarray, *, period: float):
        super().__init__()
        self._max_bound, rate = as_numbers(bound, "bound"), as_numbers(max_rate, "max_rate")
        is_allowed = (self._max_bound >= 0.0) & (rate > 0.0) & np.isfinite(self._max_bound) & np.isfinite(rate)
        if is_allowed.shape != (MAX_WRENCH_SIZE,) or not is_allowed.all():
            raise InputError(f"wrench limits need eight finite bounds and rates, not {bound} and {max_rate}")
        self._max_change = rate * period
        self._limit_port = self.DeclareVectorInputPort("state_max_wrench", MAX_WRENCH_SIZE)
        self._max_wrench_port = self.DeclareVectorInputPort("max_wrench", MAX_WRENCH_SIZE)
        # NaN until the first update: the source of the limit is initialized at the same instant as this system.
        self._bound = self.DeclareDiscreteState(np.full(MAX_WRENCH_SIZE, np.nan))
        self._read = ReadFlag(self)
        sources = [self._limit_port, self._max_wrench_port, self._bound]
        declare.output(self, "phase_max_wrench", MAX_WRENCH_SIZE, self._phase_max_wrench, sources)
        declare.update(self, period, self._update, self._reset)

    get_state_max_wrench_input_port = input_getter("state_max_wrench", "limit of the template's state, (8,)")
    get_max_wrench_input_port = input_getter("max_wrench", "wrench limit of the task, (8,); optional")
    get_phase_max_wrench_output_port = output_getter("phase_max_wrench", "limit in the present state, (8,)")

    def _limit(self, context: Context) -> np.ndarray:
        """Return the limit B_q at the port, (8,)."""
        limit = self._limit_port.Eval(context)
        if not (is_valid := limit >= 0.0).all():  # False for NaN
            last = context.get_discrete_state().value(self._bound)
            limit = np.where(is_valid, limit, np.where(np.isnan(last), 0.0, last))
        return np.minimum(self._max_bound, limit)

    def _present(self, context: Context) -> np.ndarray:
        bound = context.get_discrete_state().value(self._bound)
        return self._limit(context) if np.isnan(bound).any() else bound

    def _phase_max_wrench(self, context: Context) -> np.ndarray:
        bound = self._present(context)
        if self._max_wrench_port.HasValue(context):
            bound = np.minimum(bound, self._max_wrench_port.Eval(context))
        return self._read.marked(context, bound)

    def _reset(self, context: Context, discrete_state: DiscreteValues) -> None:
        # A state machine requires that its limit is read, which systems after this one may do only later. All systems
        # initialize at once, and the source of the limit may have no start yet.
        with suppress(InputError):
            self._limit_port.Eval(context)
        discrete_state.set_value(self._bound, np.full(MAX_WRENCH_SIZE, np.nan))

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        is_first = np.isnan(context.get_discrete_state().value(self._bound)).any()
        if not is_first and not self._read.is_set(context):
            raise InputError(
                f"no controller follows the limit of '{self.get_name()}': connect its output phase_max_wrench to the "
                "controller's input max_wrench"
            )
        bound = approach_bound(self._present(context), self._limit(context), self._max_change)
        discrete_state.set_value(self._bound, bound)
