"""Pages of results: the thesis figure by figure, and every study with each of its seeds."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from guiderail.models.common.errors import InputError
from guiderail.tools.evaluation.metrics import TOLERANCE
from guiderail.tools.files import write_atomically
from guiderail.tools.imports import import_modules
from guiderail.tools.tables import cell, read_table, table_text
from guiderail_studies.declaration import LEARNED, Study, load_study
from guiderail_studies.job import Job
from guiderail_studies.study import BREAKING_SUCCESS, curve, draw_sweeps, each, format_breaking_point
from research.figures import FIGURES, figure_command
from research.figures.thesis import THESIS
from research.results.methods import span, task_table
from research.studies import study_command_line, study_names, study_path
from research.thesis import describe_differences

# Figures of the thesis that a study reproduces.
FIGURES_OF_STUDIES = {
    "connector": ("4.8", "5.9"),
    "connector_thesis": ("4.8", "5.9"),
    "grid_clamp": ("3.10",),
    "narrow_passage": ("4.5", "4.6"),
    "pouring_sac": ("3.5", "3.7", "3.8"),
    "pouring_tqc": ("3.6", "3.8"),
}
PAGES = {
    "BncConnector": "connector",
    "GridClamp": "grid_clamp",
    "Pouring": "pouring",
    "NarrowPassage": "narrow_passage",
}
# Keys of a figure's JSON file that are not results.
NOT_RESULTS = ("figure", "the thesis", "command", "seconds", "seeds", "condition")
COLUMNS = (
    "method", "after episodes", "evaluation set", "held-out success of each seed", "episodes to convergence",
    "max. commanded violation", "force above the limit in training", "stopped in training", "hours",
)  # fmt: skip
# Tables of programs that are not studies, with the columns that the page shows; None: all of them.
PROGRAMS: dict[str, tuple[str, ...] | None] = {
    "certificates": None,
    "smoothness": (
        "method", "place", "jerk_commanded_linear", "jerk_commanded_angular", "times_below_kgrl_linear",
        "times_below_kgrl_angular", "success_rate", "peak_force", "max_commanded_violation",
    ),
}  # fmt: skip


def store(folders: Sequence[Path], tables: Path) -> None:
    """Copy the tables of finished studies and the numbers of figures into the folder of stored results.

    Args:
        folders: Folders of finished studies, figures or programs.
        tables: Folder with a CSV file for each study and a JSON file for each figure.

    Raises:
        InputError: If a folder holds no table and no figure.
    """
    names = [*study_names(), *PROGRAMS]
    for folder in folders:
        finished = [folder / f"{name}.csv" for name in names if (folder / f"{name}.csv").is_file()]
        figures = [folder / f"{name}.json" for name in FIGURES.values() if (folder / f"{name}.json").is_file()]
        if not finished and not figures:
            raise InputError(
                f"{folder} holds no table of a study and no figure: give a folder that guiderail study or "
                "python -m research.figures wrote"
            )
        for file in finished:
            write_atomically(tables / file.name, table_text(read_table(file)).encode())
        for file in figures:
            write_atomically(tables / file.name, json.dumps(_figure(file), indent=1).encode() + b"\n")


def write_pages(tables: Path, pages: Path) -> list[Path]:
    """Write a page for each task, one of figures and other programs, and a picture of every sweep.

    Args:
        tables: Folder of stored results.
        pages: Folder to write into.

    Returns:
        The pages.

    Raises:
        InputError: If there are no stored results.
    """
    names = [*study_names(), *PROGRAMS]
    stored = {file.stem: read_table(file) for file in sorted(tables.glob("*.csv")) if file.stem in names}
    figures = {
        number: _figure(tables / f"{name}.json")
        for number, name in FIGURES.items()
        if (tables / f"{name}.json").is_file()
    }
    if not stored and not figures:
        raise InputError(f"there is no table of a study and no figure in {tables}: name folders that have them")
    studies = {name: load_study(study_path(name)) for name in stored if name not in PROGRAMS}
    places = {name: f"{PAGES[study.task]}.md#{name}" for name, study in studies.items()}
    content: dict[str, list[str]] = {}
    for task, page in PAGES.items():
        own = {name: study for name, study in studies.items() if study.task == task}
        if not own:
            continue
        sections = [_page_head(f"Results: {task}")]
        if methods := task_table(task, tables):
            sections.append(f"## All methods\n\n{methods}")
        for name, study in own.items():
            if study.sweeps:
                draw_sweeps(study, stored[name], pages / f"{name}.svg")
            sections.append(_study_section(study, stored[name]))
        content[page] = sections
    programs = [_program_section(name, rows) for name, rows in stored.items() if name in PROGRAMS]
    content["other"] = [_page_head("Results: figures, certificates, smoothness"), _figures_section(figures, places)]
    content["other"] += programs
    written = []
    for page, sections in content.items():
        written.append(pages / f"{page}.md")
        write_atomically(written[-1], "\n".join(sections).encode())
    return written


def _page_head(title: str) -> str:
    return (
        f"# {title}\n\nWritten by `python -m research.results` from the tables in `research/results`. All results are "
        "simulated.\nHeld-out episodes use random numbers that training never uses. The ranges of starts and offsets "
        "are those of\ntraining; only on the narrow passage at the standard difficulty the start varies in held-out "
        "episodes and not in\ntraining. If a run has one hidden offset, held-out episodes have the same offset. A "
        "training episode is stopped by\na collision (a force above the limit, or an obstacle of the narrow passage) "
        "or a spill.\n"
    )


def _figure(file: Path) -> dict[str, Any]:
    """Return the content of a figure's JSON file without the paths of its picture and table."""
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
        figure = {key: value for key, value in content.items() if key not in ("picture", "table")}
        float(figure["seconds"]), str(figure["command"]), str(figure["figure"])
        return figure
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise InputError(f"{file} was not written by python -m research.figures: make the figure again") from error


