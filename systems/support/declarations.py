"""Declarations that systems share: periods, samples, cache entries, and ports with their getters."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from inspect import signature
from typing import Any, TypeAlias

import numpy as np
from pydrake.common.value import AbstractValue, Value
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import (
    BasicVector,
    CacheEntry,
    Context,
    DependencyTicket,
    DiscreteStateIndex,
    DiscreteValues,
    EventStatus,
    InputPort,
    LeafSystem,
    OutputPort,
    System,
    ValueProducer,
)

from guiderail.models.common.arrays import as_number, as_whole, is_finite, is_whole
from guiderail.models.common.errors import InputError, brief


class SignalPorts:
    """Vector input ports of a system, one per signal name.

    Args:
        system: System under construction; ports are declared in the order in which names first appear.
        signals: Mappings from name to size, at least 1. Equal names share one port.

    Raises:
        InputError: If a name is empty, a size is not a whole number of at least 1, or a signal has two sizes.
    """

    def __init__(self, system: LeafSystem, *signals: Mapping[str, int]):
        sizes: dict[str, int] = {}
        for mapping in signals:
            if not isinstance(mapping, Mapping):
                raise InputError(f"signals are sizes by name, such as {{'pose': 6}}, not {brief(mapping)}")
        for name, size in (item for mapping in signals for item in mapping.items()):
            if not (isinstance(name, str) and name):
                raise InputError(f"a signal needs a name, not {brief(name)}")
            size = as_whole(size, f"the size of signal '{name}'")
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


def get_signal_input_port(self: Any, name: str) -> InputPort:
    """Return the port of the signal `name`; a method of systems that store `SignalPorts` as `_signals`.

    Raises:
        InputError: If there is no such signal.
    """
    return self._signals.port(name)


def check_terms(terms: Sequence[Any], kind: type, owner: str) -> None:
    """Raise an `InputError` unless `terms` are a sequence of a `kind` of terms; `owner` has the terms."""
    if not isinstance(terms, Sequence) or not all(isinstance(term, kind) for term in terms):
        raise InputError(f"{owner} needs a list of {kind.__name__} objects, not {brief(terms)}")


def check_takes(function: Callable[..., Any], names: Mapping[str, int], what: str) -> None:
    """Raise an `InputError` if a function does not accept `names` as keyword arguments; `what` names the function.

    It also raises one if `function` is no function, or `names` are not the keys of a mapping from signal to size.
    """
    if not callable(function):
        raise InputError(f"{what} needs a function of its signals, not {brief(function)}")
    if not isinstance(names, Mapping):
        raise InputError(f"{what} needs the sizes of its signals by name, such as {{'pose': 6}}, not {brief(names)}")
    try:
        takes = signature(function)
    except (ValueError, TypeError):
        return  # functions written in C may have no signature
    try:
        takes.bind(**dict.fromkeys(names))
    except TypeError:
        raise InputError(
            f"{what} is called with the keyword arguments ({', '.join(names)}), but its function has the parameters "
            f"({', '.join(takes.parameters)}): give its inputs the names of the parameters"
        ) from None


def check_period(period: float) -> None:
    """Raise an `InputError` unless the period [s] is a positive and finite number."""
    if not 0.0 < as_number(period, "a system's period") < np.inf:
        raise InputError(f"a system's period must be positive and finite, not {period} s")


def seed_parameter(seed: object) -> list[float]:
    """Return a seed as the value of a numeric parameter (1,).

    Raises:
        InputError: If it is not a whole number of at least 0.
    """
    if not is_whole(seed, 0):
        raise InputError(f"a seed is a whole number of at least 0, not {brief(seed)}")
    return [float(as_whole(seed, "a seed"))]


Source: TypeAlias = InputPort | CacheEntry | DiscreteStateIndex | DependencyTicket
"""Value that an output or a cache entry is computed from."""


def tickets(system: LeafSystem, sources: Iterable[Source]) -> set[DependencyTicket]:
    """Return the dependency tickets of a system's sources; tickets among them are returned unchanged."""

    def ticket(source: Source) -> DependencyTicket:
        if isinstance(source, DiscreteStateIndex):
            return system.discrete_state_ticket(source)
        return source if isinstance(source, DependencyTicket) else source.ticket()

    return {ticket(source) for source in sources}


