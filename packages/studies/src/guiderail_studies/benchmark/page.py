"""Leaderboard: the page of all submissions in a folder, as Markdown and HTML."""

from __future__ import annotations

import html
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from guiderail.models.common.errors import InputError
from guiderail.models.common.files import write_atomically
from guiderail.tools.files import check_writable
from guiderail_studies.benchmark.protocol import FLOORS, Protocol
from guiderail_studies.benchmark.run import COLUMNS, HOUR
from guiderail_studies.benchmark.submission import SUBMISSION, Submission, read_submission, read_table_of
from guiderail_studies.statistics import bootstrap_interval, interquartile_mean, probability_of_improvement

TITLE = "Safe learning of contact tasks"
MISSING = "–"
MIN_SEEDS = 3  # smallest number of seeds of a task for an interval
RESAMPLES = 5_000  # number of bootstrap resamples of an interval
SHOWN = (
    ("over_limit_events", "over-limit events in training, per run", "{:.3g}"),
    ("commanded_violations", "training episodes with a commanded violation, per run", "{:.3g}"),
    ("measured_violations", "training episodes with a measured violation, per run", "{:.3g}"),
    ("transient_force", "transient force [N]", "{:.1f}"),
    ("quasi_static_force", "quasi-static force [N]", "{:.1f}"),
    ("impedance_force", "impedance's force [N]", "{:.1f}"),
    ("jerk_commanded", "commanded jerk [m/s³]", "{:.3g}"),
    ("core_seconds", "CPU time of a run [min]", "{:.1f}"),
)
"""Columns of a task's table after the success rate: means over the seeds."""


@dataclass(frozen=True)
class Entry:
    """Submission and its table."""

    submission: Submission
    table: pd.DataFrame

    @property
    def name(self) -> str:
        """Name of the method."""
        return self.submission.method.name

    def scores(self, task: str) -> np.ndarray:
        """Return the success rates of the seeds on a task, (R,)."""
        return self.table.loc[self.table["task"] == task, "success_rate"].to_numpy(float)


def write_page(folder: Path, out: Path | None = None) -> dict[str, Any]:
    """Write the page of all submissions in a folder.

    Every submission is read as by `guiderail benchmark verify`, but no episode is repeated.

    Args:
        folder: Folder with a subfolder for each submission.
        out: Path without ending; by default `leaderboard` in the folder.

    Returns:
        `page`, the HTML file; `markdown`, the Markdown file; `submissions`, their number.

    Raises:
        InputError: If there is no submission, one is damaged, two have the same method, or they have different
            protocols.
    """
    base = folder / "leaderboard" if out is None else out
    files = sorted(folder.glob(f"*/{SUBMISSION}"))
    if not files:
        raise InputError(f"{folder} has no submission: copy the folders of submissions into it")
    read = [(file.parent, *read_submission(file.parent)) for file in files]
    protocols = {protocol.version: protocol for _, _, protocol in read}
    if len(protocols) > 1:
        raise InputError(f"{folder} has submissions of several protocols: give each protocol its own folder")
    (protocol,) = protocols.values()
    entries = [Entry(submission, read_table_of(path, submission, protocol)) for path, submission, _ in read]
    names = [entry.name for entry in entries]
    if repeated := next((name for name in names if names.count(name) > 1), None):
        raise InputError(f"{folder} has two submissions of the method {repeated}: rename one")
    blocks = _blocks(protocol, entries)
    markdown, page = base.with_name(f"{base.name}.md"), base.with_name(f"{base.name}.html")
    for path in (markdown, page):
        check_writable(path)
    write_atomically(markdown, _markdown(blocks).encode())
    write_atomically(page, _html(blocks).encode())
    return {"page": str(page), "markdown": str(markdown), "submissions": len(entries)}


@dataclass(frozen=True)
class Block:
    """Part of the page: a heading, sentences, and a table with its header; the table may be empty."""

    heading: str
    sentences: Sequence[str]
    header: Sequence[str] = ()
    rows: Sequence[Sequence[str]] = ()


def _blocks(protocol: Protocol, entries: Sequence[Entry]) -> list[Block]:
    order = sorted(entries, key=lambda entry: -_mean_success(entry))
    intro = (
        f"Protocol {protocol.version}: {len(protocol.tasks)} tasks, up to {len(protocol.seeds)} seeds, "
        f"{protocol.episodes} held-out episodes of every run. Success is the interquartile mean over seeds with the "
        "95 % interval of a stratified bootstrap. Forces, jerk, events and CPU time are means over seeds."
    )
    blocks = [Block(TITLE, [intro]), _overall(protocol, order)]
    blocks += [block for name in protocol.tasks if (block := _task_block(protocol, name, order)) is not None]
    definitions = [[c.name.replace("_", " "), c.unit or MISSING, c.description] for c in COLUMNS]
    definitions.append(["core seconds", "s", "CPU time of training and evaluation"])
    blocks.append(Block("Columns of the table of a submission", [], ["column", "unit", "definition"], definitions))
    return blocks


def _mean_success(entry: Entry) -> float:
    return float(entry.table.groupby("task")["success_rate"].mean().mean())


