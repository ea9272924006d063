"""How fast things are on this machine: `guiderail bench`."""

import sys
from collections.abc import Callable, Collection, Iterator
from importlib import import_module
from typing import Any, TypeVar

from guiderail.models.errors import InputError
from guiderail.models.registry import did_you_mean

Item = TypeVar("Item")
BENCHMARKS = ("primitive", "simulation", "saving")


def run_benchmark(what: str) -> tuple[dict[str, Any], Callable[[dict[str, Any]], None]]:
    """What one of `BENCHMARKS` measured, with its progress on standard error; and what shows it to a person.

    Raises:
        InputError: if there is no such benchmark.
    """
    if what not in BENCHMARKS:
        raise InputError(f"there is no benchmark {what!r}: {did_you_mean(what, BENCHMARKS)}")
    module = import_module(f"guiderail.tools.benchmarks.{what}")
    return module.measure(), module.show


def told(what: Collection[Item], words: str) -> Iterator[Item]:
    """One after the other, and on standard error which one it is."""
    for index, item in enumerate(what, 1):
        print(f"{words} {index}/{len(what)}: {item}", file=sys.stderr, flush=True)
        yield item
