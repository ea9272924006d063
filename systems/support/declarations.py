"""Declarations that systems share: checked arguments, ports and their getters, states, updates and cache entries."""

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

from guiderail.models.common.arrays import as_number, is_finite
from guiderail.models.common.errors import InputError


class SignalPorts:
    """Vector input ports of a system, one per signal name.

    Args:
        system: System under construction; ports are declared in the order in which names first appear.
        signals: Mappings from name to size, at least 1. Equal names share one port.

    Raises:
        InputError: If a signal has two sizes.
    """

    def __init__(self, system: LeafSystem, *signals: Mapping[str, int]):
        sizes: dict[str, int] = {}
        for name, size in (item for mapping in signals for item in mapping.items()):
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
    """Return the port of the signal `name`; a method of systems that store `SignalPorts` as `_signals`."""
    return self._signals.port(name)


def check_signature(function: Callable[..., Any], signals: Mapping[str, int], what: str) -> None:
    """Check that a function can be called with the signals as keyword arguments.

    Args:
        function: Function of a reward term or a termination term.
        signals: Sizes of its signals by name.
        what: Name of the term for messages.

    Raises:
        InputError: If `function` does not accept these arguments.
    """
    try:
        accepted = signature(function)
    except (ValueError, TypeError):
        return  # functions written in C may have no signature
    try:
        accepted.bind(**dict.fromkeys(signals))
    except TypeError:
        raise InputError(
            f"{what} is called with the keyword arguments ({', '.join(signals)}), but its function has the parameters "
            f"({', '.join(accepted.parameters)}): give its inputs the names of the parameters"
        ) from None


def check_period(period: float) -> None:
    """Raise an `InputError` unless the period [s] is a positive and finite number."""
    if not 0.0 < as_number(period, "a system's period") < np.inf:
        raise InputError(f"a system's period must be positive and finite, not {period} s")


Source: TypeAlias = InputPort | CacheEntry | DiscreteStateIndex | DependencyTicket
"""Input port, state or cache entry from which an output or a cache entry is computed."""


def tickets(system: LeafSystem, sources: Iterable[Source]) -> set[DependencyTicket]:
    """Return the dependency tickets of sources of a system."""

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
    """Declare a vector output port; `value` computes its numbers (size,) from `sources`."""

    def calc(context: Context, vector: BasicVector) -> None:
        vector.SetFromVector(value(context))

    return system.DeclareVectorOutputPort(name, size, calc, prerequisites_of_calc=tickets(system, sources))


def abstract_output(
    system: LeafSystem,
    name: str,
    model: AbstractValue,
    value: Callable[[Context], object],
    sources: Iterable[Source],
) -> OutputPort:
    """Declare an abstract output port of the type of `model`; `value` computes its value from `sources`."""

    def calc(context: Context, output_value: AbstractValue) -> None:
        output_value.set_value(value(context))

    return system.DeclareAbstractOutputPort(
        name, alloc=model.Clone, calc=calc, prerequisites_of_calc=tickets(system, sources)
    )


def scalar_output(
    system: LeafSystem, name: str, value: Callable[[Context], float], sources: Iterable[Source]
) -> OutputPort:
    """Declare a vector output port (1,); `value` computes its number from `sources`."""

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
    """Declare a vector output port for a part of a cache entry or a discrete state.

    `part` maps the value of `source` to an array (size,). Without `size`, it returns a number, and the port is (1,).
    """
    is_state = isinstance(source, DiscreteStateIndex)

    def calc(context: Context, vector: BasicVector) -> None:
        whole = context.get_discrete_state().value(source) if is_state else source.Eval(context)
        if size is None:
            vector.SetAtIndex(0, part(whole))
        else:
            vector.SetFromVector(part(whole))

    return system.DeclareVectorOutputPort(name, size or 1, calc, prerequisites_of_calc=tickets(system, [source]))


def check_own_context(system: LeafSystem, context: Context) -> None:
    """Raise an `InputError` unless a context is that of the system, and not of a diagram around it.

    In the context of a diagram, a parameter's index would be that of another system.
    """
    try:
        system.ValidateContext(context)
    except RuntimeError:
        raise InputError(
            f"the context is not that of '{system.get_name()}': pass system.GetMyMutableContextFromRoot(root_context)"
        ) from None


def start_pose(pose: np.ndarray) -> np.ndarray:
    """Check the measured pose (O,) at initialization and return it; it is the first command of a motion.

    Raises:
        InputError: If the pose is not finite.
    """
    if not is_finite(pose):
        raise InputError(f"the first command is the measured pose: the measured pose must be finite, not {pose}")
    return np.asarray(pose)


def unset_state(system: LeafSystem, size: int) -> DiscreteStateIndex:
    """Declare and return a discrete state (size,) that an initialization sets; until then it is NaN.

    A context that was restored or randomized without an initialization must not command zeros: read the state with
    `initialized`.
    """
    return system.DeclareDiscreteState(np.full(size, np.nan))


def initialized(system: LeafSystem, context: Context, state: DiscreteStateIndex) -> np.ndarray:
    """Return the value of an `unset_state`.

    Raises:
        InputError: If no initialization has set the state.
    """
    value = context.get_discrete_state().value(state)
    if np.isnan(value).all():
        raise InputError(
            f"the {type(system).__name__} '{system.get_name()}' has no start: call Simulator.Initialize() after a "
            "context was created, randomized or restored from its defaults"
        )
    return value


