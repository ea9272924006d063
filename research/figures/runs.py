"""What figures about learning share: their studies' runs, and how those are drawn."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from guiderail.tools.experiments.declaration import LearnerChoice, Method, Study, load_study
from guiderail.tools.experiments.study import each
from guiderail.tools.learning.config import PRESETS
from guiderail.tools.learning.run_folder import RunFolder
from guiderail.tools.tables import write_table
from guiderail.tools.visualization.style import colour, draw_runs, label, legend, new_figure, save_figure
from research.studies import study_path


def figure_study(
    name: str,
    *,
    seeds: int,
    episodes: int | None = None,
    methods: Sequence[str] | None = None,
    judged: bool = True,
    **changed: Any,
) -> Study:
    """A study that comes along, as a figure asks for it.

    Args:
        name: of the study.
        seeds: how many, from the study's first.
        episodes: of each run; the study's own number unless given.
        methods: those of the study unless given; ones that it doesn't have are guidance of that name.
        judged: whether its policies are judged.
        changed: other fields.
    """
    study = load_study(study_path(name))
    first = study.seeds[0]
    known = {m: study.methods.get(m, Method(env={"guidance": m})) for m in methods or study.methods}
    if episodes is not None:
        known = {m: one.model_copy(update={"learner": LearnerChoice()}) for m, one in known.items()}
        changed["learner"] = changed.get("learner", study.learner).model_copy(update={"episodes": episodes})
    changed |= {} if judged else {"eval_set": ()}
    return study.model_copy(update={"methods": known, "seeds": tuple(range(first, first + seeds)), **changed})


def episodes_of(rows: pd.DataFrame, method: str) -> list[pd.DataFrame]:
    """The training episodes of every run of one method."""
    return [RunFolder(Path(folder)).episodes() for folder in rows[rows["method"] == method]["folder"]]


def mean_of_last(rows: pd.DataFrame, method: str, column: str, episodes: int = 10) -> float:
    """The mean over seeds and the last episodes."""
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
    """A panel for each column of `episodes.csv` (name → label), a curve a method: the mean over seeds and their range.

    Args:
        rows: of the study.
        columns: what is drawn.
        shape: of the panels.
        size: of the figure, inches.
        lines: a label and a colour for each method; those of its guidance unless given.
        window: episodes that a point averages.
    """
    lines = lines or {method: (label(method), colour(method)) for method in dict.fromkeys(rows["method"])}
    figure, axes = new_figure(*shape, size)
    runs = {method: episodes_of(rows, method) for method in lines}
    for axis, (column, words) in zip(axes.flat, columns.items(), strict=True):
        for method, (name, shade) in lines.items():
            draw_runs(axis, [run[column] for run in runs[method]], colour=shade, label=name, window=window)
        axis.set(xlabel="episode", ylabel=words)
    if len(lines) > 1:
        legend(figure, axes.flat[0])
    return figure, axes


def leave(out: Path, name: str, figure: Figure, rows: Any) -> dict[str, Any]:
    """Writes a figure's picture and the table behind it; says where."""
    table = pd.DataFrame(rows, dtype=object).drop(columns="folder", errors="ignore")
    return {
        "picture": str(save_figure(figure, out / f"{name}.png")),
        "table": str(write_table(out / name, table)),
    }


def settings_table(path: Path, thesis: Mapping[str, Mapping[str, Any]], measured_with: Sequence[str]) -> dict[str, Any]:
    """A table of learners' settings: the thesis's beside its preset's, and what was measured with here.

    Args:
        path: of the table, without its ending.
        thesis: its values by preset and setting.
        measured_with: further presets.
    """
    settings = dict.fromkeys(name for values in thesis.values() for name in values)
    rows = []
    for name in settings:
        row: dict[str, Any] = {"setting": name.replace("_", " ")}
        for preset, values in thesis.items():
            row |= {f"thesis, {preset}": values.get(name), preset: getattr(PRESETS[preset], name)}
        rows.append(row | {preset: getattr(PRESETS[preset], name) for preset in measured_with})
    other = [
        f"{preset}: {name} {getattr(PRESETS[preset], name)}, not {value}"
        for preset, values in thesis.items()
        for name, value in values.items()
        if getattr(PRESETS[preset], name) != value
    ]
    return {
        "table": str(write_table(path, rows)),
        "the presets of that name have the thesis's values": "; ".join(other) or "yes, all",
    }


def said(rows: pd.DataFrame, columns: Mapping[str, tuple[str, str]], names: Mapping[str, str] | None = None) -> dict:
    """Each seed's own numbers: column → words and format; `names` are what to call the methods."""
    found = {}
    for method, group in rows.groupby("method", sort=False):
        name = label(str(method)) if names is None else names[str(method)]
        for column, (words, form) in columns.items():
            found[f"{name}, {words}"] = each(group, column, form)
    return found
