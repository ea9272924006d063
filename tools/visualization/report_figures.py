"""The figures of a report, as SVG that stands in the page itself."""

from __future__ import annotations

import io
from itertools import cycle
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes

from guiderail.tools.evaluation.metrics import bootstrap_band, episodes_to_convergence, survival, wilson
from guiderail.tools.visualization.report_data import LEARNED, Gathered, Run
from guiderail.tools.visualization.style import new_figure, rolling

SIZE = (4.6, 3.0)  # in; two stand side by side, and one alone on a phone
STYLE: Any = {"svg.fonttype": "none", "svg.hashsalt": "guiderail", "font.size": 9.0}
DASHES = ("-", (0, (5, 1.5)), (0, (2, 1)), (0, (6, 1.5, 1, 1.5)))  # curves may lie on each other
WINDOW = 10  # episodes of a moving mean


def curve(gathered: Gathered, task: str, column: str, words: str) -> str:
    """A column of the training episodes: the mean over seeds of a moving mean, and its bootstrap band."""
    with matplotlib.rc_context(STYLE):
        figure, axes = new_figure(1, 1, SIZE)
        axis = axes[0, 0]
        colours = gathered.colours(task)
        for (name, runs), dash in zip(gathered.methods(task).items(), cycle(DASHES), strict=False):
            length = min(len(run.episodes) for run in runs)
            smooth = np.stack([rolling(run.episodes[column].to_numpy(float), WINDOW)[:length] for run in runs])
            episodes = np.arange(1, length + 1)
            if len(runs) > 1:
                low, high = bootstrap_band(smooth)
                axis.fill_between(episodes, low, high, color=colours[name], alpha=0.18, linewidth=0)
            axis.plot(episodes, smooth.mean(axis=0), color=colours[name], linestyle=dash, label=_label(name, runs))
        axis.set(xlabel="training episode", ylabel=f"{words}, mean of {WINDOW}")
        if column == "success":
            axis.set_ylim(-0.04, 1.04)
        _legend(axis)
        return _svg(figure, f"{words} over the training episodes of {task}")


def survival_curve(gathered: Gathered, task: str) -> str:
    """Which part of the runs has not converged yet."""
    with matplotlib.rc_context(STYLE):
        figure, axes = new_figure(1, 1, SIZE)
        axis = axes[0, 0]
        colours = gathered.colours(task)
        for (name, runs), dash in zip(gathered.methods(task).items(), cycle(DASHES), strict=False):
            after, lengths = (
                [episodes_to_convergence(run.episodes) for run in runs],
                [len(run.episodes) for run in runs],
            )
            steps, left = survival(after, lengths)
            steps, left = np.append(steps, max(lengths)), np.append(left, left[-1])
            axis.step(steps, left, where="post", color=colours[name], linestyle=dash, label=_label(name, runs))
            if None in after:
                axis.plot(steps[-1], left[-1], "|", color=colours[name], markersize=9)
        axis.set(xlabel="training episodes", ylabel="part not converged yet", ylim=(-0.04, 1.04))
        axis.set_xlim(left=0)
        _legend(axis)
        return _svg(figure, f"part of the runs of {task} that have not converged after so many episodes")


def held_out(gathered: Gathered) -> str:
    """The success of each seed on held-out episodes, with its Wilson interval; what learned nothing is grey."""
    judged, keys = gathered.held_out, ["study", "method", "policy", "seed", "eval_set"]
    rows = judged[
        judged["after_episodes"] == judged.groupby(keys)["after_episodes"].transform("max")
    ]  # after the last training episode
    groups = list(rows.groupby(["study", "method", "policy", "eval_set"], sort=False))
    with matplotlib.rc_context(STYLE):
        figure, axes = new_figure(1, 1, (1.35 * SIZE[0], 0.6 + 0.13 * len(rows) + 0.2 * len(groups)))
        axis, place, ticks = axes[0, 0], 0.0, []
        several = rows["study"].nunique() > 1, rows["eval_set"].nunique() > 1
        for (study, method, policy, judged), group in groups:
            first = place
            for row in group.itertuples():
                low, high = wilson(row.successes, row.episodes)
                shade = "#1f77b4" if policy == LEARNED else "0.6"
                axis.plot([low, high], [place, place], color=shade, linewidth=2, alpha=0.55, solid_capstyle="butt")
                axis.plot(row.successes / row.episodes, place, "o", color=shade, markersize=4)
                place -= 1.0
            words = [str(method), *([] if policy == LEARNED else [str(policy)])]
            words += [str(study)] * several[0] + [str(judged)] * several[1]
            ticks.append((0.5 * (first + place + 1.0), ", ".join(dict.fromkeys(words))))
            place -= 1.5
        axis.set_yticks([at for at, _ in ticks], [words for _, words in ticks])
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


def _legend(axis: Axes) -> None:
    axis.legend(frameon=False, fontsize=8, loc="best")


def _svg(figure: Any, words: str) -> str:
    """The figure's own element, which fits the width that it gets."""
    content = io.StringIO()
    figure.savefig(content, format="svg", metadata={"Date": None, "Creator": None})
    text = content.getvalue()
    text = text[text.index("<svg") :]
    return text.replace("<svg ", f'<svg role="img" aria-label="{words}" ', 1)
