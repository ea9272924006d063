"""Figures 3.10 and 3.11: the grid clamp learned with and without the cost of force, in simulation."""

from pathlib import Path
from typing import Any

import numpy as np

from guiderail.tools.figures import runs
from guiderail.tools.learning.configure import configure
from guiderail.tools.learning.run_folder import RunFolder
from guiderail.tools.studies.clamp_study import ALGORITHM, LEARNED, PRESET, TASK
from guiderail.tools.studies.study import Job, run_jobs, write_table
from guiderail.tools.viewing.style import draw_runs, legend, new_figure, save_figure

EPISODES, EVALUATIONS, WINDOW = 50, 25, 5
METHODS = {"sct": ("with the cost of force", "#2ca02c"), "sct_no_force": ("without it", "#d62728")}
CONDITION = (
    "in simulation, on rails, SAC with the clamp preset; a hidden offset of the table of 1.8 to 2.2 mm per run and six "
    "grasp offsets of up to 1 mm; the thesis: a real robot, five sessions of 70 episodes"
)


def figure_3_10(out: Path, seeds: int = 3, episodes: int = EPISODES) -> dict[str, Any]:
    """Success, mean squared force of each episode, and its length."""
    results = _train(out, seeds, episodes)
    figure, (axes,) = new_figure(1, 3, (13, 4))
    for axis, (column, label) in zip(
        axes,
        (
            ("success", "success"),
            ("mean_squared_force", "mean squared force [N²]"),
            ("steps", "control steps of 20 ms"),
        ),
        strict=True,
    ):
        _draw(axis, results, column, label)
    legend(figure, axes[0])
    rows = [_table_row(result) for result in results]
    force = {kind: np.array([row["squared_force"] for row in rows if row["method"] == kind]) for kind in METHODS}
    return {
        "picture": str(save_figure(figure, out / "figure_3_10.png")),
        "table": str(write_table(out / "figure_3_10", rows)),
        **_learned(rows),
        "squared force with its cost, as a part of that without, each seed": ", ".join(
            f"{part:.2f}" for part in force["sct"] / force["sct_no_force"]
        ),
        "condition": CONDITION,
    }


def figure_3_11(out: Path, seeds: int = 3, episodes: int = EPISODES) -> dict[str, Any]:
    """The rewards gained: each by its own reward, so that one is not above the other for being better."""
    results = _train(out, seeds, episodes, evaluations=0)
    figure, ((axis,),) = new_figure(1, 1, (7, 4.2))
    _draw(axis, results, "return", "return of an episode")
    legend(figure, axis)
    rows = [_table_row(result) for result in results]
    return {
        "picture": str(save_figure(figure, out / "figure_3_11.png")),
        "table": str(write_table(out / "figure_3_11", rows)),
        **{
            f"{words}, return of the last ten episodes, each seed": runs.of_each_seed(
                rows, kind, "return_last_10", "{:.1f}"
            )
            for kind, (words, _) in METHODS.items()
        },
        "condition": CONDITION,
    }


def _train(out: Path, seeds: int, episodes: int, evaluations: int = EVALUATIONS) -> list[dict[str, Any]]:
    """A row for each method and seed, with the run's episodes as `rows`; finished runs are used again."""
    jobs = []
    for kind in METHODS:
        for seed in range(seeds):
            config = configure(TASK, LEARNED[kind], algorithm=ALGORITHM, preset=PRESET, episodes=episodes, seed=seed)
            jobs.append(Job(kind, config, out / "runs" / TASK / f"{kind}-{PRESET}-{episodes}-{seed}", evaluations))
    return [result | {"rows": RunFolder(result["folder"]).episodes()} for result in run_jobs(jobs)]


def _draw(axis: Any, results: list[dict[str, Any]], column: str, label: str) -> None:
    for kind, (words, colour) in METHODS.items():
        draw_runs(axis, runs.runs_of(results, kind, column), colour=colour, label=words, window=WINDOW)
    axis.set(xlabel="episode", ylabel=label)


def _table_row(result: dict[str, Any]) -> dict[str, Any]:
    """A run's row: its summary, and the mean squared force over all of training and over the last ten episodes."""
    force = [row["mean_squared_force"] for row in result["rows"]]
    return runs.table_row(
        result, squared_force=float(np.mean(force)), squared_force_last_10=float(np.mean(force[-10:]))
    )


def _learned(rows: list[dict[str, Any]]) -> dict[str, str]:
    """Each seed's own numbers."""
    said = {}
    for kind, (words, _) in METHODS.items():
        said[f"{words}, ten in a row after episode"] = runs.of_each_seed(rows, kind, "converged_after")
        said[f"{words}, held-out success"] = runs.of_each_seed(rows, kind, "held_out_success", "{:.0%}")
        said[f"{words}, squared force of each seed [N²]"] = runs.of_each_seed(rows, kind, "squared_force", "{:.1f}")
    return said