def _figures_section(figures: Mapping[str, Mapping[str, Any]], places: Mapping[str, str]) -> str:
    """Return the table of the thesis's figures: its statement, the result here and the command."""
    columns = ("figure", "thesis", "here", "seeds", "wall clock", "setting", "command")
    lines = ["## Figures of the thesis", ""]
    lines += [f"| {' | '.join(columns)} |", "|" + "---|" * len(columns)]
    for number, statement in THESIS.items():
        studies = [f"[{name}]({place})" for name, place in places.items() if number in FIGURES_OF_STUDIES.get(name, ())]
        figure = figures.get(number, {})
        results = [f"{_words(key)}: {cell(value)}" for key, value in figure.items() if key not in NOT_RESULTS]
        results += ["study " + ", ".join(studies)] if studies else []
        cells: list[Any] = [number, statement, "; ".join(results), figure.get("seeds")]
        cells += [f"{figure['seconds'] / 60:.1f} min" if figure else None, figure.get("condition")]
        command = figure.get("command", figure_command(number))
        lines.append(f"| {' | '.join(cell(value or None).replace('|', '/') for value in cells)} | `{command}` |")
    return "\n".join([*lines, ""])


def _words(key: str) -> str:
    return key.replace("_", " ")


def _program_section(name: str, rows: pd.DataFrame) -> str:
    selected = rows if (columns := PROGRAMS[name]) is None else rows[list(columns)]
    lines = [f"## {name}", "", f"`python -m research.{name} --out studies` writes `{name}.csv`.", ""]
    lines += [f"| {' | '.join(map(_words, selected))} |", "|" + "---|" * len(selected.columns)]
    lines += [f"| {' | '.join(map(cell, row))} |" for row in selected.itertuples(index=False)]
    return "\n".join([*lines, ""])


def _study_section(study: Study, rows: pd.DataFrame) -> str:
    """Return the section of a study: figures, sweeps, methods, and differences from the thesis."""
    name = study.name
    lines = [f"## {name}", "", f"`{study_command_line(name)}` writes `{name}.csv`.", ""]
    lines += [f"- Figure {number}: {THESIS[number]}." for number in FIGURES_OF_STUDIES.get(name, ())]
    lines += _sweep_lines(study, rows)
    if len(evaluated := _without_sweeps(study, rows)):
        lines += ["", f"| {' | '.join(COLUMNS)} |", "|" + "---|" * len(COLUMNS)]
    # `eval_set` is empty if a study evaluates nothing. An empty cell is read as NaN, whose group is kept, too.
    for (method, after, eval_set), group in evaluated.groupby(
        ["method", "after_episodes", "eval_set"], sort=False, dropna=False
    ):
        cells = [method, after or "–", eval_set or "–", *_numbers(group)]
        lines.append(f"| {' | '.join(map(cell, cells))} |")
    if missing := _missing(study, rows):
        lines += ["", f"Not run: {'; '.join(missing)}."]
    return "\n".join([*lines, *_difference_lines(study, set(rows["method"])), ""])


