"""A run's learning curve: what was learned, and what it cost on the way."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Circle, Rectangle

from guiderail.models.common.errors import InputError
from guiderail.models.objects.narrow_passage import demonstrations as narrow_passage
from guiderail.models.objects.narrow_passage.geometry import PassageGeometry
from guiderail.tools.evaluation.metrics import WORDS, episodes_to_convergence
from guiderail.tools.learning.run_folder import RunFolder
from guiderail.tools.visualization.style import colour, new_figure, rolling, save_figure


def draw_world(axis: Axes, demonstrations: bool = True, *, named: bool = False) -> None:
    """Walls, zone, obstacle, goal and, in grey, what was demonstrated; `named`: each has a name for a legend."""
    world = PassageGeometry()
    zone, obstacle, goal, shown = ("forbidden zone", "obstacle", "goal", "is_demonstration") if named else 4 * ("",)
    for lower, upper in zip(*world.walls, strict=True):
        axis.add_patch(Rectangle(tuple(lower), *(upper - lower), color="0.45", linewidth=0))
    axis.add_patch(Rectangle((world.zone_x, -1), 2, 3, color="firebrick", alpha=0.12, linewidth=0, label=zone))
    axis.axvline(world.zone_x, color="firebrick", linewidth=0.8)
    axis.add_patch(Circle(world.obstacle, world.obstacle_radius, color="saddlebrown", label=obstacle))
    axis.add_patch(Circle(world.goal, world.goal_radius, color="tab:green", alpha=0.4, label=goal))
    if demonstrations:
        for index, path in enumerate(narrow_passage.load().outputs):
            axis.plot(*path.T, color="0.75", linewidth=0.6, label="" if index else shown)
    axis.set(xlim=(0.1, 0.8), ylim=(0.0, 1.02), aspect="equal", xlabel="x [m]", ylabel="y [m]")


DRAWN = {
    "success", "return", "max_commanded_violation", "max_measured_violation", "peak_force", "mean_force",
    "jerk_commanded_linear", "jerk_measured_linear",
}  # fmt: skip


def plot_run(run: Path) -> Path:
    """Draws `learning_curve.png` from `episodes.csv`: success, return, violations and force over the episodes.

    Raises:
        InputError: if there is no run, or no finished episode in it.
    """
    folder = RunFolder(run)
    config, rows = folder.config(), folder.episodes()
    if not len(rows):
        raise InputError(f"{run} has no finished episode yet: let it train, then plot it")
    column = {key: rows[key].to_numpy(float) for key in rows.columns.drop(list(WORDS), errors="ignore")}
    if missing := sorted(DRAWN - column.keys()):
        raise InputError(f"{folder.path} is of another version: its episodes have no {missing[0]}; train anew")
    episodes = np.arange(1, len(rows) + 1)
    guidance = config.environment.get("guidance", "")
    line = colour(guidance)

    figure, axes = new_figure(2, 3, (13, 6))
    success, returns, terms, violation, force, jerk = axes.flat
    success.plot(episodes, rolling(column["success"]), color=line)
    success.scatter(episodes, column["success"], s=6, color=line, alpha=0.4)
    success.set(ylabel="success (mean of 10)", ylim=(-0.05, 1.05))
    converged = episodes_to_convergence(rows)
    if converged is not None:
        success.axvline(converged + 0.5, color="0.6", linestyle=":")
        success.set_title(f"ten in a row succeed after episode {converged}", fontsize=9)
    returns.plot(episodes, column["return"], color=line, alpha=0.3)
    returns.plot(episodes, rolling(column["return"]), color=line)
    returns.set(ylabel="return (faint: each episode)")
    for name, values in column.items():
        if name.startswith("reward_"):
            terms.plot(episodes, values, label=name.removeprefix("reward_").replace("_", " "))
    terms.set(ylabel="terms of the return")
    for axis, words, first, second in (
        (
            violation,
            "worst constraint violation\n(negative is slack)",
            "max_commanded_violation",
            "max_measured_violation",
        ),
        (force, "contact force [N]", "peak_force", "mean_force"),
        (jerk, "mean jerk [m/s³]", "jerk_commanded_linear", "jerk_measured_linear"),
    ):
        names = ("peak", "mean") if axis is force else ("commanded", "measured")
        axis.plot(episodes, column[first], color=line, label=names[0])
        axis.plot(episodes, column[second], color="0.5", linewidth=1, label=names[1])
        axis.set(ylabel=words)
    violation.axhline(0, color="firebrick", linewidth=0.8)
    force.set_ylim(0.0, max(1.0, force.get_ylim()[1]))  # nothing was touched: that is a flat line, and no noise
    jerk.set(yscale="log" if (column["jerk_commanded_linear"] > 0).all() else "linear")
    for axis in (terms, violation, force, jerk):
        axis.legend(frameon=False, fontsize=8)
    for axis in axes[1]:
        axis.set_xlabel("episode")
    figure.suptitle(f"{config.task} · {guidance} · {config.learner.algorithm.upper()} · seed {config.seed}")
    return save_figure(figure, folder.path / "learning_curve.png")
