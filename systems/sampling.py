"""What systems share that look at something once a control step."""

from pydrake.systems.framework import Context, DiscreteStateIndex, DiscreteValues, EventStatus, InputPort, LeafSystem


def check_period(period: float) -> None:
    """Refuses a control period that is none.

    Raises:
        ValueError: if it isn't positive.
    """
    if not period > 0:
        raise ValueError(f"the control period must be positive, not {period} s")


def declare_sample(system: LeafSystem, port: InputPort, period: float) -> DiscreteStateIndex:
    """Declares a state of `system`: what `port` was at the last control step, and at first at initialization.

    Raises:
        ValueError: if the period isn't positive.
    """
    check_period(period)
    state = system.DeclareDiscreteState(port.size())

    def sample(context: Context, discrete_state: DiscreteValues) -> EventStatus:
        discrete_state.set_value(state, port.Eval(context))
        return EventStatus.Succeeded()

    system.DeclareInitializationDiscreteUpdateEvent(sample)
    system.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, sample)
    return state
