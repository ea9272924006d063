"""Diagrams that were built and are free again."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Hashable
from typing import Generic, TypeVar

Built = TypeVar("Built")


class Pool(Generic[Built]):
    """Keeps what was built until somebody needs the same again.

    A diagram with a LeafSystem of Python in it is never freed: C++ holds the system's methods, these hold the system,
    and no garbage collector sees the circle. What cannot be freed can be used again, as a diagram is the same after use
    as before: all that changes is in a context, and everyone makes one of their own.
    """

    def __init__(self) -> None:
        self._idle: dict[Hashable, list[Built]] = defaultdict(list)

    def take(self, key: Hashable, build: Callable[[], Built]) -> Built:
        """One that is free, or a new one; nobody else has it until it is given back."""
        idle = self._idle[key]
        return idle.pop() if idle else build()

    def give_back(self, key: Hashable, built: Built) -> None:
        """It is free again."""
        self._idle[key].append(built)