def _overall(protocol: Protocol, entries: Sequence[Entry]) -> Block:
    reference = next((entry for entry in entries if entry.name == protocol.reference), None)
    rows = []
    for entry in entries:
        tasks = [name for name in protocol.tasks if len(entry.scores(name))]
        scores = [entry.scores(name) for name in tasks]
        runs = sum(map(len, scores))
        cells = [entry.name, entry.submission.method.description or MISSING, f"{len(tasks)}", f"{runs}"]
        cells += [_interval(scores), _improvement(entry, reference, tasks)]
        rows.append([*cells, f"{entry.table['core_seconds'].sum() / HOUR:.2f}"])
    improvement = f"probability of improvement over {protocol.reference}"
    header = ["method", "description", "tasks", "runs", "success [%]", improvement, "core-hours"]
    sentences = ["Rates over different tasks cannot be compared: see the tables of the tasks."]
    return Block("All tasks", sentences, header, rows)


def _interval(scores: Sequence[np.ndarray]) -> str:
    """Return the interquartile mean of success rates in percent, with its interval if every task has enough seeds."""
    mean = 100 * float(interquartile_mean(scores))
    if min(map(len, scores)) < MIN_SEEDS:
        return f"{mean:.0f}"
    low, high = (100 * end for end in bootstrap_interval(interquartile_mean, scores, resamples=RESAMPLES))
    return f"{mean:.0f} ({low:.0f} to {high:.0f})"


def _improvement(entry: Entry, reference: Entry | None, tasks: Sequence[str]) -> str:
    shared = [name for name in tasks if reference is not None and len(reference.scores(name))]
    if reference is None or entry is reference or not shared:
        return MISSING
    pairs = [[each.scores(name) for name in shared] for each in (entry, reference)]
    value = float(probability_of_improvement(*pairs))
    if min(len(scores) for method in pairs for scores in method) < MIN_SEEDS:
        return f"{value:.2f}"
    low, high = bootstrap_interval(probability_of_improvement, *pairs, resamples=RESAMPLES)
    return f"{value:.2f} ({low:.2f} to {high:.2f})"


def _task_block(protocol: Protocol, task: str, entries: Sequence[Entry]) -> Block | None:
    declared = protocol.tasks[task]
    rows = []
    for entry in entries:
        own = entry.table[entry.table["task"] == task]
        if len(own):
            scales = {"core_seconds": 1 / 60}
            values = [form.format(float(own[name].mean()) * scales.get(name, 1.0)) for name, _, form in SHOWN]
            rows.append([entry.name, str(len(own)), _interval([entry.scores(task)]), *values])
    empty = [MISSING] * len(SHOWN)
    for name in FLOORS:
        if name in declared.floors:
            rows.append(
                [f"{name.replace('_', ' ')} (no learning)", MISSING, f"{100 * declared.floors[name]:.0f}", *empty]
            )
    if not rows:
        return None
    text = f"{declared.description} {declared.episodes} training episodes."
    return Block(task.replace("_", " "), [text], ["method", "seeds", "success [%]", *(s for _, s, _ in SHOWN)], rows)


def _markdown(blocks: Sequence[Block]) -> str:
    parts = []
    for number, block in enumerate(blocks):
        parts.append(f"{'#' if number == 0 else '##'} {_cell(block.heading)}")
        parts += [_cell(sentence) for sentence in block.sentences]
        if block.rows:
            lines = [block.header, ["---"] * len(block.header), *block.rows]
            parts.append("\n".join("| " + " | ".join(map(_cell, line)) + " |" for line in lines))
    return "\n\n".join(parts) + "\n"


def _cell(text: str) -> str:
    """Return text for Markdown, in which a submission's text cannot add markup or rows."""
    return "".join(f"\\{c}" if c in "|<>[]`\\*" else c for c in " ".join(str(text).split()))


STYLE = (
    "body{font:15px/1.5 system-ui,sans-serif;margin:2rem auto;max-width:75rem;padding:0 1rem}"
    "table{border-collapse:collapse;display:block;overflow-x:auto}"
    "th,td{padding:.3rem .6rem;border-bottom:1px solid #ddd;text-align:left;vertical-align:top}"
)


def _html(blocks: Sequence[Block]) -> str:
    parts = []
    for number, block in enumerate(blocks):
        tag = "h1" if number == 0 else "h2"
        parts.append(f"<{tag}>{html.escape(block.heading)}</{tag}>")
        parts += [f"<p>{html.escape(sentence)}</p>" for sentence in block.sentences]
        if block.rows:
            head = "".join(f"<th>{html.escape(name)}</th>" for name in block.header)
            body = "".join(
                "<tr>" + "".join(f"<td>{html.escape(text)}</td>" for text in row) + "</tr>" for row in block.rows
            )
            parts.append(f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>")
    policy = "default-src 'none'; style-src 'unsafe-inline'"
    head = f'<meta charset="utf-8"><meta http-equiv="Content-Security-Policy" content="{policy}">'
    head += f"<title>{html.escape(TITLE)}</title><style>{STYLE}</style>"
    return f'<!doctype html><html lang="en"><head>{head}</head><body>{"".join(parts)}</body></html>\n'
