"""Control periods, and inputs that are sampled once in each."""

import numpy as np
from pydrake.systems.framework import Context, DiscreteStateIndex, DiscreteValues, EventStatus, InputPort, LeafSystem

from guiderail.models.common.errors import InputError


def check_period(period: float) -> None:
    """Refuses a period that no event can have.

    Args:
        period: [s].

    Raises:
        InputError: if it is not positive and finite.
    """
    if not 0.0 < period < np.inf:
        raise InputError(f"a system's period must be positive and finite, not {period} s")


def declare_sample(system: LeafSystem, port: InputPort, period: float) -> DiscreteStateIndex:
    """Declares a discrete state of `system` that holds `port`, sampled at initialization and once a period.

    Raises:
        InputError: if the period is not positive and finite.
    """
    check_period(period)
    state = system.DeclareDiscreteState(port.size())

    def sample(context: Context, discrete_state: DiscreteValues) -> EventStatus:
        discrete_state.set_value(state, port.Eval(context))
        return EventStatus.Succeeded()

    system.DeclareInitializationDiscreteUpdateEvent(sample)
    system.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, sample)
    return state
