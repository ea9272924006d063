"""How fast things are on this machine: `guiderail bench`."""

import sys
from collections.abc import Callable, Collection, Iterator
from importlib import import_module
from pathlib import Path
from typing import Any, TypeVar

from guiderail.models.common.errors import InputError
from guiderail.models.common.registry import did_you_mean
from guiderail.tools.files import check_picture

Item = TypeVar("Item")
BENCHMARKS = (
    "primitive",
    "simulation",
    "loop",
    "time_step",
    "engines",
    "impedance",
    "saving",
    "learner",
    "training",
    "cold_start",
    "many_envs",
)
OF_A_TASK = ("training", "cold_start")  # those that are told which task, and how it is set up
OF_OTHER_PROCESSES = ("cold_start",)  # those that have to tell them what registers the task
DRAWN = ("time_step", "engines")  # those that can be drawn


def run_benchmark(
    what: str, *, picture: Path | None = None, **told_of: Any
) -> tuple[dict[str, Any], Callable[[dict[str, Any]], None]]:
    """What one of `BENCHMARKS` measured, with its progress on standard error; and what shows it to a person.

    Args:
        what: its name.
        picture: where a picture of it is written, if it can be drawn.
        told_of: `task`, `environment` and `imports`, where it takes them.

    Raises:
        InputError: if there is no such benchmark, it takes no task, or it can't be drawn.
    """
    if what not in BENCHMARKS:
        raise InputError(f"there is no benchmark {what!r}: {did_you_mean(what, BENCHMARKS)}")
    given = {name: value for name, value in told_of.items() if value}
    if given and what not in OF_A_TASK:
        raise InputError(f"the benchmark {what} is of no task: leave {' and '.join(given)} out")
    if picture is not None and what not in DRAWN:
        raise InputError(f"the benchmark {what} is printed and not drawn: leave --picture out")
    if picture is not None:
        check_picture(picture)
    if what not in OF_OTHER_PROCESSES:
        given.pop("imports", None)
    module = import_module(f"research.benchmarks.{what}")
    results = module.measure(**given)
    if picture is not None:
        module.draw(results, picture)
    return results, module.show


def told(what: Collection[Item], words: str) -> Iterator[Item]:
    """One after the other, and on standard error which one it is."""
    for index, item in enumerate(what, 1):
        print(f"{words} {index}/{len(what)}: {item}", file=sys.stderr, flush=True)
        yield item
