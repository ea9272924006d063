"""Figures: one color for each guidance, without a window; curves of a run, and the narrow passage."""

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
from matplotlib.patches import Circle, Rectangle

from guiderail.diagrams.guidance.registry import GUIDANCE
from guiderail.models.common.errors import InputError
from guiderail.models.objects.narrow_passage import PassageGeometry, load_demonstrations
from guiderail.tools.evaluation.metrics import VIOLATION, WORDS, episodes_to_convergence
from guiderail.tools.files import check_picture, write_atomically
from guiderail.tools.learning.run_folder import RunFolder


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


def legend(figure: Figure, axis: Axes) -> None:
    """Draw one legend above all axes, outside of the data."""
    handles, labels = axis.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=len(labels), frameon=False)


def legend_above(axis: Axes, columns: int = 3) -> None:
    """Draw a legend above one of several axes, outside of the data."""
    if axis.get_legend_handles_labels()[1]:
        place: dict[str, Any] = {"loc": "lower left", "bbox_to_anchor": (0.0, 1.0), "borderaxespad": 0.2}
        axis.legend(frameon=False, fontsize=8, ncols=columns, **place)


def draw_passage(axis: Axes, demonstrations: bool = True, *, named: bool = False) -> None:
    """Draw the narrow passage: walls, forbidden zone, obstacle and goal.

    Args:
        axis: Axes.
        demonstrations: True to draw the demonstrations in gray.
        named: True to label zone, obstacle, goal and demonstrations for a legend.
    """
    passage = PassageGeometry()
    zone, obstacle, goal, path_label = ("forbidden zone", "obstacle", "goal", "demonstration") if named else 4 * ("",)
    for lower, upper in zip(*passage.walls, strict=True):
        axis.add_patch(Rectangle(tuple(lower), *(upper - lower), color="0.45", linewidth=0))
    axis.add_patch(Rectangle((passage.zone_x, -1), 2, 3, color="firebrick", alpha=0.12, linewidth=0, label=zone))
    axis.axvline(passage.zone_x, color="firebrick", linewidth=0.8)
    axis.add_patch(Circle(passage.obstacle, passage.obstacle_radius, color="saddlebrown", label=obstacle))
    axis.add_patch(Circle(passage.goal, passage.goal_radius, color="tab:green", alpha=0.4, label=goal))
    if demonstrations:
        for index, path in enumerate(load_demonstrations().outputs):
            axis.plot(*path.T, color="0.75", linewidth=0.6, label="" if index else path_label)
    axis.set(xlim=(0.1, 0.8), ylim=(0.0, 1.02), aspect="equal", xlabel="x [m]", ylabel="y [m]")


# Panels with two curves: label of the axis, and the column and label of each curve.
PAIRS = (
    (
        f"constraint violation [{VIOLATION}]\n(negative is slack)",
        {"max_commanded_violation": "commanded", "max_measured_violation": "measured"},
    ),
    ("force [N]", {"peak_force": "peak", "mean_force": "mean"}),
    ("mean jerk [m/s³]", {"jerk_commanded_linear": "commanded", "jerk_measured_linear": "measured"}),
)
PLOTTED = {"success", "return", *(column for _, columns in PAIRS for column in columns)}


def plot_run(run: Path) -> Path:
    """Draw `learning_curve.png` from the `episodes.csv` of a run."""
    folder = RunFolder(run)
    config, rows = folder.config(), folder.episodes()
    if not len(rows):
        raise InputError(f"{run} has no finished episode yet: let it train, then plot it")
    column = {key: rows[key].to_numpy(float) for key in rows.columns.drop(list(WORDS), errors="ignore")}
    if missing := sorted(PLOTTED - column.keys()):
        raise InputError(f"{folder.path} is of another version: its episodes have no {missing[0]}; train again")
    episodes = np.arange(1, len(rows) + 1)
    guidance = config.environment.get("guidance", "")
    line = color(guidance)

    figure, axes = new_figure(2, 3, (13, 6.4))
    success, returns, terms, *pairs = axes.flat
    success.plot(episodes, rolling(column["success"]), color=line)
    success.scatter(episodes, column["success"], s=6, color=line, alpha=0.4)
    success.set(ylabel="success (mean of 10)", ylim=(-0.05, 1.05))
    converged = episodes_to_convergence(rows)
    if converged is not None:
        success.axvline(converged + 0.5, color="0.6", linestyle=":")
        success.set_title(f"{converged} episodes to convergence", fontsize=9)
    returns.plot(episodes, column["return"], color=line, alpha=0.3)
    returns.plot(episodes, rolling(column["return"]), color=line)
    returns.set(ylabel="return (faint: each episode)")
    for name, values in column.items():
        if name.startswith("reward_"):
            terms.plot(episodes, values, label=name.removeprefix("reward_").replace("_", " "))
    terms.set(ylabel="terms of the return")
    for axis, (label, columns) in zip(pairs, PAIRS, strict=True):
        for (name, text), shade, width in zip(columns.items(), (line, "0.5"), (1.5, 1.0), strict=True):
            axis.plot(episodes, column[name], color=shade, linewidth=width, label=text)
        axis.set(ylabel=label)
    violation, force, jerk = pairs
    violation.axhline(0, color="firebrick", linewidth=0.8)
    force.set_ylim(0.0, max(1.0, force.get_ylim()[1]))  # numerical noise without contact is not magnified
    jerk.set(yscale="log" if (column["jerk_commanded_linear"] > 0).all() else "linear")
    for axis in (terms, *pairs):
        legend_above(axis)
    for axis in axes[1]:
        axis.set_xlabel("episode")
    figure.suptitle(f"{config.task} · {guidance} · {config.learner.algorithm.upper()} · seed {config.seed}")
    return save_figure(figure, folder.path / "learning_curve.png")