def _missing(study: Study, rows: pd.DataFrame) -> list[str]:
    """Return the methods of a study without results, and the methods with missing seeds, followed by these seeds."""
    missing = []
    for method, declared in study.methods.items():
        seeds, done = set(declared.seeds or study.seeds), set(rows.loc[rows["method"] == method, "seed"])
        if left := seeds - done:
            missing.append(f"{method}, seeds {span(left)}" if done else method)
    return missing


def _difference_lines(study: Study, evaluated: Collection[str]) -> list[str]:
    """Return the differences of the learned methods from the thesis: common ones first, then those of each method."""
    import_modules(study.imports)
    jobs = {
        method: Job(study, method, study.seeds[0], Path())
        for method, declared in study.methods.items()
        if declared.policy == LEARNED and method in evaluated
    }
    words = {method: describe_differences(job.config(job.after_episodes[-1])) for method, job in jobs.items()}
    common = [text for text in next(iter(words.values()), ()) if all(text in own for own in words.values())]
    further: dict[str, list[str]] = {}
    for method, own in words.items():
        further.setdefault("; ".join(text for text in own if text not in common), []).append(method)
    lines = ["", f"Differences from the thesis ({', '.join(words)}): {'; '.join(common)}."] if common else []
    single = [f"- {', '.join(names)}: {sentence}." for sentence, names in further.items() if sentence]
    return [*lines, "", *single] if single else lines


def _sweep_lines(study: Study, rows: pd.DataFrame) -> list[str]:
    """Return the picture of a study's sweeps, and a table of every method's success for each sweep."""
    if not study.sweeps:
        return []
    lines = ["", f"![Success of every method over difficulty]({study.name}.svg)"]
    for sweep in study.sweeps:
        columns = [sweep.quantity, *(f"{value:g}" for value in sweep.at), f"below {BREAKING_SUCCESS:.0%} at"]
        lines += ["", f"| {' | '.join(columns)} |", "|" + "---|" * len(columns)]
        for method in study.methods:
            of_method = rows[rows["method"] == method]
            values, points = curve(sweep, rows, method)
            if not values:
                continue
            rates = (
                each(of_method[of_method["eval_set"] == sweep.eval_set(value).name], "success_rate", "{:.0%}")
                for value in sweep.at
            )
            cells = [method, *rates, format_breaking_point(values, points)]
            lines.append(f"| {' | '.join(text or '–' for text in cells)} |")
    return lines


def _without_sweeps(study: Study, rows: pd.DataFrame) -> pd.DataFrame:
    """Return the rows of evaluation sets; if a study has only sweeps, a row per run with its training results."""
    if study.eval_set or not study.sweeps:
        return rows[~rows["eval_set"].isin([s.eval_set(value).name for s in study.sweeps for value in s.at])]
    once = rows.drop_duplicates(["method", "after_episodes", "seed"])
    return once[once["training_episodes"].notna()].assign(eval_set="", success_rate=np.nan)


def _numbers(group: pd.DataFrame) -> list[str]:
    """Return the cells of a method: a number for each seed."""
    rates, trained = group.get("success_rate", []), "training_episodes" in group
    held_out = ", ".join("–" if pd.isna(rate) else f"{rate:.0%}" for rate in rates) or "–"
    if not trained or group["training_episodes"].isna().all():
        return [held_out, "–", "–", "–", "–", "–"]
    converged = ", ".join("never" if pd.isna(n) else f"{n:g}" for n in group["training_episodes_to_convergence"])
    worst = float(group["training_max_commanded_violation"].max())
    violation = "none" if worst <= TOLERANCE else f"{worst:.2g}"
    hours = float(np.nansum(group["training_wall_time"].to_numpy(float))) / 3600
    collisions = f"{int(group['training_collisions'].sum())}"
    return [held_out, converged, violation, collisions, _stopped(group), f"{hours:.2f}"]


def _stopped(group: pd.DataFrame) -> str:
    """Return the number of training episodes of all seeds that ended in a collision or a spill."""
    collisions, spills, episodes = (
        int(group[f"training_{name}"].sum()) for name in ("ended_in_collision", "ended_in_spill", "episodes")
    )
    return f"{collisions}{f' + {spills} spills' if spills else ''} of {episodes:,}"
