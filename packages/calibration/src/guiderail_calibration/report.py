"""Page of a calibration: posterior, sensitivities, recorded against simulated signals, and prediction."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jinja2
import matplotlib
import numpy as np

from guiderail.diagrams.stations.station import CONTROL_PERIOD
from guiderail.tools.visualization.figures import new_figure
from guiderail_calibration.inference import describe_check
from guiderail_calibration.prediction import LEVEL
from guiderail_calibration.recordings import Episode
from guiderail_studies.report import STYLE, to_svg

PAGE = jinja2.Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True).from_string(
    Path(__file__).with_name("report.html").read_text(encoding="utf-8")
)
RECORDED, SIMULATED = "#1c1f24", "#1f5fbf"


def render(task: str, calibration: Any) -> str:
    """Return the text of the page of a `Calibration` for a task."""
    return PAGE.render(
        task=task,
        episodes=len(calibration.recordings),
        check=describe_check(calibration.is_explained, calibration.p_value),
        is_explained=calibration.is_explained,
        level=f"{LEVEL:.0%}",
        rows=[
            {name: value if isinstance(value, str) else f"{value:.3g}" for name, value in row.items()}
            for row in calibration.intervals()
        ],
        left_out=calibration.left_out,
        prediction=calibration.prediction,
        posterior=_posterior(calibration),
        signals=_signals(calibration.recordings, calibration.simulated),
    )


def _posterior(calibration: Any) -> str:
    """Return histograms of the posterior over the range of each prior."""
    columns = 4
    count = len(calibration.parameters)
    with matplotlib.rc_context(STYLE):
        figure, axes = new_figure(-(-count // columns), columns, (9.2, 1.7 * -(-count // columns)))
        for index, axis in enumerate(axes.flat):
            if index >= count:
                axis.set_axis_off()
                continue
            parameter = calibration.parameters[index]
            color = SIMULATED if calibration.identifiable[index] else "0.75"
            axis.hist(calibration.quantiles[:, index], bins=np.linspace(0.0, 1.0, 26), density=True, color=color)
            axis.axhline(1.0, color="0.5", linestyle="--", linewidth=0.8)
            ticks = np.array([0.0, 0.5, 1.0])
            axis.set_xticks(ticks, [f"{value:.3g}" for value in parameter.value(ticks)])
            axis.set_yticks([])
            axis.set_title(parameter.axis.label, fontsize=8.5)
        return to_svg(figure, "posterior of each parameter; the dashed line is its prior")


def _signals(recorded: Sequence[Episode], simulated: Sequence[Episode]) -> str:
    """Return recorded forces and tracking errors, and those of draws of the posterior, over time."""
    with matplotlib.rc_context(STYLE):
        figure, axes = new_figure(2, 3, (9.2, 4.0))
        for episodes, color, width, name in (
            (simulated, SIMULATED, 0.9, "simulated"),
            (recorded, RECORDED, 0.7, "recorded"),
        ):
            for number, episode in enumerate(episodes[:3]):
                times = CONTROL_PERIOD * np.arange(len(episode))
                text = name if number == 0 else None
                for index, letter in enumerate("xyz"):
                    force, error = axes[0, index], axes[1, index]
                    force.plot(times, episode.wrench[:, index], color=color, linewidth=width, label=text)
                    difference = 1e3 * (episode.desired[:, index] - episode.pose[:, index])
                    error.plot(times, difference, color=color, linewidth=width)
                    force.set_title(f"force along {letter} [N]", fontsize=8.5)
                    error.set_title(f"tracking error along {letter} [mm]", fontsize=8.5)
                    error.set_xlabel("time [s]")
        axes[0, 0].legend(frameon=False, fontsize=8)
        return to_svg(figure, "recorded and simulated forces and tracking errors")
