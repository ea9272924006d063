"""Figures of a report, as SVG elements of the page."""

from __future__ import annotations

import io
from html import escape
from itertools import cycle
from typing import Any

import matplotlib
import numpy as np

from guiderail.tools.evaluation.metrics import bootstrap_band, episodes_to_convergence, survival, wilson
from guiderail.tools.visualization.report_data import LEARNED, ReportData, Run
from guiderail.tools.visualization.style import WINDOW, draw_runs, legend_above, new_figure

SIZE = (4.6, 3.0)  # size of a figure [in]; two fit side by side on a wide screen
STYLE: Any = {"svg.fonttype": "none", "svg.hashsalt": "guiderail", "font.size": 9.0}
DASHES = ("-", (0, (5, 1.5)), (0, (2, 1)), (0, (6, 1.5, 1, 1.5)))  # so that coinciding curves can be distinguished


def curve(data: ReportData, task: str, column: str, label: str) -> str:
    """Return the curve of a column over the training episodes: the mean over seeds and its bootstrap band."""
    with matplotlib.rc_context(STYLE):
        figure, axes = new_figure(1, 1, SIZE)
        axis = axes[0, 0]
        colors = data.colors(task)
        for (name, runs), dash in zip(data.methods(task).items(), cycle(DASHES), strict=False):
            values = [run.episodes[column].to_numpy(float) for run in runs]
            shade, text = colors[name], _label(name, runs)
            draw_runs(axis, values, color=shade, label=text, band=bootstrap_band, linestyle=dash)
        axis.set(xlabel="training episode", ylabel=f"{label}, mean of {WINDOW}")
        if column == "success":
            axis.set_ylim(-0.04, 1.04)
        legend_above(axis, columns=2)
        return _svg(figure, f"{label} over the training episodes of {task}")


def survival_curve(data: ReportData, task: str) -> str:
    """Return the Kaplan-Meier curve: fraction of runs not yet converged, over the training episodes."""
    with matplotlib.rc_context(STYLE):
        figure, axes = new_figure(1, 1, SIZE)
        axis = axes[0, 0]
        colors = data.colors(task)
        for (name, runs), dash in zip(data.methods(task).items(), cycle(DASHES), strict=False):
            after, lengths = (
                [episodes_to_convergence(run.episodes) for run in runs],
                [len(run.episodes) for run in runs],
            )
            steps, left = survival(after, lengths)
            steps, left = np.append(steps, max(lengths)), np.append(left, left[-1])
            axis.step(steps, left, where="post", color=colors[name], linestyle=dash, label=_label(name, runs))
            if None in after:
                axis.plot(steps[-1], left[-1], "|", color=colors[name], markersize=9)
        axis.set(xlabel="training episodes", ylabel="fraction not converged", ylim=(-0.04, 1.04))
        axis.set_xlim(left=0)
        legend_above(axis, columns=2)
        return _svg(figure, f"fraction of the runs of {task} that have not converged, over the training episodes")


def held_out(data: ReportData) -> str:
    """Return the held-out success at each seed's last checkpoint, with Wilson intervals; baseline policies are gray."""
    rows, keys = data.held_out, ["study", "method", "policy", "seed", "eval_set"]
    rows = rows[rows["after_episodes"] == rows.groupby(keys)["after_episodes"].transform("max")]
    groups = list(rows.groupby(["study", "method", "policy", "eval_set"], sort=False))
    has_studies, has_eval_sets = rows["study"].nunique() > 1, rows["eval_set"].nunique() > 1
    with matplotlib.rc_context(STYLE):
        figure, axes = new_figure(1, 1, (1.35 * SIZE[0], 0.6 + 0.13 * len(rows) + 0.2 * len(groups)))
        axis, place, ticks = axes[0, 0], 0.0, []
        for (study, method, policy, eval_set), group in groups:
            first = place
            for row in group.itertuples():
                low, high = wilson(row.successes, row.episodes)
                shade = "#1f77b4" if policy == LEARNED else "0.6"
                axis.plot([low, high], [place, place], color=shade, linewidth=2, alpha=0.55, solid_capstyle="butt")
                axis.plot(row.successes / row.episodes, place, "o", color=shade, markersize=4)
                place -= 1.0
            parts = [str(method), *([] if policy == LEARNED else [str(policy)])]
            parts += [str(study)] * has_studies + [str(eval_set)] * has_eval_sets
            ticks.append((0.5 * (first + place + 1.0), ", ".join(dict.fromkeys(parts))))
            place -= 1.5
        axis.set_yticks([at for at, _ in ticks], [text for _, text in ticks])
        axis.set(
            xlim=(-0.02, 1.02),
            ylim=(place + 1.5, 1.0),
            xlabel="success on held-out episodes, each seed with its 95 % interval",
        )
        axis.grid(axis="x", color="0.9")
        axis.set_axisbelow(True)
        return _svg(figure, "success on held-out episodes, each seed with its Wilson interval")


def _label(name: str, runs: list[Run]) -> str:
    return f"{name} ({len(runs)} seed{'s' if len(runs) > 1 else ''})"


def _svg(figure: Any, description: str) -> str:
    """Return a figure as an SVG element, which keeps its aspect ratio at any width."""
    content = io.StringIO()
    figure.savefig(content, format="svg", metadata={"Date": None, "Creator": None})
    text = content.getvalue()
    text = text[text.index("<svg") :]
    return text.replace("<svg ", f'<svg role="img" aria-label="{escape(description)}" ', 1)
