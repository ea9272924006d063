"""`guiderail demo`: a skill learned before your eyes, and what it leaves behind."""

import shutil
import sys
import time
from pathlib import Path

import numpy as np
import pandas as pd
from rich.console import Console

from guiderail.models.policy import Policy
from guiderail.tools.environments import make_environment
from guiderail.tools.evaluation.baselines import still
from guiderail.tools.evaluation.metrics import TOLERANCE, avoids_obstacle_from
from guiderail.tools.evaluation.rollout import Paths, rollout
from guiderail.tools.files import write_atomically
from guiderail.tools.learning.run_folder import RunFolder
from guiderail.tools.learning.train import run
from guiderail.tools.visualization.curves import draw_world
from guiderail.tools.visualization.style import colour, new_figure, save_figure

HELD_OUT = 10  # episodes that the result is judged on
SEED = 1_000_000
PRESET = "tqc_cheap_correlated"
MARK = ".demo"  # a file in the folder of a demo: nothing without it is removed


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
    write_atomically(out / MARK, b"")
    summary = run(
        "NarrowPassage",
        out,
        environment={"guidance": "skgrl"},
        preset=PRESET,
        settings={"pipelined": True},
        episodes=episodes,
        seed=seed,
    )
    before, after = _evaluate(out)
    picture = _draw(out, before, after)
    rows = RunFolder(out).episodes()
    avoided = avoids_obstacle_from(rows)
    violations = (rows[["max_commanded_violation", "max_measured_violation"]].max(axis=1) > TOLERANCE).sum()
    console.print(f"\nWhat came of it, in {time.perf_counter() - started:.0f} s:")
    for line in (
        f"{rows['success'].sum()} of {len(rows)} training episodes reached the goal, "
        f"{violations} violated the constraint, {(rows['collisions'] > 0).sum()} touched a wall.",
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
    called = _called()
    console.print(f"\nNext: {called} evaluate {out}, {called} reproduce 5.6, {called} train --help")


def _called() -> str:
    """What to write for this command: its path where the shell does not find it by its name."""
    path = Path(sys.argv[0])
    return str(path) if path.name == "guiderail" and shutil.which("guiderail") is None else "guiderail"


def _clear(out: Path) -> None:
    """Removes an earlier demo, and nothing else."""
    if (out / MARK).is_file():
        shutil.rmtree(out)
    RunFolder(out).refuse_existing()


def _evaluate(out: Path) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Held-out episodes of the demonstration alone and of the policy: rows with paths."""
    config = RunFolder(out).config()
    env = make_environment(config.task, config.environment)
    env.reset(seed=config.seed)
    tables = [
        pd.DataFrame([rollout(env, act, Paths(env), index=i, seed=SEED + i, held_out=True) for i in range(HELD_OUT)])
        for act in (still(env), Policy.load(out))
    ]
    env.close()
    return tables[0], tables[1]


def _outcome(rows: pd.DataFrame) -> str:
    reach, earned, near = (rows[name].mean() for name in ("success", "return", "reward_obstacle_cost"))
    return f"{reach:.0%} reach the goal, return {earned:.1f}, {near:+.1f} of it at the obstacle"


def _draw(out: Path, before: pd.DataFrame, after: pd.DataFrame) -> Path:
    """The plane with the paths before and after, and the return over the episodes."""
    figure, ((plane, curve),) = new_figure(1, 2, (11, 5.2))
    draw_world(plane, named=True)
    for index, path in enumerate(after["measured"]):
        plane.plot(*path.T, color=colour("skgrl"), linewidth=1.2, label="" if index else "after learning")
    plane.plot(*before["measured"][0].T, color="black", linewidth=1.2, label="before learning")
    plane.legend(frameon=False, loc="upper center", bbox_to_anchor=(0.5, -0.12), ncols=3, fontsize=8)
    rows = RunFolder(out).episodes()
    episodes = np.arange(1, len(rows) + 1)
    curve.plot(episodes, rows["return"], "o-", markersize=3, color=colour("skgrl"), label="return")
    curve.plot(episodes, rows["reward_obstacle_cost"], color="saddlebrown", label="of it at the obstacle")
    curve.axhline(before["return"].mean(), color="black", linewidth=0.8, linestyle=":", label="return before learning")
    curve.set(xlabel="training episode")
    curve.legend(frameon=False, fontsize=8)
    return save_figure(figure, out / "picture.png")
