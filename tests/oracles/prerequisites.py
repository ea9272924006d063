"""Comparison of cached outputs and updates with those of an empty cache, after changes of single sources."""

from collections.abc import Callable, Collection, Iterator, Mapping

import numpy as np
from pydrake.common.value import Value
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.math import SpatialAcceleration, SpatialForce, SpatialVelocity
from pydrake.systems.framework import Context, InputPort, LeafSystem, PortDataType
from pydrake.systems.sensors import ImageRgba8U

from guiderail.models.common.errors import InputError
from guiderail.models.primitives import UnsolvableError

Sampler = Callable[[np.random.Generator, int], np.ndarray]

SAMPLERS: dict[str, Sampler] = {
    "state": lambda rng, size: rng.integers(0, 3 if size == 1 else 2, size).astype(float),
    "max_wrench": lambda rng, size: rng.uniform(0.0, 0.2, size),
    "blend_factor": lambda rng, size: rng.integers(0, 2, size).astype(float),
    "history_length": lambda rng, size: rng.integers(1, 3, size).astype(float),
}
"""Samples of inputs by the name of the port, where small numbers of either sign would be refused or without effect."""


START = 5.0  # time of the updates [s], after the start time that a state may have
INVALID = 0.15  # share of vectors of NaN at input ports, for which many systems use their state
NUM_BODIES = 40  # entries of a list at an abstract port: at least the bodies and joints of a plant

LISTS: dict[type, Callable[[np.random.Generator], object]] = {
    RigidTransform: lambda rng: RigidTransform(RollPitchYaw(rng.uniform(-1.0, 1.0, 3)), rng.uniform(-1.0, 1.0, 3)),
    SpatialForce: lambda rng: SpatialForce(rng.uniform(-1.0, 1.0, 6)),
    SpatialAcceleration: lambda rng: SpatialAcceleration(rng.uniform(-1.0, 1.0, 6)),
    SpatialVelocity: lambda rng: SpatialVelocity(rng.uniform(-1.0, 1.0, 6)),
}
"""Samples of the entries of a list at an abstract port."""


def changed_outputs(
    system: LeafSystem,
    *,
    trials: int = 20,
    seed: int = 0,
    samplers: Mapping[str, Sampler] | None = None,
    inputs: Collection[str] | None = None,
) -> tuple[set[str], set[tuple[str, str]]]:
    """Change each input, parameter and state in turn; compare outputs and updates with those of an empty cache.

    Args:
        system: System to test.
        trials: Number of random contexts.
        seed: Seed of the contexts.
        samplers: Further samples of inputs by the name of the port.
        inputs: Names of the input ports that have a value; all of them by default.

    Returns:
        Descriptions of stale outputs, and pairs of a source and an output that changed with it.
    """
    rng, known = np.random.default_rng(seed), {**SAMPLERS, **(samplers or {})}
    stale: set[str] = set()
    effects: set[tuple[str, str]] = set()
    for _ in range(trials):
        context = system.CreateDefaultContext()
        context.SetTime(START)
        for _, change in _sources(system, context, rng, known, inputs):
            change()
        for name, change in _sources(system, context, rng, known, inputs):
            before = _outputs(system, context)
            change()
            cached = _outputs(system, context)
            context.SetAllCacheEntriesOutOfDate()
            for output, value in _outputs(system, context).items():
                if cached[output] != value:
                    stale.add(f"{output} of {type(system).__name__} does not depend on {name}")
                if before[output] != value:
                    effects.add((name, output))
    return stale, effects


def _sources(
    system: LeafSystem,
    context: Context,
    rng: np.random.Generator,
    samplers: Mapping[str, Sampler],
    inputs: Collection[str] | None,
) -> Iterator[tuple[str, Callable[[], object]]]:
    """Yield name and random change of every source of a context."""
    for i in range(system.num_input_ports()):
        port = system.get_input_port(i)
        if inputs is None or port.get_name() in inputs:
            yield port.get_name(), lambda port=port: _fix(system, port, context, rng, samplers)
    for i in range(context.num_numeric_parameter_groups()):
        default = system.CreateDefaultContext().get_numeric_parameter(i).CopyToVector()
        yield f"parameter {i}", lambda i=i, value=default: _set_parameter(context, i, value, rng)
    for i in range(context.num_discrete_state_groups()):
        size = context.get_discrete_state(i).size()
        yield f"state {i}", lambda i=i, n=size: context.SetDiscreteState(i, _sample_state(rng, n))


def _sample_state(rng: np.random.Generator, size: int) -> np.ndarray:
    """Return numbers of a state: small numbers of either sign, or whole ones for numbers of steps and of states."""
    return rng.uniform(-0.3, 0.3, size) if rng.random() < 0.5 else rng.integers(0, 3, size).astype(float)


def _set_parameter(context: Context, index: int, default: np.ndarray, rng: np.random.Generator) -> None:
    """Set a parameter to a multiple of its default, valid for a stiffness too, or if it is zero to random numbers."""
    value = default * rng.uniform(1.0, 1.1) if default.any() else rng.uniform(0.0, 0.3, default.size)
    context.get_mutable_numeric_parameter(index).SetFromVector(value)


def _fix(
    system: LeafSystem, port: InputPort, context: Context, rng: np.random.Generator, samplers: Mapping[str, Sampler]
) -> None:
    if port.get_data_type() == PortDataType.kVectorValued:
        sample = samplers.get(port.get_name(), lambda rng, size: rng.uniform(-0.3, 0.3, size))
        value = sample(rng, port.size())
        port.FixValue(context, np.full(port.size(), np.nan) if rng.random() < INVALID else value)
        return
    value = port.Allocate()
    if isinstance(value, Value[ImageRgba8U]):
        image = value.get_mutable_value()
        image.mutable_data[:] = rng.integers(0, 256, image.mutable_data.shape)
    else:
        # Other values, such as contact results, have no samples and keep their default.
        for kind in LISTS:
            if isinstance(value, Value[list[kind]]):
                value = Value[list[kind]]([LISTS[kind](rng) for _ in range(NUM_BODIES)])
    port.FixValue(context, value)


def _outputs(system: LeafSystem, context: Context) -> dict[str, str]:
    """Return the value of each output and of the update, or the message of a refusal, as text."""
    values = {}
    for i in range(system.num_output_ports()):
        port = system.get_output_port(i)
        try:
            values[port.get_name()] = repr(np.asarray(port.Eval(context)).tolist())
        except (InputError, UnsolvableError) as error:
            values[port.get_name()] = str(error)
    try:
        update = system.EvalUniquePeriodicDiscreteUpdate(context)
        states = [update.get_vector(i).CopyToVector().tolist() for i in range(update.num_groups())]
        values["update"] = repr(states)
    except (InputError, UnsolvableError) as error:
        values["update"] = str(error)
    except (RuntimeError, ValueError):
        pass  # no update, or several of different periods
    return values
