"""Wrench bound of an impedance that an input port lowers at run time."""

from contextlib import suppress

import numpy as np
from pydrake.systems.framework import Context, DiscreteValues, InputPort, LeafSystem

from guiderail.models.common.errors import InputError
from guiderail.models.control.wrench import MAX_WRENCH_SIZE, WrenchBound
from guiderail.systems.support import declarations as declare


class LastValidBound:
    """Configured wrench bound, lowered to the numbers at an optional input port.

    While a number at the port is NaN or negative, its last valid value applies, or 0 before the first valid value. An
    invalid number is not replaced by 0, because a bound of 0 also disables damping, and a moving arm would coast. The
    last valid numbers are a discrete state, which a periodic event updates.

    Args:
        system: System under construction, in which a state and two events are declared.
        bound: Configured bound.
        max_wrench: Input port of the numbers, (8,) [N, Nm]; if it is not connected, the configured bound applies.
        period: Sampling period of the numbers [s], positive.

    Attributes:
        sources: Sources of `eval`, for the declaration of outputs and cache entries.
    """

    def __init__(self, system: LeafSystem, bound: WrenchBound, max_wrench: InputPort, *, period: float):
        self._bound, self._max_wrench = bound, max_wrench
        self._last = system.DeclareDiscreteState(MAX_WRENCH_SIZE)
        self.sources: list[declare.Source] = [max_wrench, self._last]
        declare.update(system, period, self._update, self._reset)

    def eval(self, context: Context) -> WrenchBound:
        """Return the present bound; `context` is the context of the system."""
        if not self._max_wrench.HasValue(context):
            return self._bound
        return self._bound.lowered_to(self._numbers(context, context.get_discrete_state().value(self._last)))

    def _numbers(self, context: Context, last: np.ndarray) -> np.ndarray:
        numbers = self._max_wrench.Eval(context)
        is_valid = numbers >= 0.0  # False for NaN
        return numbers if is_valid.all() else np.where(is_valid, numbers, last)

    def _reset(self, context: Context, discrete_state: DiscreteValues) -> None:
        numbers = np.zeros(MAX_WRENCH_SIZE)
        # All systems initialize at once, and the port may depend on one that has no start yet. The first evaluation
        # after the initialization raises all other errors again. `HasValue` evaluates the port.
        with suppress(InputError):
            if not self._max_wrench.HasValue(context):
                return
            numbers = self._numbers(context, numbers)
        discrete_state.set_value(self._last, numbers)

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        if self._max_wrench.HasValue(context):
            last = context.get_discrete_state().value(self._last)
            discrete_state.set_value(self._last, self._numbers(context, last))
