"""Style of all pictures: one color for each guidance, figures without a window, files written atomically."""

import io
from collections.abc import Callable, Sequence
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


def label(guidance: str) -> str:
    """Return the label of a guidance in a legend; for an unknown guidance, its name."""
    return GUIDANCE.get(guidance).label if guidance in GUIDANCE.names() else guidance


def color(guidance: str) -> str:
    """Return the color of a guidance; brown for an unknown guidance."""
    return GUIDANCE.get(guidance).color if guidance in GUIDANCE.names() else "#8c564b"


LAYOUT: str | None = "constrained"  # layout engine of Matplotlib that makes room for labels
WINDOW = 10  # episodes of a moving mean


def new_figure(rows: int, columns: int, size: tuple[float, float]) -> tuple[Figure, np.ndarray]:
    """Return a figure without a window, and its axes (rows, columns)."""
    figure = Figure(figsize=size, layout=cast(Any, LAYOUT))
    FigureCanvasAgg(figure)
    axes = figure.subplots(rows, columns, squeeze=False)
    for axis in axes.flat:
        axis.spines[["top", "right"]].set_visible(False)
    return figure, axes


def save_figure(figure: Figure, path: Path) -> Path:
    """Write a picture in the format of its file ending, and return its path; equal figures give equal SVG files."""
    check_picture(path)
    content, kind = io.BytesIO(), path.suffix[1:].lower()
    with matplotlib.rc_context({"svg.hashsalt": "guiderail", "svg.fonttype": "none"}):
        figure.savefig(content, format=kind, dpi=130, metadata={"Date": None} if kind == "svg" else None)
    write_atomically(path, content.getvalue())
    return path


def rolling(values: Sequence[float] | np.ndarray, window: int = WINDOW) -> np.ndarray:
    """Return the moving mean (n,) of the last `window` of the values (n,), or of fewer values at the start."""
    return pd.Series(np.asarray(values, float)).rolling(window, min_periods=1).mean().to_numpy()


def draw_runs(
    axis: Axes,
    runs: Sequence[Sequence[float] | np.ndarray],
    *,
    color: str,
    label: str,
    window: int = WINDOW,
    band: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]] = lambda values: (values.min(0), values.max(0)),
    **line: Any,
) -> None:
    """Draw the learning curve of a method: the mean over runs of a moving mean, and a band.

    Args:
        axis: Axes.
        runs: Values over the episodes of each run, at least one run; longer runs are cut to the shortest.
        color: Color of line and band.
        label: Label for a legend.
        window: Episodes of the moving mean.
        band: Function from smoothed values (runs, n) to the lower and upper end of the band, (n,) each; by default the
            range of the runs.
        line: Further arguments of the line.
    """
    length = min(len(run) for run in runs)
    smooth = np.stack([rolling(run, window)[:length] for run in runs])
    episodes = np.arange(1, length + 1)
    if len(runs) > 1:
        axis.fill_between(episodes, *band(smooth), color=color, alpha=0.15, linewidth=0)
    axis.plot(episodes, smooth.mean(axis=0), color=color, label=label, **line)


def legend(figure: Figure, axis: Axes) -> None:
    """Draw one legend above all axes, outside of the data."""
    handles, labels = axis.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=len(labels), frameon=False)


def legend_above(axis: Axes, columns: int = 3) -> None:
    """Draw a legend above one of several axes, outside of the data."""
    if axis.get_legend_handles_labels()[1]:
        place: dict[str, Any] = {"loc": "lower left", "bbox_to_anchor": (0.0, 1.0), "borderaxespad": 0.2}
        axis.legend(frameon=False, fontsize=8, ncols=columns, **place)
