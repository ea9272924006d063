"""Declarations that systems share: periods, samples, cache entries, and ports with their getters."""

from collections.abc import Callable, Iterable, Mapping
from inspect import signature
from typing import Any

import numpy as np
from pydrake.common.value import Value
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import (
    CacheEntry,
    Context,
    DependencyTicket,
    DiscreteStateIndex,
    DiscreteValues,
    InputPort,
    LeafSystem,
    OutputPort,
    System,
    ValueProducer,
)

from guiderail.models.common.errors import InputError


class SignalPorts:
    """Vector input ports of a system, one per signal named in a constructor argument.

    Args:
        system: System under construction; ports are declared in the order in which names first appear.
        signals: Mappings from name to size, at least 1. Equal names share one port.

    Raises:
        InputError: If a size is below 1, or a signal has two sizes.
    """

    def __init__(self, system: LeafSystem, *signals: Mapping[str, int]):
        sizes: dict[str, int] = {}
        for name, size in (item for mapping in signals for item in mapping.items()):
            if size < 1:
                raise InputError(f"signal '{name}' needs a size of at least 1, not {size}")
            if sizes.setdefault(name, size) != size:
                raise InputError(f"signal '{name}' can't be of size {sizes[name]} and {size}: give it one size")
        self._ports = {name: system.DeclareVectorInputPort(name, size) for name, size in sizes.items()}

    @property
    def tickets(self) -> set[DependencyTicket]:
        """Tickets of all ports."""
        return {port.ticket() for port in self._ports.values()}

    def port(self, name: str) -> InputPort:
        """Return the port of the signal `name`.

        Raises:
            InputError: If there is no such signal.
        """
        if name not in self._ports:
            raise InputError(f"there is no signal '{name}', only {', '.join(self._ports) or 'none at all'}")
        return self._ports[name]

    def eval(self, context: Context) -> dict[str, np.ndarray]:
        """Return the values of all signals by name; `context` is the context of the system."""
        return {name: port.Eval(context) for name, port in self._ports.items()}


def check_takes(function: Callable[..., Any], names: Iterable[str], what: str) -> None:
    """Raise an `InputError` if a function does not accept `names` as keyword arguments; `what` describes it."""
    try:
        takes = signature(function)
    except (ValueError, TypeError):
        return  # functions written in C may have no signature
    names = list(names)
    try:
        takes.bind(**dict.fromkeys(names))
    except TypeError:
        raise InputError(
            f"{what} is called with its signals by name, {', '.join(names) or 'none'}, and takes "
            f"{', '.join(takes.parameters) or 'none'}: give its function and its inputs the same names"
        ) from None


def check_period(period: float) -> None:
    """Raise an `InputError` unless the period [s] is positive and finite."""
    if not 0.0 < period < np.inf:
        raise InputError(f"a system's period must be positive and finite, not {period} s")


def declare_sample(system: LeafSystem, port: InputPort, period: float) -> DiscreteStateIndex:
    """Declare a discrete state that contains a vector input port, sampled at initialization and once per period [s].

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


def declare_cache(
    system: LeafSystem,
    name: str,
    calc: Callable[[Context], object],
    *,
    prerequisites_of_calc: set[DependencyTicket],
) -> CacheEntry:
    """Declare a cache entry with a value that `calc` computes from the system's context.

    Its name is a description. `prerequisites_of_calc` are the tickets of the values that `calc` reads.
    """
    return system.DeclareCacheEntry(
        description=name,
        value_producer=ValueProducer(
            allocate=Value[object], calc=lambda context, value: value.set_value(calc(context))
        ),
        prerequisites_of_calc=prerequisites_of_calc,
    )


def declare_plant_context(
    system: LeafSystem,
    plant: MultibodyPlant,
    set_state: Callable[[Context, Context], None],
    *,
    prerequisites_of_calc: set[DependencyTicket],
) -> CacheEntry:
    """Declare a cache entry that contains a context of the finalized plant, for its kinematics and inertia.

    `set_state` writes the plant's state, given the system's context and the plant's context. It reads the values of
    `prerequisites_of_calc`.
    """
    return system.DeclareCacheEntry(
        description="plant_context",
        value_producer=ValueProducer(
            allocate=lambda: Value(plant.CreateDefaultContext()),
            calc=lambda context, value: set_state(context, value.get_mutable_value()),
        ),
        prerequisites_of_calc=prerequisites_of_calc,
    )


def input_getter(name: str, description: str) -> Callable[[System], InputPort]:
    """Return a method that returns the input port `name`, which a system or diagram stores as `_<name>_port`.

    The description has signal, shape and unit, for the method's docstring.
    """

    def getter(self: System) -> InputPort:
        port = getattr(self, f"_{name}_port", None)
        return self.GetInputPort(name) if port is None else port

    getter.__name__, getter.__doc__ = f"get_{name}_input_port", f"Return the port of the {description}."
    return getter


def output_getter(name: str, description: str) -> Callable[[System], OutputPort]:
    """Return a method that returns the output port `name`; see `input_getter`."""

    def getter(self: System) -> OutputPort:
        port = getattr(self, f"_{name}_port", None)
        return self.GetOutputPort(name) if port is None else port

    getter.__name__, getter.__doc__ = f"get_{name}_output_port", f"Return the port of the {description}."
    return getter
