"""Success and peak force against each thing that is changed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from guiderail.tools.viewing.style import legend, new_figure, save_figure

COLUMNS = 4
APART = 0.06  # of the distance between two places, from one who to the next
COLOURS = ("#1f5fbf", "#8a8a8a", "#c0504d", "#4f9d55", "#8064a2", "#d98b2b", "#3aa6a6")


def draw(path: Path, rows: Sequence[Mapping[str, Any]]) -> Path:
    """Writes the picture of a table's rows: two panels for each axis, a line for each who.

    Bars are Wilson's 95 % intervals; of forces the mean over episodes of each one's largest is a line, the largest of
    all a dot. What the policy was trained with is a dashed line.
    """
    table = pd.DataFrame(rows)
    axes = list(dict.fromkeys(table["axis"]))
    columns = min(COLUMNS, len(axes))
    bands = -(-len(axes) // columns)
    figure, panels = new_figure(
        2 * bands, columns, (max(3.2 * columns, 6.4, 1.6 * table["who"].nunique()), 3.6 * bands + 0.5)
    )
    colours = dict(zip(dict.fromkeys(table["who"]), COLOURS * 9, strict=False))
    order = {who: place for place, who in enumerate(colours)}
    for number, name in enumerate(axes):
        success, force = (panels[2 * (number // columns) + part, number % columns] for part in (0, 1))
        of_axis = table[table["axis"] == name]
        places = {value: place for place, value in enumerate(dict.fromkeys(of_axis["value"]))}
        for who, points in of_axis.groupby("who", sort=False):
            # Beside each other: several who always succeed would be one line, and nobody could tell whose.
            x = [places[value] + APART * (order[who] - (len(order) - 1) / 2) for value in points["value"]]
            rate, colour = points["success_rate"], colours[who]
            bars = [rate - points["success_low"], points["success_high"] - rate]
            success.errorbar(
                x, rate, yerr=bars, color=colour, marker="o", markersize=3, capsize=2, label=who.replace("$", r"\$")
            )
            force.plot(x, points["peak_force_mean"], color=colour)
            force.plot(x, points["peak_force"], ".", color=colour)
        for panel in (success, force):
            panel.set_xticks(list(places.values()), [f"{value:.3g}" for value in places])
            trained = of_axis["trained"].iloc[0]
            if trained in places:
                panel.axvline(places[trained], color="0.8", linestyle="--", zorder=0)
        success.set_ylim(-0.03, 1.03)
        force.set_ylim(bottom=0.0)
        force.set_xlabel(of_axis["words"].iloc[0])
        if number % columns == 0:
            success.set_ylabel("success")
            force.set_ylabel("peak force [N]")
    for number in range(len(axes), bands * columns):
        for part in (0, 1):
            panels[2 * (number // columns) + part, number % columns].set_axis_off()
    legend(figure, panels[0, 0])
    return save_figure(figure, path)
