"""Runs and learning curves of the figures that train."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from guiderail.tools.learning.learner_config import PRESETS
from guiderail.tools.learning.run_folder import RunFolder
from guiderail.tools.tables import write_table
from guiderail.tools.visualization.figures import color, label, legend, new_figure, save_figure
from guiderail_studies.declaration import LearnerChoice, Method, Study, load_study
from guiderail_studies.report import draw_runs
from guiderail_studies.study import each
from research.studies import study_path


def figure_study(
    name: str,
    *,
    seeds: int,
    episodes: int | None = None,
    methods: Sequence[str] | None = None,
    evaluate: bool = True,
    **changes: Any,
) -> Study:
    """Return a shipped study with the changes that a figure needs.

    Args:
        name: Name of the study.
        seeds: Number of seeds, from the study's first.
        episodes: Episodes of each run; the study's own number by default.
        methods: Names of methods; all methods of the study by default. A name that the study does not have is the name
            of a guidance.
        evaluate: True to evaluate the policies.
        changes: Other fields of the study.
    """
    study = load_study(study_path(name))
    first = study.seeds[0]
    known = {m: study.methods.get(m, Method(env={"guidance": m})) for m in methods or study.methods}
    if episodes is not None:
        known = {m: method.model_copy(update={"learner": LearnerChoice()}) for m, method in known.items()}
        changes["learner"] = changes.get("learner", study.learner).model_copy(update={"episodes": episodes})
    changes |= {} if evaluate else {"eval_set": ()}
    return study.model_copy(update={"methods": known, "seeds": tuple(range(first, first + seeds)), **changes})


def episodes_of(rows: pd.DataFrame, method: str) -> list[pd.DataFrame]:
    """Return the training episodes of every run of one method."""
    return [RunFolder(Path(folder)).episodes() for folder in rows[rows["method"] == method]["folder"]]


def mean_of_last(rows: pd.DataFrame, method: str, column: str, episodes: int = 10) -> float:
    """Return the mean of a column over the last episodes of all seeds."""
    return float(np.mean([run[column].tail(episodes) for run in episodes_of(rows, method)]))


def learning_curves(
    rows: pd.DataFrame,
    columns: Mapping[str, str],
    shape: tuple[int, int],
    size: tuple[float, float],
    *,
    lines: Mapping[str, tuple[str, str]] | None = None,
    window: int = 5,
) -> tuple[Figure, np.ndarray]:
    """Draw a panel for each column of `episodes.csv`, with a curve for each method: mean and range over seeds.

    Args:
        rows: Rows of the study's table.
        columns: Label of each column.
        shape: Rows and columns of panels.
        size: Size of the figure [inches].
        lines: Label and color of each method; by default label and color of the guidance with the method's name.
        window: Number of episodes of the moving mean.
    """
    lines = lines or {method: (label(method), color(method)) for method in dict.fromkeys(rows["method"])}
    figure, axes = new_figure(*shape, size)
    runs = {method: episodes_of(rows, method) for method in lines}
    for axis, (column, axis_label) in zip(axes.flat, columns.items(), strict=True):
        for method, (name, shade) in lines.items():
            draw_runs(axis, [run[column] for run in runs[method]], color=shade, label=name, window=window)
        axis.set(xlabel="episode", ylabel=axis_label)
    if len(lines) > 1:
        legend(figure, axes.flat[0])
    return figure, axes


def save_results(out: Path, name: str, figure: Figure, rows: Any) -> dict[str, Any]:
    """Write a figure's picture and table; return their paths."""
    table = pd.DataFrame(rows, dtype=object).drop(columns="folder", errors="ignore")
    return {
        "picture": str(save_figure(figure, out / f"{name}.png")),
        "table": str(write_table(out / name, table)),
    }


def settings_table(path: Path, thesis: Mapping[str, Mapping[str, Any]], presets: Sequence[str]) -> dict[str, Any]:
    """Write a table that compares the thesis's learner settings with its presets and with further presets.

    Args:
        path: Path of the table, without its ending.
        thesis: Values of the thesis by preset and setting.
        presets: Names of further presets.
    """
    settings = dict.fromkeys(name for values in thesis.values() for name in values)
    rows = []
    for name in settings:
        row: dict[str, Any] = {"setting": name.replace("_", " ")}
        for preset, values in thesis.items():
            row |= {f"thesis, {preset}": values.get(name), preset: getattr(PRESETS[preset], name)}
        rows.append(row | {preset: getattr(PRESETS[preset], name) for preset in presets})
    differences = [
        f"{preset}: {name} {getattr(PRESETS[preset], name)}, not {value}"
        for preset, values in thesis.items()
        for name, value in values.items()
        if getattr(PRESETS[preset], name) != value
    ]
    return {
        "table": str(write_table(path, rows)),
        "the presets of that name have the thesis's values": "; ".join(differences) or "yes, all",
    }


def numbers_of_seeds(
    rows: pd.DataFrame, columns: Mapping[str, tuple[str, str]], names: Mapping[str, str] | None = None
) -> dict[str, str]:
    """Return the numbers of each seed as text, by method and column.

    Args:
        rows: Rows of the study's table.
        columns: Label and number format of each column.
        names: Names of the methods; the labels of their guidance by default.
    """
    numbers = {}
    for method, group in rows.groupby("method", sort=False):
        name = label(str(method)) if names is None else names[str(method)]
        for column, (column_label, form) in columns.items():
            numbers[f"{name}, {column_label}"] = each(group, column, form)
    return numbers
