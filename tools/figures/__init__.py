"""Figures and a table of the thesis, made anew: each a picture and a table with the numbers behind it."""

import inspect
from importlib import import_module
from pathlib import Path
from typing import Any

from guiderail.models.errors import InputError

# Where each figure is made; imported when asked for, so that a list of figures costs nothing.
FIGURES = {
    "table 3.3": ("pouring", "table_3_3"),
    "3.5": ("pouring", "figure_3_5"),
    "3.6": ("pouring", "figure_3_6"),
    "3.8": ("pouring", "figure_3_8"),
    "3.10": ("grid_clamp", "figure_3_10"),
    "3.11": ("grid_clamp", "figure_3_11"),
    "4.2": ("properties", "figure_4_2"),
    "4.4": ("baselines", "figure_4_4"),
    "4.5": ("baselines", "figure_4_5"),
    "4.6": ("baselines", "figure_4_6"),
    "4.7": ("image", "figure_4_7"),
    "4.8": ("connector", "figure_4_8"),
    "5.2": ("smoothness", "figure_5_2"),
    "5.4": ("perturbations", "figure_5_4"),
    "5.5": ("smoothness", "figure_5_5"),
    "5.6": ("learning", "figure_5_6"),
    "5.8": ("connector", "figure_5_8"),
    "5.9": ("connector", "figure_5_9"),
    "5.10": ("connector", "figure_5_10"),
}


def reproduce(figure: str, *, seeds: int = 3, episodes: int | None = None, out: Path = Path("reproductions")) -> dict:
    """Makes one figure.

    Args:
        figure: its number in the thesis, or "table 3.3".
        seeds: runs of each method, where the figure is about learning.
        episodes: of each run; the figure's own number unless given.
        out: where pictures, tables and runs go. Runs that are there and finished are used again, so that figures which
            share runs share them.

    Returns:
        `figure`, `picture`, `table`, and what the numbers say, claim by claim.

    Raises:
        InputError: for an unknown figure or a number out of range.
    """
    number = figure.lower().removeprefix("figure").strip()
    if number not in FIGURES:
        raise InputError(f"there is no figure {figure!r} to reproduce: choose one of {', '.join(FIGURES)}")
    if seeds < 1 or (episodes is not None and episodes < 1):
        raise InputError(f"a figure needs at least one seed and one episode, not {seeds} and {episodes}")
    if out.exists() and not out.is_dir():
        raise InputError(f"{out} is a file: name a folder with --out")
    module, function = FIGURES[number]
    make = getattr(import_module(f"guiderail.tools.figures.{module}"), function)
    given: dict[str, Any] = {"seeds": seeds, "episodes": episodes}
    taken = inspect.signature(make).parameters
    return {"figure": number} | make(out, **{k: v for k, v in given.items() if k in taken and v is not None})
