"""Figures 4.4, 4.5 and 4.6: residual learning, safe residual learning and KGRL in the narrow passage."""

from pathlib import Path
from typing import Any

import numpy as np

from guiderail.tools.figures import passage, runs
from guiderail.tools.guidance import COLOURS, NAMES
from guiderail.tools.rollouts.rollout import run_episode
from guiderail.tools.studies.study import write_table
from guiderail.tools.tasks import make_environment
from guiderail.tools.viewing.passage import draw_world
from guiderail.tools.viewing.style import legend, new_figure, save_figure

METHODS = ("residual", "safe_residual", "kgrl")
EPISODES = 60


def figure_4_4(out: Path, seeds: int = 3, episodes: int = 10) -> dict[str, Any]:
    """Where random exploration takes the robot, and how that depends on how long an action lasts.

    Args:
        out: the folder.
        seeds: of the random actions.
        episodes: of each seed.
    """
    figure, (axes,) = new_figure(1, 3, (11, 5.2))
    rows: list[dict[str, Any]] = []
    for axis, kind in zip(axes, METHODS, strict=True):
        draw_world(axis)
        axis.set_title(NAMES[kind])
        for hold in (passage.HOLD, 1):
            explored = _explore(kind, hold, seeds, episodes)
            rows.append({"method": NAMES[kind], "hold": hold, **_counted([row for row, _ in explored])})
            if hold == passage.HOLD:
                for _, poses in explored:
                    axis.plot(*poses.T, ".", markersize=1.5, color=COLOURS[kind], alpha=0.35)
    return {
        "picture": str(save_figure(figure, out / "figure_4_4.png")),
        "table": str(write_table(out / "figure_4_4", rows)),
        **{f"{row['method']}, an action lasts {row['hold']}": f"{row['success']:.0%} succeed" for row in rows},
    }


def _explore(kind: str, hold: int, seeds: int, episodes: int) -> list[tuple[dict[str, Any], np.ndarray]]:
    """Episodes of uniformly random actions: their rows and the robot's positions."""
    env: Any = make_environment(passage.TASK, {"guidance": kind, "hold": hold})
    explored = []
    for seed in range(seeds):
        random = np.random.default_rng(seed)
        env.reset(seed=seed)
        for index in range(episodes):
            row = run_episode(env, lambda _: random.uniform(-1, 1, 2).astype(np.float32), episode=index)  # noqa: B023
            explored.append((row, env.unwrapped.trace.measured.copy()))
    env.close()
    return explored


def _counted(rows: list[dict[str, Any]]) -> dict[str, Any]:
    return {
        "episodes": len(rows),
        "success": float(np.mean([row["success"] for row in rows])),
        "blocked": float(np.mean([row["termination"] == "blocked" for row in rows])),
        "collisions_per_episode": float(np.mean([row["collisions"] for row in rows])),
        "episodes_in_the_zone": float(np.mean([row["worst_measured_violation"] > 1e-9 for row in rows])),
        "worst_commanded_violation": float(max(row["worst_violation"] for row in rows)),
        "worst_measured_violation": float(max(row["worst_measured_violation"] for row in rows)),
    }


def figure_4_5(out: Path, seeds: int = 3, episodes: int = EPISODES) -> dict[str, Any]:
    """Success, return and its two costs while learning."""
    results = passage.train_all(out, METHODS, seeds=seeds, episodes=episodes)
    figure, axes = new_figure(2, 2, (10, 7))
    for axis, (column, label) in zip(
        axes.flat,
        (
            ("success", "success"),
            ("return", "return"),
            ("reward_obstacle_cost", "obstacle cost"),
            ("reward_action_cost", "action cost"),
        ),
        strict=True,
    ):
        runs.draw_learning(axis, results, METHODS, column, label)
    legend(figure, axes[0, 0])
    rows = [passage.learned(result) for result in results]
    return {
        "picture": str(save_figure(figure, out / "figure_4_5.png")),
        "table": str(write_table(out / "figure_4_5", rows)),
        **_success(rows),
        "condition": f"an action lasts {passage.HOLD} control steps, and walls do not let the robot slide; figure 4.4 "
        "shows the other case",
    }


def figure_4_6(out: Path, seeds: int = 3, episodes: int = EPISODES) -> dict[str, Any]:
    """Collisions with the walls and violations of the constraint, per episode of learning."""
    results = passage.train_all(out, METHODS, seeds=seeds, episodes=episodes)
    figure, (axes,) = new_figure(1, 2, (10, 4))
    runs.draw_learning(axes[0], results, METHODS, "collisions", "wall collisions per episode", window=1)
    runs.draw_learning(axes[1], results, METHODS, "worst_measured_violation", "worst violation [m]", window=1)
    axes[1].axhline(0, color="firebrick", linewidth=0.8)
    legend(figure, axes[0])
    rows = [passage.learned(result) for result in results]
    return {
        "picture": str(save_figure(figure, out / "figure_4_6.png")),
        "table": str(write_table(out / "figure_4_6", rows)),
        **{
            NAMES[kind]: f"{sum(row['collisions'] for row in rows if row['method'] == kind):.0f} collisions, "
            f"{sum(row['episodes_with_violation'] for row in rows if row['method'] == kind)} episodes in the zone, "
            f"of {sum(row['episodes'] for row in rows if row['method'] == kind)}"
            for kind in METHODS
        },
    }


def _success(rows: list[dict[str, Any]]) -> dict[str, str]:
    return {
        f"{NAMES[kind]}, success of each seed": runs.of_each_seed(rows, kind, "success", "{:.0%}") for kind in METHODS
    }
