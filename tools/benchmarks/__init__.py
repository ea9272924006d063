"""How fast things are on this machine: `guiderail bench`."""

import sys
from collections.abc import Callable, Collection, Iterator
from importlib import import_module
from typing import Any, TypeVar

from guiderail.models.errors import InputError
from guiderail.models.registry import did_you_mean

Item = TypeVar("Item")
BENCHMARKS = ("primitive", "simulation", "saving", "learner", "training")
OF_A_TASK = ("training",)  # those that are told which task, and how it is set up


def run_benchmark(what: str, **told_of: Any) -> tuple[dict[str, Any], Callable[[dict[str, Any]], None]]:
    """What one of `BENCHMARKS` measured, with its progress on standard error; and what shows it to a person.

    Args:
        what: its name.
        told_of: `task` and `environment`, where it takes them.

    Raises:
        InputError: if there is no such benchmark, or it takes no task.
    """
    if what not in BENCHMARKS:
        raise InputError(f"there is no benchmark {what!r}: {did_you_mean(what, BENCHMARKS)}")
    given = {name: value for name, value in told_of.items() if value}
    if given and what not in OF_A_TASK:
        raise InputError(f"the benchmark {what} is of no task: leave {' and '.join(given)} out")
    module = import_module(f"guiderail.tools.benchmarks.{what}")
    return module.measure(**given), module.show


def told(what: Collection[Item], words: str) -> Iterator[Item]:
    """One after the other, and on standard error which one it is."""
    for index, item in enumerate(what, 1):
        print(f"{words} {index}/{len(what)}: {item}", file=sys.stderr, flush=True)
        yield item
