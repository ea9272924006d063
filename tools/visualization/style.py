"""How every picture of guiderail looks: the same colour for the same method, and a file that is complete."""

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from guiderail.diagrams.guidance.registry import GUIDANCE
from guiderail.tools.files import check_picture, write_atomically


def is_demonstrated(kind: str | None) -> bool:
    """Whether an action of zero is the demonstration, so that its success can be stated."""
    return kind in GUIDANCE.names() and GUIDANCE.get(str(kind)).demonstrates


def label(kind: str) -> str:
    """What a picture calls a kind of guidance."""
    return GUIDANCE.get(kind).label if kind in GUIDANCE.names() else kind


def colour(kind: str) -> str:
    """Its colour in every picture."""
    return GUIDANCE.get(kind).colour if kind in GUIDANCE.names() else "#8c564b"


LAYOUT: str | None = "constrained"  # labels get the room that they need


def new_figure(rows: int, columns: int, size: tuple[float, float]) -> tuple[Figure, np.ndarray]:
    """A figure without a window, whatever the machine has; axes (rows, columns)."""
    figure = Figure(figsize=size, layout=cast(Any, LAYOUT))
    FigureCanvasAgg(figure)
    axes = figure.subplots(rows, columns, squeeze=False)
    for axis in axes.flat:
        axis.spines[["top", "right"]].set_visible(False)
    return figure, axes


def save_figure(figure: Figure, path: Path, dpi: int = 130) -> Path:
    """Writes a picture, whole, in the format that its ending says; the same figure is the same SVG."""
    check_picture(path)
    content, kind = io.BytesIO(), path.suffix[1:].lower()
    with matplotlib.rc_context({"svg.hashsalt": "guiderail", "svg.fonttype": "none"}):
        figure.savefig(content, format=kind, dpi=dpi, metadata={"Date": None} if kind == "svg" else None)
    write_atomically(path, content.getvalue())
    return path


def rolling(values: Sequence[float] | np.ndarray, window: int = 10) -> np.ndarray:
    """The mean of the last `window` values, of fewer at the start."""
    return pd.Series(np.asarray(values, float)).rolling(window, min_periods=1).mean().to_numpy()


def draw_runs(axis: Axes, runs: Sequence[Sequence[float]], *, colour: str, label: str, window: int = 10) -> None:
    """Several runs of one method: the mean over runs as a line, their range as a band, each smoothed by `window`."""
    length = min(len(run) for run in runs)
    smooth = np.stack([rolling(run, window)[:length] for run in runs])
    episodes = np.arange(1, length + 1)
    axis.fill_between(episodes, smooth.min(0), smooth.max(0), color=colour, alpha=0.15, linewidth=0)
    axis.plot(episodes, smooth.mean(0), color=colour, label=label)


def legend(figure: Figure, axis: Axes) -> None:
    """One legend above all axes, where it covers no curve."""
    handles, labels = axis.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=len(labels), frameon=False)
