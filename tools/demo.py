"""`guiderail demo`: a skill learned before your eyes, and what it leaves behind."""

import shutil
import time
from pathlib import Path
from typing import Any, cast

import numpy as np
from rich.console import Console

from guiderail.models.errors import InputError
from guiderail.models.policy import Policy
from guiderail.tools.guidance import COLOURS
from guiderail.tools.learning.configure import run
from guiderail.tools.learning.progress import TOLERANCE
from guiderail.tools.learning.run_folder import RunFolder
from guiderail.tools.rollouts.rollout import run_episode, standing_still
from guiderail.tools.tasks import make_environment
from guiderail.tools.viewing.passage import avoided_from, draw_world
from guiderail.tools.viewing.style import new_figure, save_figure

HELD_OUT = 10  # episodes that the result is judged on
SEED = 1_000_000
PRESET = "steady"


def run_demo(out: Path, *, episodes: int, seed: int) -> None:
    """Learns to avoid an obstacle in the narrow passage by sKGRL with TQC, and says what came of it.

    Args:
        out: the run's folder; a demo that is there already is replaced, anything else is left alone.
        episodes: how many to learn from.
        seed: of everything random.

    Raises:
        InputError: if the folder holds something else than a demo, or a number is out of range.
    """
    started = time.perf_counter()
    console = Console(soft_wrap=True, highlight=False)
    console.print(
        "A robot was shown nine times how to get through a narrow passage. Then an obstacle was put into its way,\n"
        "and a zone was forbidden. It now learns by trial and error to go around the one, and never enters the other."
    )
    _clear(out)
    summary = run("NarrowPassage", out, environment={"guidance": "skgrl"}, preset=PRESET, episodes=episodes, seed=seed)
    before, after = _judge(out)
    picture = _draw(out, before, after)
    rows = RunFolder(out).episodes()
    avoided = avoided_from(rows)
    violations = sum(row["worst_violation"] > TOLERANCE or row["worst_measured_violation"] > TOLERANCE for row in rows)
    console.print(f"\nWhat came of it, in {time.perf_counter() - started:.0f} s:")
    for line in (
        f"{sum(row['success'] for row in rows)} of {len(rows)} training episodes reached the goal, "
        f"{violations} violated the constraint, {sum(row['collisions'] > 0 for row in rows)} touched a wall.",
        "It did not learn to keep clear of the obstacle: give it more --episodes."
        if avoided is None
        else f"From episode {avoided} on it kept clear of the obstacle while still exploring.",
        f"What it learned, from {HELD_OUT} starts that it never trained from: {_outcome(after)}.",
        f"The demonstrations alone, from the same starts: {_outcome(before)}.",
    ):
        console.print(f"  · {line}")
    console.print("\nWhat it left:")
    for path, what in (
        (picture, "the paths before and after learning, and what learning earned"),
        (summary["replay"], "the same in three dimensions, moving: open it in a browser"),
        (out / "episodes.csv", "every training episode: return, success, violations, forces, jerk"),
        (out / "learning_curve.png", "the same, drawn"),
    ):
        console.print(f"  {path}\n      {what}")
    console.print(f"\nNext: guiderail evaluate {out}, guiderail reproduce 5.6, guiderail train --help")


def _clear(out: Path) -> None:
    """Removes an earlier demo, and nothing else."""
    if not out.exists():
        return
    folder = RunFolder(out)
    try:
        config = folder.config()
    except InputError:
        config = None
    if config is None or config.task != "NarrowPassage" or config.preset != PRESET:
        folder.refuse_existing()
        return
    shutil.rmtree(out)


def _judge(out: Path) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Held-out episodes of the demonstration alone and of the policy: rows, each with its `path`."""
    folder = RunFolder(out)
    config = folder.config()
    env = make_environment(config.task, config.environment)
    env.reset(seed=config.seed)
    judged = []
    for act in (standing_still(env), Policy.load(out)):
        rows = []
        for index in range(HELD_OUT):
            row = run_episode(env, act, held_out_seed=SEED + index, episode=index)
            rows.append(row | {"path": cast(Any, env.unwrapped).trace.measured.copy()})
        judged.append(rows)
    env.close()
    return judged[0], judged[1]


def _outcome(rows: list[dict[str, Any]]) -> str:
    success = np.mean([row["success"] for row in rows])
    cost = np.mean([row["reward_obstacle_cost"] for row in rows])
    return f"{success:.0%} reach the goal, obstacle cost {abs(cost):.1f}, return {_mean_return(rows):.1f}"


def _mean_return(rows: list[dict[str, Any]]) -> float:
    return float(np.mean([row["return"] for row in rows]))


def _draw(out: Path, before: list[dict[str, Any]], after: list[dict[str, Any]]) -> Path:
    """The plane with the paths before and after, and the return over the episodes."""
    figure, ((plane, curve),) = new_figure(1, 2, (11, 5.2))
    draw_world(plane)
    for index, row in enumerate(after):
        plane.plot(*row["path"].T, color=COLOURS["skgrl"], linewidth=1.2, label="" if index else "after learning")
    plane.plot(*before[0]["path"].T, color="black", linewidth=1.2, label="before learning")
    plane.legend(frameon=False, loc="upper left", fontsize=8)
    rows = RunFolder(out).episodes()
    episodes = np.arange(1, len(rows) + 1)
    curve.plot(episodes, [row["return"] for row in rows], "o-", markersize=3, color=COLOURS["skgrl"], label="return")
    curve.plot(episodes, [row["reward_obstacle_cost"] for row in rows], color="saddlebrown", label="obstacle cost")
    curve.axhline(_mean_return(before), color="black", linewidth=0.8, linestyle=":", label="return before learning")
    curve.set(xlabel="training episode")
    curve.legend(frameon=False, fontsize=8)
    return save_figure(figure, out / "picture.png")
