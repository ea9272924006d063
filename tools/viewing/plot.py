"""A run's learning curve: what was learned, and what it cost on the way."""

from pathlib import Path

import numpy as np

from guiderail.models.errors import InputError
from guiderail.tools.guidance import colour
from guiderail.tools.learning.run_folder import RunFolder
from guiderail.tools.rollouts.metrics import converged_after
from guiderail.tools.viewing.style import new_figure, rolling, save_figure


def plot_run(run: Path) -> Path:
    """Draws `learning_curve.png` from `episodes.csv`: success, return, violations and force over the episodes.

    Raises:
        InputError: if there is no run, or no finished episode in it.
    """
    folder = RunFolder(run)
    config, rows = folder.config(), folder.episodes()
    if not len(rows):
        raise InputError(f"{run} has no finished episode yet: let it train, then plot it")
    column = {key: rows[key].to_numpy(float) for key in rows.columns.drop("termination")}
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
    violation.plot(episodes, column["worst_violation"], color=line, label="commanded")
    violation.plot(episodes, column["worst_measured_violation"], color="0.5", linewidth=1, label="measured")
    violation.axhline(0, color="firebrick", linewidth=0.8)
    violation.set(ylabel="worst constraint violation\n(negative is slack)")
    force.plot(episodes, column["peak_force"], color=line, label="peak")
    force.plot(episodes, column["mean_force"], color="0.5", linewidth=1, label="mean")
    force.set(ylabel="contact force [N]")
    jerk.plot(episodes, column["jerk_commanded_linear"], color=line, label="commanded")
    jerk.plot(episodes, column["jerk_measured_linear"], color="0.5", linewidth=1, label="measured")
    jerk.set(ylabel="mean jerk [m/s³]", yscale="log" if (column["jerk_commanded_linear"] > 0).all() else "linear")
    for axis in (terms, violation, force, jerk):
        axis.legend(frameon=False, fontsize=8)
    for axis in axes[1]:
        axis.set_xlabel("episode")
    figure.suptitle(f"{config.task} · {guidance} · {config.learner.algorithm.upper()} · seed {config.seed}")
    return save_figure(figure, folder.path / "learning_curve.png")
