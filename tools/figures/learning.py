"""Figure 5.6: KGRL and sKGRL learn to avoid the obstacle."""

from pathlib import Path
from typing import Any

from guiderail.tools.figures import passage, runs
from guiderail.tools.figures.baselines import EPISODES
from guiderail.tools.pictures import NAMES, legend, new_figure, save_figure
from guiderail.tools.study import write_table

METHODS = ("kgrl", "skgrl")


def figure_5_6(out: Path, seeds: int = 3, episodes: int = EPISODES) -> dict[str, Any]:
    """Return and its two costs, success, and jerk while learning."""
    results = passage.train_all(out, METHODS, seeds=seeds, episodes=episodes)
    figure, axes = new_figure(2, 2, (10, 7))
    for axis, (column, label) in zip(
        axes.flat,
        (
            ("return", "return"),
            ("reward_obstacle_cost", "obstacle cost"),
            ("reward_action_cost", "action cost"),
            ("jerk_commanded_linear", "commanded jerk [m/s³]"),
        ),
        strict=True,
    ):
        runs.draw_learning(axis, results, METHODS, column, label)
    axes[1, 1].set_yscale("log")
    legend(figure, axes[0, 0])
    rows = [passage.learned(result) for result in results]
    returns = {kind: runs.mean_of_last(results, kind, "return") for kind in METHODS}
    actions = {kind: runs.mean_of_last(results, kind, "reward_action_cost") for kind in METHODS}
    higher = max(returns, key=lambda kind: returns[kind])
    return {
        "picture": str(save_figure(figure, out / "figure_5_6.png")),
        "table": str(write_table(out / "figure_5_6", rows)),
        **{
            f"{NAMES[kind]}, obstacle avoided from episode": runs.of_each_seed(rows, kind, "avoids_obstacle_from")
            for kind in METHODS
        },
        **{f"{NAMES[kind]}, return of the last ten": returns[kind] for kind in METHODS},
        **{f"{NAMES[kind]}, action cost of the last ten": actions[kind] for kind in METHODS},
        "the thesis's claim that sKGRL has the higher return": "holds here"
        if higher == "skgrl"
        else "does not hold here",
        "condition": f"an action lasts {passage.HOLD} control steps; the obstacle's cost is part of the return",
    }