def output(
    system: LeafSystem,
    name: str,
    size: int,
    value: Callable[[Context], np.ndarray | Sequence[float]],
    sources: Iterable[Source],
) -> OutputPort:
    """Declare a vector output port with the `value` (size,) that is computed from `sources`."""

    def calc(context: Context, vector: BasicVector) -> None:
        vector.SetFromVector(value(context))

    return system.DeclareVectorOutputPort(name, size, calc, prerequisites_of_calc=tickets(system, sources))


def scalar_output(
    system: LeafSystem, name: str, value: Callable[[Context], float], sources: Iterable[Source]
) -> OutputPort:
    """Declare a vector output port (1,) with the `value` that is computed from `sources`."""

    def calc(context: Context, vector: BasicVector) -> None:
        vector.SetAtIndex(0, value(context))

    return system.DeclareVectorOutputPort(name, 1, calc, prerequisites_of_calc=tickets(system, sources))


def part_output(
    system: LeafSystem,
    name: str,
    source: CacheEntry | DiscreteStateIndex,
    part: Callable[[Any], Any],
    size: int | None = None,
) -> OutputPort:
    """Declare a vector output port with a part of the value of a cache entry or a discrete state.

    `part` returns an array (size,) of this value; without a size, it returns a number and the port is (1,).
    """

    def value_of_state(context: Context) -> Any:
        return part(context.get_discrete_state().value(source))

    def value_of_cache(context: Context) -> Any:
        return part(source.Eval(context))

    value = value_of_state if isinstance(source, DiscreteStateIndex) else value_of_cache
    if size is None:
        return scalar_output(system, name, value, [source])
    return output(system, name, size, value, [source])


def start_pose(pose: np.ndarray) -> np.ndarray:
    """Return the measured pose (O,), which is the first command of a motion.

    Raises:
        InputError: If the pose is not finite.
    """
    if not is_finite(pose):
        raise InputError(f"the first command is the measured pose: the measured pose must be finite, not {pose}")
    return np.asarray(pose)


def update(
    system: LeafSystem,
    period: float,
    calc: Callable[[Context, DiscreteValues], Any],
    reset: Callable[[Context, DiscreteValues], Any] | None = None,
) -> None:
    """Declare the update `calc` of the discrete state once per period [s], and an optional reset at initialization.

    Raises:
        InputError: If the period is not positive and finite.
    """
    check_period(period)
    if reset is not None:
        system.DeclareInitializationDiscreteUpdateEvent(reset)
    system.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, calc)


_TIME_TOLERANCE = 1e-9  # tolerance of the start time [s]: above rounding errors after days, below any period


def start_time(system: LeafSystem) -> DiscreteStateIndex:
    """Declare and return a discrete state (1,) with the time of the last initialization [s]; see `has_started`."""
    state = system.DeclareDiscreteState(1)

    def calc(context: Context, discrete_state: DiscreteValues) -> None:
        discrete_state.set_value(state, [context.get_time()])

    system.DeclareInitializationDiscreteUpdateEvent(calc)
    return state


def has_started(context: Context, start: DiscreteStateIndex) -> bool:
    """Return False at the time of initialization, when no step has ended; `start` is a system's `start_time`.

    Drake triggers the periodic events of the time of initialization, too. An event offset of one period cannot be used:
    period + k * period differs from (k + 1) * period in the last bit for about a quarter of all k.
    """
    return bool(context.get_time() > context.get_discrete_state().value(start).item() + _TIME_TOLERANCE)


