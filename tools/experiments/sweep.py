"""The picture of a study's sweeps: success against difficulty, every method and every policy that knows nothing."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from guiderail.tools.evaluation.metrics import wilson_of_each
from guiderail.tools.experiments.declaration import Study, Sweep
from guiderail.tools.visualization.style import legend, new_figure, save_figure

STYLES = ("-", "--", "-.", ":")  # in turn, as those who always succeed, or never, lie on each other
BREAKS = 0.9  # success below which a method counts as broken
NEVER, AT_ONCE = "not within the sweep", "from the easiest on"


def draw_sweeps(study: Study, rows: pd.DataFrame, path: Path) -> Path:
    """Draws a panel for each sweep: success against the quantity, the mean of all seeds.

    The band goes from the lowest to the highest end of the seeds' own 95 % intervals.

    What is harder is to the right. Where a method that began above `BREAKS` falls below it, there is a cross.

    Args:
        study: whose sweeps are drawn.
        rows: of its table; of a method that is judged at several marks the last one counts.
        path: the picture to write.
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
            style = STYLES[index % len(STYLES)]
            (line,) = axis.plot(
                x, rate, f"o{style}", color=f"C{index % 10}", markersize=3, label=name.replace("_", " ")
            )
            axis.fill_between(x, low, high, color=line.get_color(), alpha=0.12, linewidth=0)
            at = breaking_point(values, rate.tolist())
            if isinstance(at, float):
                axis.plot(at, BREAKS, "x", color=line.get_color(), markersize=9, markeredgewidth=2)
        axis.axhline(BREAKS, color="0.7", linewidth=0.7, linestyle=":")
        axis.set(xlabel=sweep.quantity, ylabel="success", ylim=(-0.03, 1.03))
        values = list(sweep.at)
        if values[0] > values[-1]:
            axis.invert_xaxis()
    legend(figure, axes.flat[0])
    return save_figure(figure, path)


def broken(study: Study, rows: pd.DataFrame) -> dict[str, str]:
    """Where each method breaks, in words: the quantity at which its success falls below `BREAKS`."""
    found = {}
    for sweep in study.sweeps:
        for name in study.methods:
            values, points = curve(sweep, rows, name)
            if values:
                found[f"{name}, below {BREAKS:.0%} at {sweep.quantity}"] = break_words(values, points)
    return found


def break_words(values: Sequence[float], points: Sequence[tuple[float, float, float]]) -> str:
    """Where a curve breaks, as a number or in words."""
    at = breaking_point(values, [rate for rate, _, _ in points])
    return at if isinstance(at, str) else f"{at:.3g}"


def curve(sweep: Sweep, rows: pd.DataFrame, name: str) -> tuple[list[float], list[tuple[float, float, float]]]:
    """At which values of the quantity a method was judged, the easiest first, and its success with its interval."""
    points = {value: _success(rows, name, sweep.eval_set(value).name) for value in sweep.at}
    known = {value: point for value, point in points.items() if point is not None}
    return list(known), list(known.values())


def breaking_point(values: Sequence[float], rates: Sequence[float]) -> float | str:
    """Where success falls below `BREAKS` for the first time, on a straight line between two values; or that it doesn't.

    Args:
        values: of the quantity, the easiest first.
        rates: success at each.
    """
    if rates[0] < BREAKS:
        return AT_ONCE
    for (v0, r0), (v1, r1) in itertools.pairwise(zip(values, rates, strict=True)):
        if r1 < BREAKS:
            return float(v0 + (v1 - v0) * (r0 - BREAKS) / (r0 - r1))
    return NEVER


def _success(rows: pd.DataFrame, method: str, judged: str) -> tuple[float, float, float] | None:
    """The success rate of all seeds, and the lowest and the highest end of their intervals."""
    found = rows[(rows["method"] == method) & (rows["eval_set"] == judged)]
    found = found[found["after_episodes"] == found["after_episodes"].max()]
    if not len(found):
        return None
    episodes = found["episodes"].astype(int)
    successes = (found["success_rate"] * episodes).astype(float).round().astype(int)
    lows, highs = zip(*wilson_of_each(successes, episodes), strict=True)
    return successes.sum() / episodes.sum(), min(lows), max(highs)
