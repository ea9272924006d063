"""Picture of a study's sweeps: success against difficulty for every method."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from guiderail.tools.evaluation.metrics import wilson_of_each
from guiderail.tools.experiments.declaration import Study, Sweep
from guiderail.tools.visualization.style import legend, new_figure, save_figure

LINE_STYLES = ("-", "--", "-.", ":")  # in turn, because curves of methods that always or never succeed coincide
BREAKING_SUCCESS = 0.9  # success rate below which a method counts as broken
NEVER, AT_ONCE = "not within the sweep", "from the easiest on"


def draw_sweeps(study: Study, rows: pd.DataFrame, path: Path) -> Path:
    """Draw a panel for each sweep: the success rate of all seeds against the quantity.

    The band spans the seeds' own 95 % intervals. Harder values are to the right. A cross marks where a method that
    began above `BREAKING_SUCCESS` falls below it.

    Args:
        study: Study of the sweeps.
        rows: Rows of its table; of a method evaluated after several numbers of episodes, the largest counts.
        path: Picture to write.
    """
    width = max(4.4 * len(study.sweeps), 1.3 * len(study.methods))  # the legend is one line
    figure, axes = new_figure(1, len(study.sweeps), (width, 3.6))
    for axis, sweep in zip(axes.flat, study.sweeps, strict=True):
        for index, name in enumerate(study.methods):
            values, points = curve(sweep, rows, name)
            if not values:
                continue
            x = np.array(values)
            rate, low, high = np.array(points, dtype=float).T
            style = LINE_STYLES[index % len(LINE_STYLES)]
            (line,) = axis.plot(
                x, rate, f"o{style}", color=f"C{index % 10}", markersize=3, label=name.replace("_", " ")
            )
            axis.fill_between(x, low, high, color=line.get_color(), alpha=0.12, linewidth=0)
            at = breaking_point(values, rate.tolist())
            if isinstance(at, float):
                axis.plot(at, BREAKING_SUCCESS, "x", color=line.get_color(), markersize=9, markeredgewidth=2)
        axis.axhline(BREAKING_SUCCESS, color="0.7", linewidth=0.7, linestyle=":")
        axis.set(xlabel=sweep.quantity, ylabel="success", ylim=(-0.03, 1.03))
        values = list(sweep.at)
        if values[0] > values[-1]:
            axis.invert_xaxis()
    legend(figure, axes.flat[0])
    return save_figure(figure, path)


def breaking_points(study: Study, rows: pd.DataFrame) -> dict[str, str]:
    """Return where each method breaks in each sweep, as text by a label."""
    texts = {}
    for sweep in study.sweeps:
        for name in study.methods:
            values, points = curve(sweep, rows, name)
            if values:
                label = f"{name}, below {BREAKING_SUCCESS:.0%} at {sweep.quantity}"
                texts[label] = format_breaking_point(values, points)
    return texts


def format_breaking_point(values: Sequence[float], points: Sequence[tuple[float, float, float]]) -> str:
    """Return the breaking point of a curve as a number, or as `NEVER` or `AT_ONCE`."""
    at = breaking_point(values, [rate for rate, _, _ in points])
    return at if isinstance(at, str) else f"{at:.3g}"


def curve(sweep: Sweep, rows: pd.DataFrame, name: str) -> tuple[list[float], list[tuple[float, float, float]]]:
    """Return the values at which a method was evaluated, the easiest first, and its success rate with its interval."""
    points = {value: _success(rows, name, sweep.eval_set(value).name) for value in sweep.at}
    evaluated = {value: point for value, point in points.items() if point is not None}
    return list(evaluated), list(evaluated.values())


def breaking_point(values: Sequence[float], rates: Sequence[float]) -> float | str:
    """Return where the success rate first falls below `BREAKING_SUCCESS`, interpolated linearly.

    Args:
        values: Values of the quantity, the easiest first.
        rates: Success rate at each value.

    Returns:
        The value, `AT_ONCE` if already the easiest value is below, or `NEVER`.
    """
    if rates[0] < BREAKING_SUCCESS:
        return AT_ONCE
    for (v0, r0), (v1, r1) in itertools.pairwise(zip(values, rates, strict=True)):
        if r1 < BREAKING_SUCCESS:
            return float(v0 + (v1 - v0) * (r0 - BREAKING_SUCCESS) / (r0 - r1))
    return NEVER


def _success(rows: pd.DataFrame, method: str, eval_set: str) -> tuple[float, float, float] | None:
    """Return the success rate of all seeds, and the lowest and highest end of their intervals."""
    selected = rows[(rows["method"] == method) & (rows["eval_set"] == eval_set)]
    selected = selected[selected["after_episodes"] == selected["after_episodes"].max()]
    if not len(selected):
        return None
    episodes = selected["episodes"].astype(int)
    successes = (selected["success_rate"] * episodes).astype(float).round().astype(int)
    lows, highs = zip(*wilson_of_each(successes, episodes), strict=True)
    return successes.sum() / episodes.sum(), min(lows), max(highs)
