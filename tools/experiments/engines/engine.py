"""What a study needs of whatever runs its jobs, and the engines by name."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any, TypeAlias

from guiderail.models.common.errors import InputError
from guiderail.models.common.registry import Registry

ATTEMPTS = 3  # workers that a job may cost before it is given up: a job that kills its worker would go on for ever
GIVEN_UP = f"{ATTEMPTS} workers were lost with it, one after the other"


@dataclass(frozen=True)
class Outcome:
    """What became of a job: its rows, or one sentence why there are none."""

    rows: tuple[dict[str, Any], ...] = ()
    failure: str = ""


Work: TypeAlias = Callable[[Any], Outcome]


class Engine(AbstractContextManager[Any]):
    """Runs jobs on workers: one at a time on each, with one thread.

    A context: entering it finds or readies the workers, and leaving it leaves none behind that it started, whatever
    happened. A job goes on from what is in its folder, so a job whose worker is lost is simply given to another.

    Attributes:
        processes: how many jobs go side by side; None where that is not the engine's to say.
    """

    processes: int | None = None

    @abstractmethod
    def run(self, work: Work, jobs: Mapping[int, Any]) -> Iterator[tuple[int, Outcome]]:
        """The jobs' keys and outcomes as they are done, in any order.

        Args:
            work: what a worker does with a job; it can be pickled and raises nothing.
            jobs: what can be pickled.
        """


# An entry is called with `processes` and `address`, None where nobody gave them.
ENGINES: Registry[Callable[..., Engine]] = Registry(
    "engine",
    package="guiderail.tools.experiments.engines",
    decorator="register_engine",
    entry_points="guiderail.engines",
)
register_engine = ENGINES.register


def make_engine(name: str = "process", processes: int | None = None, address: str | None = None) -> Engine:
    """An engine by its name.

    Raises:
        InputError: for an unknown name, a number out of range, or what the engine has no use for.
    """
    if processes is not None and processes < 1:
        raise InputError(f"a study needs at least one process, not {processes}")
    return ENGINES.get(name)(processes=processes, address=address)
