"""Figure 4.7: KGRL learns from rendered images."""

from pathlib import Path
from typing import Any

from guiderail.tools.figures import passage, runs
from guiderail.tools.studies.study import write_table
from guiderail.tools.viewing.style import new_figure, save_figure


def figure_4_7(out: Path, seeds: int = 3, episodes: int = 30) -> dict[str, Any]:
    """Return, obstacle cost and success over 30 episodes, where all that the policy sees is a picture."""
    results = passage.train_all(out, ("kgrl",), seeds=seeds, episodes=episodes, observation="image")
    figure, (axes,) = new_figure(1, 3, (13, 3.8))
    for axis, (column, label) in zip(
        axes, (("return", "return"), ("reward_obstacle_cost", "obstacle cost"), ("success", "success")), strict=True
    ):
        runs.draw_learning(axis, results, ("kgrl",), column, label)
    rows = [passage.learned(result) for result in results]
    return {
        "picture": str(save_figure(figure, out / "figure_4_7.png")),
        "table": str(write_table(out / "figure_4_7", rows)),
        "success of each seed": runs.of_each_seed(rows, "kgrl", "success", "{:.0%}"),
        "obstacle avoided from episode": runs.of_each_seed(rows, "kgrl", "avoids_obstacle_from"),
        "condition": f"an action lasts {passage.HOLD} control steps; pixels are averaged five by five",
    }
