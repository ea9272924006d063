"""Pages of results: a row for each method; the stored tables have a row for each seed."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from guiderail.models.common.errors import InputError
from guiderail.tools.files import write_atomically
from guiderail.tools.imports import import_modules
from guiderail.tools.tables import cell, read_table, table_text
from guiderail_studies.declaration import LEARNED, Study, load_study
from guiderail_studies.job import Job
from guiderail_studies.study import BREAKING_SUCCESS, curve, draw_sweeps, format_breaking_point
from research.engines import condition_table
from research.figures import FIGURES
from research.results.methods import (
    COLUMNS,
    effort_cell,
    is_trained,
    largest_violation,
    markdown_table,
    mean_and_range,
    methods_table,
    span,
    success_cell,
    task_table,
)  # fmt: skip
from research.results.sections import SECTIONS
from research.studies import study_names, study_path
from research.thesis import describe_differences

PAGES = {
    "BncConnector": "connector",
    "GridClamp": "grid_clamp",
    "Pouring": "pouring",
    "NarrowPassage": "narrow_passage",
}
ENGINES = "engines"  # table of `research.engines`, at the top of the connector's page
# Tables of programs that are not studies, with the columns that the page shows.
PROGRAMS = {
    "certificates": (
        "skill", "checker", "steps", "constrained_steps", "attack_steps", "bound_violations", "budget_spent",
        "worst_ratio_free", "worst_ratio_active", "worst_active",
    ),
    "smoothness": (
        "method", "jerk_commanded_linear", "jerk_commanded_angular", "success_rate", "peak_force",
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
    names = [*study_names(), *PROGRAMS, ENGINES]
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
    """Write a page for each task, one of other programs, a picture of every sweep and a table of differences.

    Args:
        tables: Folder of stored results.
        pages: Folder to write into.

    Returns:
        The table of differences from the thesis, then the pages.

    Raises:
        InputError: If there are no stored results.
    """
    names = [*study_names(), *PROGRAMS]
    stored = {file.stem: read_table(file) for file in sorted(tables.glob("*.csv")) if file.stem in names}
    if not stored:
        raise InputError(f"there is no table of a study in {tables}: name folders of finished studies")
    studies = {name: load_study(study_path(name)) for name in stored if name not in PROGRAMS}
    content: dict[str, list[str]] = {}
    for task, page in PAGES.items():
        own = {name: study for name, study in studies.items() if study.task == task}
        if not own:
            continue
        sections = [_page_head(f"Results: {task}")]
        if task == "BncConnector" and (tables / f"{ENGINES}.csv").is_file():
            sections.append(_ENGINES.format(table=condition_table(read_table(tables / f"{ENGINES}.csv"))))
        if methods := task_table(task, tables):
            sections.append(f"## All methods\n\n{methods}")
        for name, study in own.items():
            if study.sweeps:
                draw_sweeps(study, stored[name], pages / f"{name}.svg")
        sections.append(_studies_section(own, stored))
        sections += filter(None, (_study_section(study, stored[name]) for name, study in own.items()))
        content[page] = sections
    programs = [_program_section(name, rows) for name, rows in stored.items() if name in PROGRAMS]
    if programs:
        content["other"] = [_page_head("Results: certificates, smoothness"), *programs]
    written = [pages / "differences.csv"]
    write_atomically(written[0], _differences(studies, stored).encode())
    for page, sections in content.items():
        written.append(pages / f"{page}.md")
        write_atomically(written[-1], "\n".join(sections).encode())
    return written


def _page_head(title: str) -> str:
    return f"# {title}\n\n{_HEAD}"


_HEAD = """\
Written by `python -m research.results` from the tables in `research/results`. [Results](../results.md) explains how
they were measured. Success: mean (smallest–largest seed) of 100 held-out episodes of each seed, with a 95 % interval
for a single run. IQM: interquartile mean of the seeds. Episodes to convergence: median (smallest–largest). Stopped:
episodes that a force above the limit, an obstacle or a spill ended.
"""
_STUDIES = """\
## Studies

`guiderail study research/studies/NAME.yaml --out studies --trust-imports` runs a study. `research/results/NAME.csv` has
its results with a row for each seed, and [differences.csv](differences.csv) the differences of its methods from the
thesis. A method that the tables above omit is in the section of its study below.
"""


_ENGINES = """\
## One skill in several engines

Connector, hard, with a force-torque sensor at the wrist, in the present contact, which has converged at its plant step
of 5 ms. Successes of held-out episodes, one number per seed. `python -m research.engines --out engines` trains and
evaluates; `research/results/engines.csv` has forces, violations and the training of each seed.

{table}

