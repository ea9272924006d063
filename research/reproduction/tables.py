"""Stored tables of the reproduction: every training episode and every evaluated episode of each run."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pandas as pd

from guiderail.models.common.errors import InputError
from guiderail.tools.files import write_atomically
from guiderail.tools.tables import read_table, table_text
from research.reproduction.runs import Runs, jobs_of

TABLES = Path(__file__).parent / "tables"
# Columns of an episode that are stored if the task has them.
COLUMNS = (
    "episode", "return", "success", "termination", "steps", "mean_squared_force", "collisions",
    "max_commanded_violation", "max_measured_violation", "reward_obstacle_cost", "reward_action_cost",
    "jerk_commanded_linear", "wall_time",
)  # fmt: skip
DIGITS = 5  # significant digits of stored numbers
ROUNDING = 1e-12  # violations up to this size are stored as 0 [m]


def store(runs: Runs, out: Path, tables: Path = TABLES) -> list[Path]:
    """Store the episodes of a study's runs so far, and return the files that were written.

    Unfinished runs are stored as well; the number of their episodes tells how far they are. A stored run stays if the
    folder does not have this run, or fewer of its episodes.
    """
    training, evaluated = [], []
    for job in jobs_of(runs, out):
        folder = job.folder.path
        if job.learns and (folder / "episodes.csv").is_file():
            training.append(_labeled(job.folder.episodes(), runs.columns, method=job.method, seed=job.seed))
        for number in job.after_episodes:
            for eval_set in job.study.eval_sets:
                files = folder.glob(f"{eval_set.name.replace(' ', '_')}-{number}-*.csv")
                # An evaluation by another version of the package has a file of its own: the newest counts.
                for file in sorted(files, key=lambda file: file.stat().st_mtime)[-1:]:
                    labels = {"method": job.method, "seed": job.seed, "after_episodes": number if job.learns else 0}
                    evaluated.append(_labeled(read_table(file), runs.columns, **labels))
    written = []
    for name, rows in ((runs.study, training), (f"{runs.study}_evaluated", evaluated)):
        if rows:
            written.append(tables / f"{name}.csv")
            write_atomically(written[-1], table_text(_merge(written[-1], rows)).encode())
    return written


def _merge(file: Path, rows: list[pd.DataFrame]) -> pd.DataFrame:
    """Return the runs of a stored table, each replaced by that of `rows` unless it has more episodes there."""
    stored = [read_table(file)] if file.is_file() else []
    runs: dict[Any, pd.DataFrame] = {}
    for table in (*stored, *rows):
        labels = [name for name in ("method", "seed", "after_episodes") if name in table]
        for key, run in table.groupby(labels, sort=False):
            if key not in runs or len(run) >= len(runs[key]):
                runs[key] = run
    return pd.concat(runs.values(), ignore_index=True)


def load(name: str, tables: Path = TABLES) -> pd.DataFrame:
    """Return a stored table; raise an InputError if there is none."""
    file = tables / f"{name}.csv"
    if not file.is_file():
        raise InputError(f"{file} is missing: run python -m research.thesis with the figure first")
    return read_table(file)


def _labeled(episodes: pd.DataFrame, further: tuple[str, ...], **labels: Any) -> pd.DataFrame:
    """Return the stored columns of episodes, rounded, after columns that label the run."""
    kept = episodes[[column for column in (*COLUMNS, *further) if column in episodes]].copy()
    for column in kept.select_dtypes("floating"):
        kept[column] = [float(f"{value:.{DIGITS}g}") if abs(value) > ROUNDING else 0.0 for value in kept[column]]
    for position, (name, value) in enumerate(labels.items()):
        kept.insert(position, name, value)
    return kept
