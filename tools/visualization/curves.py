"""Learning curve of a run: success, return and its terms, constraint violation, force and jerk over the episodes."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Circle, Rectangle

from guiderail.models.common.errors import InputError
from guiderail.models.objects.narrow_passage import demonstrations as narrow_passage
from guiderail.models.objects.narrow_passage.geometry import PassageGeometry
from guiderail.tools.evaluation.metrics import VIOLATION, WORDS, episodes_to_convergence
from guiderail.tools.learning.run_folder import RunFolder
from guiderail.tools.visualization.style import color, legend_above, new_figure, rolling, save_figure


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
        for index, path in enumerate(narrow_passage.load().outputs):
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
