"""Runs that figures share: trained where they are not there yet, and drawn the same way everywhere."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from guiderail.tools.guidance import COLOURS, NAMES
from guiderail.tools.learning.configure import configure
from guiderail.tools.learning.run_folder import RunFolder
from guiderail.tools.studies.study import Job, run_jobs
from guiderail.tools.viewing.style import draw_runs


def train_all(
    out: Path,
    task: str,
    guidance: Sequence[str],
    *,
    seeds: int,
    episodes: int,
    preset: str,
    environment: Mapping[str, Any],
    evaluations: int = 0,
) -> list[dict[str, Any]]:
    """One row for each guidance and seed; `rows` in it are the run's episodes. Runs that are there are used again."""
    jobs = []
    for kind in guidance:
        for seed in range(seeds):
            arguments = {"guidance": kind, **environment}
            config = configure(task, arguments, preset=preset, episodes=episodes, seed=seed)
            words = [kind, *(f"{key}-{value}" for key, value in environment.items()), preset, str(episodes), str(seed)]
            jobs.append(Job(kind, config, out / "runs" / task / "-".join(words), evaluations))
    return [result | {"rows": RunFolder(result["folder"]).episodes()} for result in run_jobs(jobs)]


def runs_of(results: Sequence[Mapping[str, Any]], kind: str, column: str) -> list[list[float]]:
    """A column of `episodes.csv` of every run of one guidance."""
    return [[row[column] for row in result["rows"]] for result in results if result["name"] == kind]


def mean_of_last(results: Sequence[Mapping[str, Any]], kind: str, column: str, episodes: int = 10) -> float:
    """The mean over seeds and the last episodes."""
    return float(np.mean([run[-episodes:] for run in runs_of(results, kind, column)]))


def draw_learning(
    axis: Axes,
    results: Sequence[Mapping[str, Any]],
    guidance: Sequence[str],
    column: str,
    label: str,
    window: int = 5,
) -> None:
    """One curve a guidance: the mean over seeds, with their range."""
    for kind in guidance:
        draw_runs(axis, runs_of(results, kind, column), colour=COLOURS[kind], label=NAMES[kind], window=window)
    axis.set(xlabel="episode", ylabel=label)


def of_each_seed(rows: Sequence[Mapping[str, Any]], kind: str, column: str, form: str = "{}") -> str:
    """A column of a table of every seed of a method: failures of single seeds are not averaged away."""
    return ", ".join(
        "never" if row[column] is None else form.format(row[column]) for row in rows if row["method"] == kind
    )


def table_row(result: Mapping[str, Any], **more: Any) -> dict[str, Any]:
    """A run's row in a figure's table: everything of its summary, and what a figure adds."""
    kept = {key: value for key, value in result.items() if key not in ("rows", "name", "folder")}
    return {"method": result["name"], **kept, **more}
