"""Pool of built diagrams for reuse, and the limit to one thread while environments are open."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Hashable
from dataclasses import dataclass

from pydrake.systems.framework import Diagram
from threadpoolctl import threadpool_limits

from guiderail.diagrams.envs.task_diagram import TaskDiagram
from guiderail.diagrams.stations.station import Station


@dataclass(frozen=True)
class BuiltDiagram:
    """Diagram of a task with its station and guidance."""

    diagram: TaskDiagram
    station: Station
    guidance: Diagram


class DiagramPool:
    """Pool of diagrams that no environment uses, by a key that is equal for equal diagrams.

    A diagram that contains a LeafSystem written in Python is never freed: C++ holds references to the system's methods,
    the methods hold the system, and no garbage collector finds this cycle. Reuse is safe because everything that
    changes during a simulation is in a context, and each environment creates its own.

    While a diagram is in use, numerical libraries use one thread in this process. The matrices are small: if other
    processes use the cores, several threads that wait for each other take eighty times as long. The number of threads
    would also change the rounding of sums. The previous limits return with the last diagram.
    """

    def __init__(self) -> None:
        self._idle: defaultdict[Hashable, list[BuiltDiagram]] = defaultdict(list)
        self._num_used = 0
        self._limits: threadpool_limits | None = None

    def acquire(self, key: Hashable | None, build: Callable[[], BuiltDiagram]) -> BuiltDiagram:
        """Return an idle diagram of the key, or build one; with the key None, always build one."""
        if self._num_used == 0:
            self._limits = threadpool_limits(1)
        self._num_used += 1
        try:
            idle = [] if key is None else self._idle[key]
            # A diagram that a user has added to another diagram cannot be simulated alone.
            idle[:] = [each for each in idle if each.diagram.diagram.GetSystemPathname().count("::") == 1]
            return idle.pop() if idle else build()
        except BaseException:
            self._return_limits()
            raise

    def release(self, key: Hashable | None, built: BuiltDiagram) -> None:
        """Take back a diagram; one without a key is dropped."""
        if key is not None:
            self._idle[key].append(built)
        self._return_limits()

    def _return_limits(self) -> None:
        self._num_used -= 1
        if self._num_used == 0 and self._limits is not None:
            self._limits.restore_original_limits()
            self._limits = None