**All tables below, except "converged contact", are an appendix: they were measured in the contact of that time at a
plant step of 10 ms**, which had not converged ([why](../experiments.md#converged-contact-of-the-connector)). They
compare methods in that contact.
"""


def _figure(file: Path) -> dict[str, Any]:
    """Return the content of a figure's JSON file without the paths of its picture and table."""
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
        figure = {key: value for key, value in content.items() if key not in ("picture", "table")}
        float(figure["seconds"]), str(figure["command"]), str(figure["figure"])
        return figure
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise InputError(f"{file} was not written by python -m research.figures: make the figure again") from error


def _words(key: str) -> str:
    return key.replace("_", " ")


def _program_section(name: str, rows: pd.DataFrame) -> str:
    """Return the section of a program; a method with a row for each place has one row, with a slash between places."""
    lines = [f"## {name}", "", f"`python -m research.{name} --out studies` writes `{name}.csv`."]
    cells = rows[list(PROGRAMS[name])].astype(object).map(cell)
    if "place" in rows:
        lines[-1] += f" Numbers: {' / '.join(rows['place'].unique())}."
        cells = cells.groupby("method", sort=False, as_index=False).agg(" / ".join)
    return "\n".join([*lines, "", markdown_table([*map(_words, cells)], cells.to_numpy().tolist()), ""])


def _studies_section(studies: Mapping[str, Study], stored: Mapping[str, pd.DataFrame]) -> str:
    """Return the command of a task's studies, and what was not run."""
    lines = [_STUDIES]
    for name, study in studies.items():
        if missing := _missing(study, stored[name]):
            lines.append(f"- `{name}`, not run: {'; '.join(missing)}")
    return "\n".join([*lines, ""])


def _study_section(study: Study, rows: pd.DataFrame) -> str:
    """Return the section of a study: sweeps, and the methods that the tables of all methods omit; empty if none is."""
    lines = _sweep_lines(study, rows)
    shown = {(row.study, row.method, row.eval_set) for section in SECTIONS[study.task] for row in section.rows}
    lines += _method_lines(
        _without_sweeps(study, rows), lambda method, name: shown & {(study.name, method, part) for part in (name, None)}
    )
    return "\n".join([f"## {study.name}", *lines, ""]) if lines else ""


def _method_lines(rows: pd.DataFrame, is_shown: Callable[[str, str], object]) -> list[str]:
    """Return a table with a row for each method and a column for each evaluation set; empty if all are shown before."""
    last = rows.sort_values("after_episodes", kind="stable").drop_duplicates(
        ["method", "eval_set", "seed"], keep="last"
    )
    methods: dict[str, dict[str, pd.DataFrame]] = {}
    for method in dict.fromkeys(rows["method"]):
        of_method = last[last["method"] == method].sort_values("seed")
        sets = {name: of_method[of_method["eval_set"] == name] for name in dict.fromkeys(of_method["eval_set"])}
        methods[method] = {name: part for name, part in sets.items() if not is_shown(method, name)}
    methods = {method: sets for method, sets in methods.items() if sets}
    names = [*dict.fromkeys(name for sets in methods.values() for name in sets)]
    if not methods:
        return []
    if len(names) == 1:
        parts = [(method, *sets.values()) for method, sets in methods.items()]
        trained = [(method, part) for method, part in parts if is_trained(part)]
        return ["", methods_table(trained)] if trained else []
    numbers = {int(number) for sets in methods.values() for part in sets.values() for number in part["episodes"]}
    format_success = mean_and_range if len(numbers) == 1 else success_cell
    lines = [] if numbers == {100} or len(numbers) > 1 else ["", f"Success in {numbers.pop()} episodes of each seed."]
    cells = []
    for method, sets in methods.items():
        rates = [format_success(sets[name]) if name in sets else "–" for name in names]
        cells.append((method, effort_cell(next(iter(sets.values()))), *rates, largest_violation([*sets.values()])))
    columns = ("held-out success [%] of", "training episodes (seeds)", *names, COLUMNS[-2])
    return [*lines, "", markdown_table(columns, cells)]


def _missing(study: Study, rows: pd.DataFrame) -> list[str]:
    """Return the methods of a study without results, and the methods with missing seeds, followed by these seeds."""
    missing = []
    for method, declared in study.methods.items():
        seeds, done = set(declared.seeds or study.seeds), set(rows.loc[rows["method"] == method, "seed"])
        if left := seeds - done:
            missing.append(f"{method}, seeds {span(left)}" if done else method)
    return missing


def _differences(studies: Mapping[str, Study], stored: Mapping[str, pd.DataFrame]) -> str:
    """Return the differences of the learned methods of all studies from the thesis, as the text of a CSV file."""
    rows = []
    for name, study in studies.items():
        import_modules(study.imports)
        jobs = {
            method: Job(study, method, study.seeds[0], Path())
            for method, declared in study.methods.items()
            if declared.policy == LEARNED and method in set(stored[name]["method"])
        }
        texts = {method: describe_differences(job.config(job.after_episodes[-1])) for method, job in jobs.items()}
        for text in dict.fromkeys(text for own in texts.values() for text in own):
            rows.append((name, " ".join(method for method, own in texts.items() if text in own), text))
    return table_text(pd.DataFrame(rows, columns=["study", "methods", "difference"]))


def _sweep_lines(study: Study, rows: pd.DataFrame) -> list[str]:
    """Return the picture of a study's sweeps, and a table of the values at which each method falls below the limit."""
    if not study.sweeps:
        return []
    ranges = [f"{sweep.quantity}, {min(sweep.at):g} to {max(sweep.at):g}" for sweep in study.sweeps]
    curves = {method: [curve(sweep, rows, method) for sweep in study.sweeps] for method in study.methods}
    cells = [
        (method, *(format_breaking_point(*points) if points[0] else "–" for points in of_method))
        for method, of_method in curves.items()
        if any(values for values, _ in of_method)
    ]
    picture = f"![Success of every method over difficulty]({study.name}.svg)"
    return ["", picture, "", markdown_table([f"success below {BREAKING_SUCCESS:.0%} at", *ranges], cells)]


def _without_sweeps(study: Study, rows: pd.DataFrame) -> pd.DataFrame:
    """Return the rows of evaluation sets; none if a study has only sweeps."""
    if study.eval_set or not study.sweeps:
        return rows[~rows["eval_set"].isin([s.eval_set(value).name for s in study.sweeps for value in s.at])]
    return rows[:0]
