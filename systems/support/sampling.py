"""Check of periods, and inputs sampled once per control period."""

import numpy as np
from pydrake.systems.framework import Context, DiscreteStateIndex, DiscreteValues, InputPort, LeafSystem

from guiderail.models.common.errors import InputError


def check_period(period: float) -> None:
    """Raise an InputError if the period [s] is not positive and finite.

    Raises:
        InputError: See above.
    """
    if not 0.0 < period < np.inf:
        raise InputError(f"a system's period must be positive and finite, not {period} s")


def declare_sample(system: LeafSystem, port: InputPort, period: float) -> DiscreteStateIndex:
    """Declare a discrete state that contains `port`, sampled at initialization and once per period.

    Args:
        system: System under construction.
        port: Its vector input port.
        period: Sampling period [s].

    Returns:
        Index of the discrete state.

    Raises:
        InputError: If the period is not positive and finite.
    """
    check_period(period)
    state = system.DeclareDiscreteState(port.size())

    def sample(context: Context, discrete_state: DiscreteValues) -> None:
        discrete_state.set_value(state, port.Eval(context))

    system.DeclareInitializationDiscreteUpdateEvent(sample)
    system.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, sample)
    return state
