"""Interface of the engines that run the jobs of a study, and the registry of engines."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any, TypeAlias

from guiderail.models.common.arrays import as_whole
from guiderail.models.common.errors import InputError, brief
from guiderail.models.common.registry import Registry, check_callable

MAX_ATTEMPTS = 3  # lost workers after which a job has failed; the job itself may be the cause
GIVEN_UP = f"{MAX_ATTEMPTS} workers were lost running it, one after the other"


@dataclass(frozen=True)
class Outcome:
    """Result of a job."""

    rows: tuple[dict[str, Any], ...] = ()  # rows of the study's table
    failure: str = ""  # one sentence on why the job failed; empty if it succeeded


Work: TypeAlias = Callable[[Any], Outcome]


class Engine(AbstractContextManager[Any]):
    """Engine that runs jobs on workers; a worker runs one job at a time, with one thread.

    An engine is a context manager. Entering it finds or prepares the workers, and raises an InputError if it cannot.
    Leaving it ends all processes that it started, also after an error. A job resumes from its folder, so the job of a
    lost worker is given to another worker.

    Attributes:
        processes: Number of jobs that run at once; None if the engine does not set it.
    """

    processes: int | None = None

    @abstractmethod
    def run(self, work: Work, jobs: Mapping[int, Any]) -> Iterator[tuple[int, Outcome]]:
        """Yield keys and outcomes of the jobs as they finish, in any order.

        It is called again for jobs that start from the runs of earlier jobs.

        Args:
            work: Function from a job to its outcome; it can be pickled and raises nothing.
            jobs: Jobs by key; they can be pickled.
        """


# An entry is called with `processes` and `address`, which are None by default.
ENGINES: Registry[Callable[..., Engine]] = Registry(
    "engine",
    plugin="engine",
    check=check_callable,
)
register_engine = ENGINES.register


def make_engine(name: str = "process", processes: int | None = None, address: str | None = None) -> Engine:
    """Return the engine registered as `name`, for `processes` jobs at once or for the cluster at `address`.

    Raises:
        InputError: If the name is unknown, an argument is out of range or not supported by the engine, or the entry of
            the name returns no `Engine`.
    """
    if processes is not None:
        as_whole(processes, "the number of processes", 1)
    engine = ENGINES.get(name)(processes=processes, address=address)
    if not isinstance(engine, Engine):
        raise InputError(f"the engine {name!r} must be an Engine, not {brief(engine)}: derive its class from Engine")
    return engine
