"""Cache entries: what is computed once, however many outputs and events of an instant need it."""

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
    """Declares a cache entry of `system` that holds what `calc` returns until one of the prerequisites changes."""
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
    """Declares a cache entry of `system` that holds a context of `plant`, for its kinematics and its inertia.

    Args:
        system: under construction.
        plant: finalized.
        set_state: called with the system's context and the plant's; writes the plant's state.
        prerequisites_of_calc: what `set_state` reads.
    """
    return system.DeclareCacheEntry(
        description="plant_context",
        value_producer=ValueProducer(
            allocate=lambda: Value(plant.CreateDefaultContext()),
            calc=lambda context, value: set_state(context, value.get_mutable_value()),
        ),
        prerequisites_of_calc=prerequisites_of_calc,
    )
