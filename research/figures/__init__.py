"""Figures and a table of the thesis, made anew: each a picture and a table with the numbers behind it."""

import inspect
import json
import shlex
import time
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

from guiderail.models.common.errors import InputError
from guiderail.models.common.registry import did_you_mean
from guiderail.tools.files import write_atomically
from research.figures.thesis import THESIS

# What makes each figure; imported when asked for, so that a list of figures costs nothing.
FIGURES = {
    **{f"table {n}": f"table_{n.replace('.', '_')}" for n in ("3.2", "3.3", "4.1")},
    "2.2": "figure_2_2",
    **{f"3.{n}": f"figure_3_{n}" for n in (4, 5, 6, 7, 8, 10, 11)},
    **{f"4.{n}": f"figure_4_{n}" for n in range(2, 9)},
    **{f"5.{n}": f"figure_5_{n}" for n in range(2, 11)},
}


def reproduce(figure: str, *, seeds: int = 3, episodes: int | None = None, out: Path = Path("reproductions")) -> dict:
    """Makes one figure or table.

    Args:
        figure: its number in the thesis, such as "4.2" or "table 3.3".
        seeds: runs of each method, where the figure is about learning.
        episodes: of each run; the figure's own number unless given.
        out: where pictures, tables and runs go. Runs that are there and finished are used again, so that figures which
            share runs share them.

    Returns:
        `figure`, `picture`, `table`, what the numbers say, claim by claim, and what the thesis says. That is also left
        as JSON beside the table, with the command and the time it took, for `guiderail results`.

    Raises:
        InputError: for an unknown figure or a number out of range.
    """
    number = figure.lower().removeprefix("figure").strip()
    if number not in FIGURES:
        raise InputError(f"there is no figure {figure!r} to reproduce: {did_you_mean(number, FIGURES)}")
    if seeds < 1 or (episodes is not None and episodes < 1):
        raise InputError(f"a figure needs at least one seed and one episode, not {seeds} and {episodes}")
    if out.exists() and not out.is_dir():
        raise InputError(f"{out} is a file: name a folder with --out")
    make = find_figure(number)
    given: dict[str, Any] = {"seeds": seeds, "episodes": episodes}
    taken = inspect.signature(make).parameters
    given = {k: v for k, v in given.items() if k in taken and v is not None}
    started = time.perf_counter()
    found = {"figure": number, **make(out, **given), "the thesis": THESIS[number]}
    left = {
        "command": " ".join([command_of(number), *(f"--{key} {value}" for key, value in given.items())]),
        "seconds": round(time.perf_counter() - started, 1),
        "seeds": given.get("seeds"),
        **found,
    }
    write_atomically(out / f"{FIGURES[number]}.json", json.dumps(left, indent=1, default=str).encode() + b"\n")
    return found


def command_of(number: str) -> str:
    """The command that makes a figure as it is."""
    return f"guiderail reproduce {shlex.quote(number)}"


def find_figure(number: str) -> Callable[..., dict[str, Any]]:
    """What makes a figure: a function of the module of its chapter."""
    chapter = number.removeprefix("table ").split(".")[0]
    return getattr(import_module(f"research.figures.chapter_{chapter}"), FIGURES[number])
