"""What the figures on the narrow passage share: its runs, its drawing, and the words for what was found."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Circle, Rectangle

from guiderail.models.demonstrations import narrow_passage
from guiderail.models.objects.narrow_passage import NarrowPassage
from guiderail.tools.pictures import COLOURS, NAMES, draw_runs
from guiderail.tools.run_folder import RunFolder
from guiderail.tools.study import Job, run_jobs
from guiderail.tools.training import configure

TASK = "NarrowPassage"
HOLD = 5  # control steps of an action, unless a figure says otherwise
PRESET = "quick"


def train_all(
    out: Path,
    guidance: Sequence[str],
    *,
    seeds: int,
    episodes: int,
    hold: int = HOLD,
    preset: str = PRESET,
    observation: str = "state",
) -> list[dict[str, Any]]:
    """One row for each guidance and seed; `rows` in it are the run's episodes. Runs that are there are used again."""
    jobs = []
    for kind in guidance:
        for seed in range(seeds):
            environment = {"guidance": kind, "hold": hold, "observation": observation}
            config = configure(TASK, environment, preset=preset, episodes=episodes, seed=seed)
            folder = out / "runs" / f"{kind}-{observation}-hold{hold}-{preset}-{episodes}-{seed}"
            jobs.append(Job(kind, config, folder))
    results = run_jobs(jobs)
    return [result | {"rows": RunFolder(result["folder"]).episodes()} for result in results]


def runs_of(results: Sequence[dict[str, Any]], kind: str, column: str) -> list[list[float]]:
    """A column of `episodes.csv` of every run of one guidance."""
    return [[row[column] for row in result["rows"]] for result in results if result["name"] == kind]


def draw_learning(
    axis: Axes, results: Sequence[dict[str, Any]], guidance: Sequence[str], column: str, label: str, window: int = 5
) -> None:
    """One curve a guidance: the mean over seeds, with their range."""
    for kind in guidance:
        draw_runs(axis, runs_of(results, kind, column), colour=COLOURS[kind], label=NAMES[kind], window=window)
    axis.set(xlabel="episode", ylabel=label)


def draw_world(axis: Axes, demonstrations: bool = True) -> None:
    """Walls, zone, obstacle, goal and, in grey, what was demonstrated."""
    world = NarrowPassage()
    for lower, upper in zip(*world.walls, strict=True):
        axis.add_patch(Rectangle(tuple(lower), *(upper - lower), color="0.45", linewidth=0))
    axis.add_patch(Rectangle((world.zone_x, -1), 2, 3, color="firebrick", alpha=0.12, linewidth=0))
    axis.axvline(world.zone_x, color="firebrick", linewidth=0.8)
    axis.add_patch(Circle(world.obstacle, world.obstacle_radius, color="saddlebrown"))
    axis.add_patch(Circle(world.goal, world.goal_radius, color="tab:green", alpha=0.4))
    if demonstrations:
        for path in narrow_passage.load().outputs:
            axis.plot(*path.T, color="0.75", linewidth=0.6)
    axis.set(xlim=(0.1, 0.8), ylim=(0.0, 1.02), aspect="equal", xlabel="x [m]", ylabel="y [m]")


def avoided_from(rows: Sequence[dict[str, Any]], cost: float = -1.0, in_a_row: int = 5) -> int | None:
    """The first training episode from which the obstacle cost stays small for five in a row; None if it never does.

    An episode along the mean path costs about a hundred; one that keeps its distance costs nothing. A policy that
    explores brushes the margin now and then, hence not zero.
    """
    good = np.array([row["reward_obstacle_cost"] > cost for row in rows])
    for start in range(len(good) - in_a_row + 1):
        if good[start : start + in_a_row].all():
            return start + 1
    return None
