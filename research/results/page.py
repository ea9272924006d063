"""Pages of results: a row for each method; the stored tables have a row for each seed."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
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
    MISSING,
    effort_cell,
    is_trained,
    largest_violation,
    markdown_table,
    mean_and_range,
    span,
    success_cell,
    task_table,
    training_safety,
)  # fmt: skip
from research.results.sections import ONLY_NAMED, SECTIONS
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
        "method", "jerk_commanded_linear", "success_rate", "peak_force",
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
            sections.append(methods)
        for name, study in own.items():
            if study.sweeps:
                draw_sweeps(study, stored[name], pages / f"{name}.svg")
        sections.append(_studies_section(own, stored))
        sections += [_sweep_section(study, stored[name]) for name, study in own.items() if study.sweeps]
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
Written by `python -m research.results` from `research/results/NAME.csv`, a table with a row for each seed.
[Results](../results.md) explains columns and studies. `guiderail study research/studies/NAME.yaml --out studies
--trust-imports` runs a study.
"""
_STUDY_COLUMNS = (
    "study", "method", "training episodes (seeds)", "held-out success [%]", "max. commanded violation",
)  # fmt: skip
_STUDIES = """\
## Other studies

Methods and conditions that are not in the tables above. Policies without learning: see the studies' tables.
[differences.csv](differences.csv) has the differences of all methods from the thesis.
"""


_ENGINES = """\
## One skill in several engines

Connector, hard, with a force-torque sensor at the wrist, in the present contact, which has converged at its plant step
of 5 ms. Successes of held-out episodes, one number per seed. `python -m research.engines --out engines` trains and
evaluates; `research/results/engines.csv` has forces, violations and training. The three other engines had a time step
of 10 ms, now 4 ms (`pretrained:connector` in MuJoCo: 92 of 100 with both).

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
    """Return the section of a program: of a method with a row for each place, the last one; equal columns once."""
    lines = [f"## {name}", "", f"`python -m research.{name} --out studies` writes `{name}.csv`."]
    if "place" in rows:
        *others, place = rows["place"].unique()
        lines[-1] += f" Place: {place}; other places in the table: {', '.join(others) or 'none'}."
        rows = rows[rows["place"] == place]
    cells = rows[list(PROGRAMS[name])].astype(object).map(cell)
    equal = [column for column in cells.columns[1:] if len(cells) > 1 and cells[column].nunique() == 1]
    if equal:
        lines[-1] += f" In all rows: {'; '.join(f'{_words(column)} {cells[column].iloc[0]}' for column in equal)}."
    cells = cells.drop(columns=equal)
    return "\n".join([*lines, "", markdown_table([*map(_words, cells)], cells.to_numpy().tolist()), ""])


def _studies_section(studies: Mapping[str, Study], stored: Mapping[str, pd.DataFrame]) -> str:
    """Return a table of the methods that the tables of all methods omit, and what was not run."""
    cells = [row for name in studies if name not in ONLY_NAMED for row in _study_rows(studies[name], stored[name])]
    lines = [_STUDIES, *([markdown_table(_STUDY_COLUMNS, cells), ""] if cells else [])]
    if named := [f"`{name}`" for name in studies if name in ONLY_NAMED]:
        lines += [f"Only in `research/results`: the other methods of {', '.join(named)}.", ""]
    for name, study in studies.items():
        if missing := _missing(study, stored[name]):
            lines.append(f"- `{name}`, not run: {'; '.join(missing)}")
    return "\n".join(lines) if lines[-1] == "" else "\n".join([*lines, ""])


def _study_rows(study: Study, rows: pd.DataFrame) -> list[tuple[str, ...]]:
    """Return the row of each learned method of a study of which the tables of all methods omit an evaluation set."""
    rows = _without_sweeps(study, rows)
    shown = {
        (row.method, row.eval_set) for part in SECTIONS[study.task] for row in part.rows if row.study == study.name
    }
    last = rows.sort_values("after_episodes", kind="stable").drop_duplicates(
        ["method", "eval_set", "seed"], keep="last"
    )
    cells: list[tuple[str, ...]] = []
    for method in dict.fromkeys(rows["method"]):
        seeds = last[last["method"] == method].sort_values("seed")
        sets = {
            name: seeds[seeds["eval_set"] == name]
            for name in dict.fromkeys(seeds["eval_set"])
            if not shown & {(method, name), (method, None)}
        }
        if sets and is_trained(seeds):
            first = next(iter(sets.values()))
            parts = [*sets.values(), training_safety(first)]
            cells.append((f"`{study.name}`", method, effort_cell(first), _successes(sets), largest_violation(parts)))
    return cells


def _successes(sets: Mapping[str, pd.DataFrame]) -> str:
    """Return the success of a method in each evaluation set, and their number of episodes if it is not 100."""
    if len(sets) == 1:
        return success_cell(*sets.values())
    numbers = {int(number) for rows in sets.values() for number in rows["episodes"]}
    if len(numbers) > 1:
        return "; ".join(f"{name}: {success_cell(rows)}" for name, rows in sets.items())
    each = "" if numbers == {100} else f"; of {numbers.pop()} each"
    return "; ".join(f"{name}: {mean_and_range(rows)}" for name, rows in sets.items()) + each


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


def _sweep_section(study: Study, rows: pd.DataFrame) -> str:
    """Return the picture of a study's sweeps, and a table of the values at which each method falls below the limit.

    A sentence names the methods that are below the limit at every value.
    """
    ranges = [f"{sweep.quantity}, {min(sweep.at):g} to {max(sweep.at):g}" for sweep in study.sweeps]
    curves = {method: [curve(sweep, rows, method) for sweep in study.sweeps] for method in study.methods}
    cells = [
        (method, *(format_breaking_point(*points) if points[0] else MISSING for points in of_method))
        for method, of_method in curves.items()
        if any(values for values, _ in of_method)
    ]
    failed = [
        method
        for method, of_method in curves.items()
        if (rates := [rate for _, points in of_method for rate, _, _ in points]) and max(rates) < BREAKING_SUCCESS
    ]
    lines = [f"## {study.name}", "", f"![Success of every method over difficulty]({study.name}.svg)", ""]
    lines += [
        markdown_table(
            [f"success below {BREAKING_SUCCESS:.0%} at", *ranges], [row for row in cells if row[0] not in failed]
        ),
        "",
    ]
    if failed:
        lines += [f"Below {BREAKING_SUCCESS:.0%} at every value: {', '.join(failed)}.", ""]
    return "\n".join(lines)


def _without_sweeps(study: Study, rows: pd.DataFrame) -> pd.DataFrame:
    """Return the rows of evaluation sets; none if a study has only sweeps."""
    if study.eval_set or not study.sweeps:
        return rows[~rows["eval_set"].isin([s.eval_set(value).name for s in study.sweeps for value in s.at])]
    return rows[:0]
