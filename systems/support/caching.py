"""Declaration of cache entries, so that outputs and events of one instant share a computation."""

from collections.abc import Callable

from pydrake.common.value import Value
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import CacheEntry, Context, DependencyTicket, LeafSystem, ValueProducer


def declare_cache(
    system: LeafSystem,
    name: str,
    calc: Callable[[Context], object],
    *,
    prerequisites_of_calc: set[DependencyTicket],
) -> CacheEntry:
    """Declare a cache entry with a value computed by `calc`.

    Args:
        system: System under construction.
        name: Description of the cache entry.
        calc: Function of the system's context that returns the value.
        prerequisites_of_calc: Tickets of the values that `calc` reads.
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
    """Declare a cache entry that contains a context of `plant`, for its kinematics and inertia.

    Args:
        system: System under construction.
        plant: Finalized plant.
        set_state: Function of the system's context and the plant's context that writes the plant's state.
        prerequisites_of_calc: Tickets of the values that `set_state` reads.
    """
    return system.DeclareCacheEntry(
        description="plant_context",
        value_producer=ValueProducer(
            allocate=lambda: Value(plant.CreateDefaultContext()),
            calc=lambda context, value: set_state(context, value.get_mutable_value()),
        ),
        prerequisites_of_calc=prerequisites_of_calc,
    )