def update(
    system: LeafSystem,
    period: float,
    calc: Callable[[Context, DiscreteValues], Any],
    reset: Callable[[Context, DiscreteValues], Any] | None = None,
) -> None:
    """Declare the periodic update `calc` of the discrete state, every `period` [s], and a `reset` at initialization."""
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
    """Return True after the time of the last initialization; `start` is the system's `start_time`.

    Drake also triggers periodic events at the time of initialization, when no step has ended yet. An event offset of
    one period cannot avoid this: period + k * period differs from (k + 1) * period in the last bit for about a quarter
    of all k.
    """
    return bool(context.get_time() > context.get_discrete_state().value(start).item() + _TIME_TOLERANCE)


def start_step(context: Context, start: DiscreteStateIndex, period: float) -> int:
    """Return the number of the control step in which a system was initialized; step 0 starts at time zero.

    `start` is the system's `start_time`, and `period` is the control period [s].
    """
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
        Discrete state of the `start_time`. It is a further group of the discrete state, so that a system with another
        group must access the groups by their indices.
    """

    def calc_after_start(context: Context, discrete_state: DiscreteValues) -> Any:
        return calc(context, discrete_state) if has_started(context, start) else EventStatus.DidNothing()

    update(system, period, calc_after_start, reset)
    start = start_time(system)  # declared after the reset, which may restore the defaults of all states
    return start


def reset_to_default(system: LeafSystem) -> Callable[[Context, DiscreteValues], None]:
    """Return a reset that sets all discrete states to their defaults."""
    return lambda context, discrete_state: discrete_state.SetFrom(system.AllocateDiscreteVariables())


def sample(system: LeafSystem, port: InputPort, period: float) -> DiscreteStateIndex:
    """Declare a discrete state that samples a vector input port, at initialization and every `period` [s]."""
    state = system.DeclareDiscreteState(port.size())

    def calc(context: Context, discrete_state: DiscreteValues) -> None:
        discrete_state.set_value(state, port.Eval(context))

    update(system, period, calc, calc)
    return state


def cache(system: LeafSystem, name: str, calc: Callable[[Context], object], sources: Iterable[Source]) -> CacheEntry:
    """Declare a cache entry; `calc` computes its value from `sources`, and `name` is its description."""
    return cache_entry(system, name, lambda context, value: value.set_value(calc(context)), sources)


def cache_entry(
    system: LeafSystem, name: str, calc: Callable[[Context, AbstractValue], object], sources: Iterable[Source]
) -> CacheEntry:
    """Declare a cache entry, as `cache`; `calc` has Drake's signature and sets the value, in one frame of the stack."""
    producer = ValueProducer(allocate=Value[object], calc=calc)
    return system.DeclareCacheEntry(name, producer, prerequisites_of_calc=tickets(system, sources))


def plant_context(
    system: LeafSystem, plant: MultibodyPlant, state: Callable[[Context], np.ndarray], sources: Iterable[Source]
) -> CacheEntry:
    """Declare a cache entry with a context of a finalized plant, for computing kinematics and inertia.

    `state` computes the joint positions, or the positions followed by the velocities, from `sources`. If one of these
    numbers is not finite, the evaluation of the entry raises an `InputError`.
    """
    num_positions = plant.num_positions()

    def calc(context: Context, value: AbstractValue) -> None:
        numbers, plant_context = state(context), value.get_mutable_value()
        if not is_finite(numbers):  # Drake would abort the process
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
    """Return a method of a system that returns the input port `name`.

    `description` states signal, shape and unit. The method's docstring is "Return the port of the" with `description`.
    """

    def getter(self: System) -> InputPort:
        return self.GetInputPort(name)

    getter.__name__, getter.__doc__ = f"get_{name}_input_port", f"Return the port of the {description}."
    return getter


def output_getter(name: str, description: str) -> Callable[[System], OutputPort]:
    """Return a method of a system that returns the output port `name`; see `input_getter`."""

    def getter(self: System) -> OutputPort:
        return self.GetOutputPort(name)

    getter.__name__, getter.__doc__ = f"get_{name}_output_port", f"Return the port of the {description}."
    return getter


def state_number(port: InputPort, context: Context, count: int) -> int | None:
    """Return the state number of a template at an input port (1,), or None if it is not the number of a state.

    The numbers of the `count` states begin at 0.
    """
    number = float(port.Eval(context)[0])
    return int(number) if 0.0 <= number < count and number.is_integer() else None


class ReadFlag:
    """Flag in the cache of a context: True if an output was computed since the last initialization.

    A system has no access to the diagram that it is a part of. But systems that follow a limit evaluate it in their own
    initialization (`LastValidBound`), so that an output that was not computed then is not connected to any of them.

    Args:
        system: System under construction, in which a cache entry and an event are declared.
    """

    def __init__(self, system: LeafSystem):
        self._entry = cache(system, "is_read", lambda context: True, [system.nothing_ticket()])
        # Initialization updates of the abstract state precede those of the discrete state, in which outputs are read.
        system.DeclareInitializationUnrestrictedUpdateEvent(
            lambda context, state: context.SetAllCacheEntriesOutOfDate()
        )

    def marked(self, context: Context, value: np.ndarray) -> np.ndarray:
        """Set the flag and return `value`, in the computation of the output."""
        self._entry.Eval(context)
        return value

    def is_set(self, context: Context) -> bool:
        """Return True if the output was computed since the last initialization."""
        return not self._entry.is_out_of_date(context)
