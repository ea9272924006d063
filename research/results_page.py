"""`guiderail results`: a page of what was reproduced, from what studies and figures left."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from guiderail.models.common.errors import InputError
from guiderail.tools.environments import import_modules
from guiderail.tools.evaluation.metrics import TOLERANCE
from guiderail.tools.experiments.declaration import LEARNED, Study, load_study
from guiderail.tools.experiments.study import differences_of, each
from guiderail.tools.experiments.sweep import BREAKS, break_words, curve, draw_sweeps
from guiderail.tools.files import write_atomically
from guiderail.tools.tables import cell, read_table, table_text
from research.figures import FIGURES as MADE
from research.figures import command_of
from research.figures.thesis import THESIS
from research.studies import study_command_line, study_names, study_path

# The figures of the thesis that a study stands beside.
FIGURES = {
    "connector": ("4.8", "5.9"),
    "connector_thesis": ("4.8", "5.9"),
    "grid_clamp": ("3.10",),
    "narrow_passage": ("4.5", "4.6"),
    "pouring_sac": ("3.5", "3.7", "3.8"),
    "pouring_tqc": ("3.6", "3.8"),
}
# Of what `guiderail reproduce` leaves: the rest are claims.
NO_CLAIM = ("figure", "the thesis", "command", "seconds", "seeds", "condition")
COLUMNS = (
    "method", "after", "judged on", "each seed, held out", "converged after, each seed", "worst command",
    "collisions in training", "hours",
)  # fmt: skip

# Of programs, some of whose tables have dozens of columns.
OF_SMOOTHNESS = (
    "method", "place", "jerk_commanded_linear", "jerk_commanded_angular", "times_below_kgrl_linear",
    "times_below_kgrl_angular", "success_rate", "peak_force", "worst_violation",
)  # fmt: skip


PROGRAMS = ("certificates", "smoothness")  # tables that are not a study's


def _table_names() -> list[str]:
    return sorted([*study_names(), *PROGRAMS])


def write_results(folders: Sequence[Path], out: Path) -> Path:
    """Takes what studies and figures left into a folder, and writes its README.md anew from all that is there.

    Beside it is a picture of each study that has sweeps.

    Args:
        folders: of studies that come along, or of what `guiderail reproduce` left; none to write the page anew only.
        out: the folder with a table for each study and a JSON file for each figure.

    Raises:
        InputError: if a folder holds neither, or there is nothing to write of.
    """
    for folder in folders:
        finished = [folder / f"{name}.csv" for name in _table_names() if (folder / f"{name}.csv").is_file()]
        figures = [folder / f"{name}.json" for name in MADE.values() if (folder / f"{name}.json").is_file()]
        if not finished and not figures:
            raise InputError(
                f"{folder} holds no table of a study and no figure: give a folder that guiderail study or guiderail "
                "reproduce finished"
            )
        for file in finished:
            write_atomically(out / file.name, table_text(read_table(file)).encode())
        for file in figures:
            write_atomically(out / file.name, json.dumps(_figure(file), indent=1).encode() + b"\n")
    tables = {file.stem: read_table(file) for file in sorted(out.glob("*.csv")) if file.stem in _table_names()}
    made = {number: _figure(out / f"{name}.json") for number, name in MADE.items() if (out / f"{name}.json").is_file()}
    if not tables and not made:
        raise InputError(f"there is no table of a study and no figure in {out}: name folders of them")
    head = (
        "# What was reproduced\n\nWritten by `guiderail results`, from the tables and the figures' numbers beside it. "
        "In simulation;\nevery seed by itself; held-out episodes are ones that training never drew.\n"
    )
    for name, rows in tables.items():
        if name not in PROGRAMS and (study := load_study(study_path(name))).sweeps:
            draw_sweeps(study, rows, out / f"{name}.svg")
    parts = [head, _figures(made, [*tables]), *(_study(name, rows) for name, rows in tables.items())]
    write_atomically(out / "README.md", "\n".join(parts).encode())
    return out / "README.md"


def _figure(file: Path) -> dict[str, Any]:
    """What `guiderail reproduce` left of a figure, without where its picture and its table are on some machine."""
    try:
        found = json.loads(file.read_text(encoding="utf-8"))
        kept = {key: value for key, value in found.items() if key not in ("picture", "table")}
        float(kept["seconds"]), str(kept["command"]), str(kept["figure"])
        return kept
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise InputError(f"{file} is not what guiderail reproduce leaves: make the figure anew") from error


def _figures(made: Mapping[str, Mapping[str, Any]], studies: Sequence[str]) -> str:
    """Each figure and table of the thesis: what it says, what came out here, and by which command."""
    columns = ("figure", "the thesis", "here", "seeds", "wall clock", "the setting", "command")
    lines = ["## The thesis, figure by figure", "", f"| {' | '.join(columns)} |", "|" + "---|" * len(columns)]
    for number, words in THESIS.items():
        beside = [f"[{name}](#{name})" for name in studies if number in FIGURES.get(name, ())]
        found = made.get(number, {})
        claims = [f"{_words(key)}: {cell(value)}" for key, value in found.items() if key not in NO_CLAIM]
        told: list[Any] = [number, words, "; ".join([*claims, *(["study " + ", ".join(beside)] if beside else [])])]
        told += [found.get("seeds"), f"{found['seconds'] / 60:.1f} min" if found else None, found.get("condition")]
        command = found.get("command", command_of(number))
        lines.append(f"| {' | '.join(cell(one or None).replace('|', '/') for one in told)} | `{command}` |")
    return "\n".join([*lines, ""])


def _words(key: str) -> str:
    return key.replace("_", " ")


def _study(name: str, rows: pd.DataFrame) -> str:
    """The section of a study."""
    command = f"python -m research.{name} --out studies" if name in PROGRAMS else study_command_line(name)
    lines = [f"## {name}", "", f"`{command}`, and the table `{name}.csv`.", ""]
    if name in PROGRAMS:
        told = rows[list(OF_SMOOTHNESS)] if name == "smoothness" else rows
        lines += [f"| {' | '.join(map(_words, told))} |", "|" + "---|" * len(told.columns)]
        lines += [f"| {' | '.join(map(cell, row))} |" for row in told.itertuples(index=False)]
        return "\n".join([*lines, ""])
    study = load_study(study_path(name))
    lines += [f"- Figure {number}: {THESIS[number]}." for number in FIGURES.get(name, ())]
    lines += _swept(study, rows)
    if len(judged := _judged(study, rows)):
        lines += ["", f"| {' | '.join(COLUMNS)} |", "|" + "---|" * len(COLUMNS)]
    # A study that judges nothing has an empty column, whose cells are read as NaN.
    for (method, mark, on), group in judged.groupby(["method", "mark", "judged_on"], sort=False, dropna=False):
        told = [method, mark or "–", on or "–", *_numbers(group)]
        lines.append(f"| {' | '.join(map(cell, told))} |")
    if missing := [method for method in study.methods if method not in set(rows["method"])]:
        lines += ["", f"Declared by the study, and not in this table: {', '.join(missing)}."]
    import_modules(study.imports)
    differing: dict[str, list[str]] = {}
    for method in (m for m, one in study.methods.items() if one.policy == LEARNED and m in set(rows["method"])):
        differing.setdefault("; ".join(differences_of(study, method)), []).append(method)
    for words, methods in differing.items():
        lines += ["", f"Differs from the thesis in ({', '.join(methods)}): {words}."]
    return "\n".join([*lines, ""])


def _swept(study: Study, rows: pd.DataFrame) -> list[str]:
    """A study's sweeps: their picture, and for each a table of every method's success, each seed by itself."""
    if not study.sweeps:
        return []
    lines = ["", f"![Success against difficulty, every method]({study.name}.svg)"]
    for sweep in study.sweeps:
        columns = [sweep.quantity, *(f"{value:g}" for value in sweep.at), f"below {BREAKS:.0%} at"]
        lines += ["", f"| {' | '.join(columns)} |", "|" + "---|" * len(columns)]
        for method in study.methods:
            of_method = rows[rows["method"] == method]
            values, points = curve(sweep, rows, method)
            if not values:
                continue
            seeds = (
                each(of_method[of_method["judged_on"] == sweep.judged_on(value).name], "success_rate", "{:.0%}")
                for value in sweep.at
            )
            told = [method, *seeds, break_words(values, points)]
            lines.append(f"| {' | '.join(one or '–' for one in told)} |")
    return lines


def _judged(study: Study, rows: pd.DataFrame) -> pd.DataFrame:
    """Rows of what is judged besides sweeps; of what is judged in sweeps alone one a run, about its training."""
    if study.judged_on or not study.sweeps:
        return rows[~rows["judged_on"].isin([s.judged_on(value).name for s in study.sweeps for value in s.at])]
    once = rows.drop_duplicates(["method", "mark", "seed"])
    return once[once["training_episodes"].notna()].assign(judged_on="", success_rate=np.nan)


def _numbers(group: pd.DataFrame) -> list[str]:
    """Of the seeds of a method, side by side."""
    rates, trained = group.get("success_rate", []), "training_episodes" in group
    held_out = ", ".join("–" if pd.isna(rate) else f"{rate:.0%}" for rate in rates) or "–"
    if not trained or group["training_episodes"].isna().all():
        return [held_out, "–", "–", "–", "–"]
    converged = ", ".join("never" if pd.isna(n) else f"{n:g}" for n in group["training_converged_after"])
    worst = float(group["training_worst_violation"].max())
    kept = "within" if worst <= TOLERANCE else f"{worst:.2g} outside"
    hours = float(np.nansum(group["training_wall_time"].to_numpy(float))) / 3600
    return [held_out, converged, kept, f"{int(group['training_collisions'].sum())}", f"{hours:.2f}"]
