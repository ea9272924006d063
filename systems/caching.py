"""A computed array in a system's cache, for what an output and an event of the same instant both need."""

from collections.abc import Callable

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import CacheEntry, Context, DependencyTicket, LeafSystem, ValueProducer


def declare_array_cache(
    system: LeafSystem, name: str, calc: Callable[[Context], np.ndarray], prerequisites: set[DependencyTicket]
) -> CacheEntry:
    """Declares a cache entry of `system` that holds what `calc` returns until one of the prerequisites changes."""
    return system.DeclareCacheEntry(
        name,
        ValueProducer(allocate=lambda: Value(np.empty(0)), calc=lambda context, value: value.set_value(calc(context))),
        prerequisites,
    )
