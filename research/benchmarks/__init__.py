"""Benchmarks of speed on this machine, `python -m research.benchmarks NAME`."""

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
    "actors",
)
WITH_TASK = ("training", "cold_start", "actors")  # benchmarks of a task that the user chooses
WITH_IMPORTS = ("cold_start",)  # benchmarks with child processes, which have to import the task's modules
WITH_PICTURE = ("time_step", "engines")


def run_benchmark(
    name: str, *, picture: Path | None = None, **options: Any
) -> tuple[dict[str, Any], Callable[[dict[str, Any]], None]]:
    """Run a benchmark, with its progress on standard error.

    Args:
        name: One of `BENCHMARKS`.
        picture: File of a picture of the results, for benchmarks in `WITH_PICTURE`.
        options: `task`, `environment` and `imports`, for benchmarks in `WITH_TASK`.

    Returns:
        The results, and the function that prints them.

    Raises:
        InputError: If there is no such benchmark, or it has no such option.
    """
    if name not in BENCHMARKS:
        raise InputError(f"there is no benchmark {name!r}: {did_you_mean(name, BENCHMARKS)}")
    arguments = {option: value for option, value in options.items() if value}
    if arguments and name not in WITH_TASK:
        raise InputError(f"the benchmark {name} has no task: leave {' and '.join(arguments)} out")
    if picture is not None and name not in WITH_PICTURE:
        raise InputError(f"the benchmark {name} has no picture: leave --picture out")
    if picture is not None:
        check_picture(picture)
    if name not in WITH_IMPORTS:
        arguments.pop("imports", None)
    module = import_module(f"research.benchmarks.{name}")
    results = module.measure(**arguments)
    if picture is not None:
        module.draw(results, picture)
    return results, module.show


def with_progress(items: Collection[Item], label: str) -> Iterator[Item]:
    """Yield items one after the other, and print each of them on standard error."""
    for index, item in enumerate(items, 1):
        print(f"{label} {index}/{len(items)}: {item}", file=sys.stderr, flush=True)
        yield item
