"""Figure 5.6: KGRL and sKGRL learn to avoid the obstacle."""

from pathlib import Path
from typing import Any

from guiderail.tools.figures import passage, runs
from guiderail.tools.figures.baselines import EPISODES
from guiderail.tools.guidance import NAMES
from guiderail.tools.studies.study import write_table
from guiderail.tools.viewing.style import legend, new_figure, save_figure

METHODS = ("kgrl", "skgrl")
STEADY = "steady"


def figure_5_6(out: Path, seeds: int = 3, episodes: int = EPISODES) -> dict[str, Any]:
    """Return and its two costs, and jerk while learning.

    Drawn for runs whose first ten episodes each keep to one random action; the table also has those that explore anew
    at every decision, as sKGRL then depends on the seed.
    """
    results = passage.train_all(out, METHODS, seeds=seeds, episodes=episodes, preset=STEADY)
    restless = passage.train_all(out, METHODS, seeds=seeds, episodes=episodes)
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
    said: dict[str, Any] = {}
    rows = []
    for words, group in (("first ten episodes steady", results), ("exploring anew at every decision", restless)):
        learned = [passage.learned(result) for result in group]
        rows += [{"exploration": words, **row} for row in learned]
        for kind in METHODS:
            avoided = runs.of_each_seed(learned, kind, "avoids_obstacle_from")
            said[f"{NAMES[kind]}, {words}: obstacle avoided from episode"] = avoided
            said[f"{NAMES[kind]}, {words}: return of the last ten"] = runs.mean_of_last(group, kind, "return")
            said[f"{NAMES[kind]}, {words}: action cost"] = runs.mean_of_last(group, kind, "reward_action_cost")
        returns = {kind: runs.mean_of_last(group, kind, "return") for kind in METHODS}
        higher = "yes" if returns["skgrl"] > returns["kgrl"] else "no, not here"
        said[f"sKGRL has the higher return, as in the thesis ({words})"] = higher
    return {
        "picture": str(save_figure(figure, out / "figure_5_6.png")),
        "table": str(write_table(out / "figure_5_6", rows)),
        **said,
        "condition": f"an action lasts {passage.HOLD} control steps; the obstacle's cost is part of the return",
    }
