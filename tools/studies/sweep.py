"""The picture of a study's sweeps: success against difficulty, every method and every policy that knows nothing."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd

from guiderail.tools.report.statistics import wilson_of_each
from guiderail.tools.studies.declaration import Study
from guiderail.tools.viewing.style import legend, new_figure, save_figure


def draw_sweeps(study: Study, rows: pd.DataFrame, path: Path) -> Path:
    """Draws a panel for each sweep: success against the quantity, the mean of all seeds.

    The band goes from the lowest to the highest end of the seeds' own 95 % intervals.

    Args:
        study: whose sweeps are drawn.
        rows: of its table; of a method that is judged at several marks the last one counts.
        path: the picture to write.
    """
    figure, axes = new_figure(1, len(study.sweeps), (4.4 * len(study.sweeps), 3.6))
    for axis, sweep in zip(axes.flat, study.sweeps, strict=True):
        values = sorted(sweep.at)
        for name in study.methods:
            points = [_success(rows, name, sweep.judged_on(value).name) for value in values]
            there = [k for k, point in enumerate(points) if point is not None]
            if not there:
                continue
            x = np.array([values[k] for k in there])
            rate, low, high = np.array([points[k] for k in there], dtype=float).T
            (line,) = axis.plot(x, rate, "o-", markersize=3, label=name.replace("_", " "))
            axis.fill_between(x, low, high, color=line.get_color(), alpha=0.12, linewidth=0)
        axis.set(xlabel=sweep.quantity, ylabel="success", ylim=(-0.03, 1.03))
    legend(figure, axes.flat[0])
    return save_figure(figure, path)


def _success(rows: pd.DataFrame, method: str, judged: str) -> tuple[float, float, float] | None:
    """The success rate of all seeds, and the lowest and the highest end of their intervals."""
    found = rows[(rows["method"] == method) & (rows["judged_on"] == judged)]
    found = found[found["mark"] == found["mark"].max()]
    if not len(found):
        return None
    episodes = found["episodes"].astype(int)
    successes = (found["success_rate"] * episodes).astype(float).round().astype(int)
    lows, highs = zip(*wilson_of_each(successes, episodes), strict=True)
    return successes.sum() / episodes.sum(), min(lows), max(highs)
