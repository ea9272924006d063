"""A run's learning curve: what was learned, and what it cost on the way."""

from pathlib import Path

import numpy as np

from guiderail.models.errors import InputError
from guiderail.tools.guidance import colour
from guiderail.tools.learning.run_folder import RunFolder
from guiderail.tools.rollouts.metrics import WORDS, converged_after
from guiderail.tools.viewing.style import new_figure, rolling, save_figure

DRAWN = {
    "success", "return", "worst_violation", "worst_measured_violation", "peak_force", "mean_force",
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
    converged = converged_after(rows)
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
        (violation, "worst constraint violation\n(negative is slack)", "worst_violation", "worst_measured_violation"),
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