def start_step(context: Context, start: DiscreteStateIndex, period: float) -> int:
    """Return the number of the control step of a `period` [s], counted from time zero, in which a system started."""
    time = context.get_discrete_state().value(start).item()
    return math.floor((time + _TIME_TOLERANCE) / period)


def update_after_start(
    system: LeafSystem,
    period: float,
    calc: Callable[[Context, DiscreteValues], Any],
    reset: Callable[[Context, DiscreteValues], Any] | None = None,
) -> DiscreteStateIndex:
    """Declare an `update` that is omitted at the time of initialization, when no step has ended.

    Returns:
        State with the `start_time`, a further group of the discrete state: read the other groups by their indices.

    Raises:
        InputError: If the period is not positive and finite.
    """

    def calc_after_start(context: Context, discrete_state: DiscreteValues) -> Any:
        return calc(context, discrete_state) if has_started(context, start) else EventStatus.DidNothing()

    update(system, period, calc_after_start, reset)
    start = start_time(system)  # after the reset, which may restore the default of every state
    return start


def reset_to_default(system: LeafSystem) -> Callable[[Context, DiscreteValues], None]:
    """Return a reset that restores the defaults of the discrete states."""
    return lambda context, discrete_state: discrete_state.SetFrom(system.AllocateDiscreteVariables())


def sample(system: LeafSystem, port: InputPort, period: float) -> DiscreteStateIndex:
    """Declare and return a discrete state with samples of a vector port, at initialization and once per period [s].

    Raises:
        InputError: If the period is not positive and finite.
    """
    state = system.DeclareDiscreteState(port.size())

    def calc(context: Context, discrete_state: DiscreteValues) -> None:
        discrete_state.set_value(state, port.Eval(context))

    update(system, period, calc, calc)
    return state


def cache(system: LeafSystem, name: str, calc: Callable[[Context], object], sources: Iterable[Source]) -> CacheEntry:
    """Declare a cache entry with the description `name` and the value that `calc` computes from `sources`."""
    return system.DeclareCacheEntry(
        description=name,
        value_producer=ValueProducer(
            allocate=Value[object], calc=lambda context, value: value.set_value(calc(context))
        ),
        prerequisites_of_calc=tickets(system, sources),
    )


def plant_context(
    system: LeafSystem, plant: MultibodyPlant, state: Callable[[Context], np.ndarray], sources: Iterable[Source]
) -> CacheEntry:
    """Declare a cache entry with a context of the finalized plant, from which kinematics and inertia are computed.

    `state` computes the joint positions, or the positions followed by the velocities, from `sources`. An evaluation
    with numbers that are not finite raises an `InputError`.
    """
    num_positions = plant.num_positions()

    def calc(context: Context, value: AbstractValue) -> None:
        numbers, plant_context = state(context), value.get_mutable_value()
        if not is_finite(numbers):  # Drake would end the process
            raise InputError(f"joint positions and velocities must be finite, not {numbers}")
        if len(numbers) == num_positions:
            plant.SetPositions(plant_context, numbers)
        else:
            plant.SetPositionsAndVelocities(plant_context, numbers)

    return system.DeclareCacheEntry(
        description="plant_context",
        value_producer=ValueProducer(allocate=lambda: Value(plant.CreateDefaultContext()), calc=calc),
        prerequisites_of_calc=tickets(system, sources),
    )


def input_getter(name: str, description: str) -> Callable[[System], InputPort]:
    """Return a method of a system that returns the input port `name`, stored as `_<name>_port` or found by name.

    The method's docstring is "Return the port of the", followed by `description`, which states signal, shape and unit.
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


def state_number(port: InputPort, context: Context, count: int) -> int | None:
    """Return the number of a template's state at a port (1,), or None if it is not one of `count` states."""
    number = float(port.Eval(context)[0])
    return int(number) if 0.0 <= number < count and number.is_integer() else None
