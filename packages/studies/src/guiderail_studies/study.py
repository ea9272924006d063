"""Studies: train and evaluate methods over seeds, write a table of the results, and draw the sweeps.

Each seed has rows of its own, so that failures of single seeds are not averaged away. An interrupted study is
resumed by the same call, and studies that share runs use them again. An engine runs the jobs; the rows do not depend on
the engine.
"""

from __future__ import annotations

import itertools
import json
import secrets
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from functools import partial
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from guiderail.models.common.errors import InputError, RunsFailedError
from guiderail.models.common.registry import did_you_mean
from guiderail.tools.evaluation.metrics import statistics_of, wilson
from guiderail.tools.files import write_atomically
from guiderail.tools.imports import import_modules
from guiderail.tools.learning.run_folder import installed_versions
from guiderail.tools.tables import cell, write_table
from guiderail.tools.visualization.figures import legend, new_figure, save_figure
from guiderail_studies.declaration import Ratio, Study, Sweep, source_file
from guiderail_studies.engines.engine import Engine, Outcome, make_engine
from guiderail_studies.job import (
    EVALUATED,
    TRAINING,
    Job,
    attempt,
    check_job,
    check_source,
    is_done,
    log_failure,
    run_job,
)
from guiderail_studies.progress import StudyProgress

LINE_STYLES = ("-", "--", "-.", ":")  # used in turn, because curves of methods that always or never succeed coincide
BREAKING_SUCCESS = 0.9  # success rate below which a method counts as broken
NEVER, AT_ONCE = "not within the sweep", "from the easiest on"


def run_study(study: Study, out: Path, engine: Engine | None = None) -> pd.DataFrame:
    """Run the jobs of a study that are not done.

    Args:
        study: Study.
        out: Folder of the study; runs in it are used again, and interrupted ones resume.
        engine: Engine that runs the jobs; two processes by default.

    Returns:
        A row for each method, seed, number of training episodes and evaluation set, in this order.

    Raises:
        InputError: Before anything is written, if the declaration is invalid, a folder holds another run or cannot be
            written, or the engine cannot reach its workers.
        RunsFailedError: At the end, if some jobs failed.
    """
    if out.exists() and not out.is_dir():
        raise InputError(f"{out} is a file: name a folder with --out")
    # Workers may have another working directory.
    study, out = study.model_copy(update={"imports": import_modules(study.imports)}), out.absolute()
    jobs = [
        Job(study, name, seed, out) for name, method in study.methods.items() for seed in method.seeds or study.seeds
    ]
    _check_columns(study)
    for job in jobs:
        check_job(job)
    _refuse_shared_folders(jobs)
    outcomes = _run_jobs(jobs, _order_jobs(jobs), engine or make_engine())
    pairs = [(job, outcomes[index]) for index, job in enumerate(jobs)]
    rows = pd.DataFrame([row for _, outcome in pairs for row in outcome.rows], dtype=object)
    failed = [f"{job.method}, seed {job.seed}, failed: {end.failure}" for job, end in pairs if end.failure]
    if failed:
        raise RunsFailedError(failed, rows)
    return rows


def study_command(
    study: Study,
    out: Path,
    engine: Engine | None = None,
    table: str | None = None,
    *,
    file: Path | None = None,
) -> dict[str, Any]:
    """Run a study by `run_study`, write its tables, draw its sweeps, and return a summary.

    The `.csv` file has every column and a row for each seed, the `.md` file a row for each method.

    Args:
        study: As in `run_study`.
        out: As in `run_study`; the table and the picture are written into it.
        engine: As in `run_study`.
        table: Name of the table and the picture; by default that of the study.
        file: File of the study, which a report names in the command that runs the study again.

    Returns:
        Summary: paths of the files, and results of each seed by label. `failed` has one sentence for each failed job,
        which has no rows in the table; it is the only entry if no job has rows.

    Raises:
        InputError: As `run_study`, or if a file cannot be written.
    """
    result: dict[str, Any] = {}
    try:
        rows = run_study(study, out, engine)
    except RunsFailedError as error:
        rows, result["failed"] = error.rows, error.sentences
        if not len(rows):
            return result
    if file is not None:
        source = {"file": str(file), "imports": bool(study.imports)}
        write_atomically(source_file(out, study.name), json.dumps(source).encode())
    table_path = out / (table or study.name)
    result["table"] = str(write_table(table_path, rows.drop(columns="folder"), method_rows(rows)))
    if study.sweeps:
        result["picture"] = str(draw_sweeps(study, rows, out / f"{table or study.name}.png"))
        result |= breaking_points(study, rows)
    for (method, episodes, eval_set), group in rows.groupby(["method", "after_episodes", "eval_set"], sort=False):
        after = f" after {episodes} episodes" if episodes else ""
        if eval_set:
            result[f"{method}{after}, {eval_set}, success of each seed"] = each(group, "success_rate", "{:.0%}")
        if episodes:
            converged = each(group, "training_episodes_to_convergence")
            result[f"{method}{after}, episodes to convergence, each seed"] = converged
    for wanted in study.ratios:
        result |= ratio(rows, wanted)
    return result


def method_rows(rows: pd.DataFrame) -> list[dict[str, Any]]:
    """Return a row for each method, number of training episodes and evaluation set, with few columns.

    A number is the mean over seeds, followed by the smallest and the largest one; forces are the largest of all seeds,
    and episodes with a violation those of all seeds together.
    """
    summary, keys = [], ["method", "after_episodes", "eval_set"]
    rows = rows.reindex(columns=[*keys, "episodes", *_SUMMARIZED])  # a study of baselines has no columns of training
    for (method, after, eval_set), group in rows.groupby(keys, sort=False, dropna=False):
        values = {name: pd.to_numeric(group[name], errors="coerce").to_numpy(float) for name in _SUMMARIZED}
        converged = values["training_episodes_to_convergence"]
        never = int(np.isnan(converged).sum()) if after else 0
        summary.append(
            {
                "method": method,
                "seeds": len(group),
                "training episodes": after,
                "evaluation set": eval_set,
                "episodes per seed": group["episodes"].iloc[0],
                "success [%]": _spread(100.0 * values["success_rate"]),
                "return": _spread(values["mean_return"]),
                "largest force [N]": _combined(np.nanmax, values["peak_force"]),
                "episodes with a violation": _combined(np.nansum, values["violating_episodes"]),
                "success in training [%]": _spread(100.0 * values["training_success_rate"]),
                "training episodes with a violation": _combined(np.nansum, values["training_violating_episodes"]),
                "episodes to convergence": _spread(converged) + (f", {never} never" if never else ""),
            }
        )
    return summary


_SUMMARIZED = (
    "success_rate",
    "mean_return",
    "peak_force",
    "violating_episodes",
    "training_success_rate",
    "training_violating_episodes",
    "training_episodes_to_convergence",
)


def _spread(values: np.ndarray) -> str:
    """Return the mean of numbers with the smallest and the largest one as text; a dash without a number."""
    known = values[~np.isnan(values)]
    if not len(known):
        return cell(None)
    low, mean, high = (f"{number:.3g}" for number in (known.min(), known.mean(), known.max()))
    return mean if low == high else f"{mean} ({low}–{high})"


def _combined(combine: Callable[[np.ndarray], float], values: np.ndarray) -> str:
    return cell(None) if np.isnan(values).all() else f"{combine(values):.4g}"


def each(rows: pd.DataFrame, column: str, form: str = "{}") -> str:
    """Return the values of a column, one per seed, as text; "never" for a missing value."""
    return ", ".join("never" if pd.isna(value) else form.format(value) for value in rows[column])


def ratio(rows: pd.DataFrame, wanted: Ratio) -> dict[str, str]:
    """Return the ratio of a column between two methods, for each seed and for the sums over seeds, as text by label.

    With several evaluation sets or numbers of training episodes, a seed has several rows. Each row then has its own
    labels, with the evaluation set and the number of episodes of the first method. The result is empty if the rows of
    the two methods do not have the same seeds in the same order.
    """
    of, against = (rows[rows["method"] == method] for method in (wanted.method, wanted.against))
    if not len(of) or of["seed"].tolist() != against["seed"].tolist():
        return {}
    numerator, denominator = (table[wanted.of].to_numpy(float) for table in (of, against))
    label = f"{wanted.of.replace('_', ' ')} of {wanted.method} as a fraction of {wanted.against}'s"
    texts, place = {}, of.groupby("seed").cumcount().to_numpy()
    for k in range(place.max() + 1):
        above, below, where = numerator[place == k], denominator[place == k], ""
        if place.max() > 0:
            first = of[place == k].iloc[0]
            where = f" after {first['after_episodes']} episodes" if first["after_episodes"] else ""
            if not wanted.of.startswith("training_"):  # training is the same for all evaluation sets
                where += f", {first['eval_set']}"
        texts[f"{label}{where}, each seed"] = ", ".join(f"{value:.2f}" for value in above / below)
        texts[f"{label}{where}, all seeds together"] = f"{above.sum() / below.sum():.2f}"
    return texts


def _check_columns(study: Study) -> None:
    """Raise an InputError if a statistic is unknown, or a ratio is of a column that the table does not have."""
    statistics = statistics_of(study.task)
    for name in study.statistics:
        if name not in statistics:
            raise InputError(f"there is no statistic {name!r}: {did_you_mean(name, statistics)}")
    known = {*EVALUATED, *(f"training_{name}" for name in (*TRAINING, *study.statistics))}
    for of in (wanted.of for wanted in study.ratios):
        if of not in known:
            raise InputError(f"the study {study.name} has no column {of!r}: {did_you_mean(of, known)}")


def _order_jobs(jobs: list[Job]) -> list[list[int]]:
    """Return the indices of the jobs in groups: a job is in a later group than the job whose run it starts from.

    Raises:
        InputError: If jobs start from each other's runs, or `check_source` refuses the run that a job starts from.
    """
    indices = {job.folder.path: index for index, job in enumerate(jobs)}
    sources = [None if job.source_job is None else indices.get(job.source_job.folder.path) for job in jobs]
    sorter = TopologicalSorter({index: () if source is None else (source,) for index, source in enumerate(sources)})
    try:
        sorter.prepare()
    except CycleError as error:
        job = jobs[error.args[1][0]]
        raise InputError(
            f"{job.method}, seed {job.seed}, would start from its own run: let init_from name another method's run"
        ) from None
    for job, source in zip(jobs, sources, strict=True):
        check_source(job, is_source_selected=source is not None)
    groups = []
    while sorter.is_active():
        groups.append(sorted(sorter.get_ready()))
        sorter.done(*groups[-1])
    return groups


def _run_jobs(jobs: list[Job], groups: list[list[int]], engine: Engine) -> dict[int, Outcome]:
    """Return the outcome of each job, group by group; the rows of finished jobs are read in this process."""
    to_run = {index: job for index, job in enumerate(jobs) if not is_done(job)}
    outcomes: dict[int, Outcome] = {}
    failed: dict[Path, str] = {}  # failed jobs by folder
    call = secrets.token_hex(4)
    work = partial(attempt, work=run_job, versions=installed_versions(), call=call)
    with StudyProgress(to_run, len(jobs), call) as progress, engine if to_run else nullcontext():

        def end(index: int, outcome: Outcome) -> None:
            outcomes[index], job = outcome, jobs[index]
            if outcome.failure:
                failed[job.folder.path] = f"{job.method}, seed {job.seed}"
            progress.end(index, job, outcome)

        if to_run:
            try:
                jobs[0].log.parent.mkdir(parents=True, exist_ok=True)
            except OSError as error:
                raise InputError(
                    f"{jobs[0].out} cannot be written ({error.strerror}): name another folder with --out"
                ) from error
        for group in groups:
            ready = {}
            for index in group:
                job, source = jobs[index], jobs[index].source_job
                if index not in to_run:
                    try:
                        end(index, Outcome(tuple(run_job(job))))
                    except (Exception, SystemExit) as error:  # as in `attempt`
                        end(index, log_failure(job, error))
                elif source is not None and source.folder.path in failed:
                    end(index, Outcome(failure=f"it starts from the run of {failed[source.folder.path]}, which failed"))
                else:
                    ready[index] = job
            for index, outcome in engine.run(work, ready) if ready else ():
                end(index, outcome)
    return outcomes


def _refuse_shared_folders(jobs: list[Job]) -> None:
    """Raise an InputError if two jobs have the same folder: two workers would overwrite each other's files."""
    owners: dict[Path, Job] = {}
    for job in jobs:
        other = owners.setdefault(job.folder.path, job)
        if other is not job:
            raise InputError(
                f"{job.folder.path} would hold the runs of {other.method}, seed {other.seed}, and of {job.method}, "
                f"seed {job.seed}: write the study's folder with {{method}} and {{seed}}"
            )


def draw_sweeps(study: Study, rows: pd.DataFrame, path: Path) -> Path:
    """Draw a panel for each sweep, the success rate of all seeds against the quantity; return the picture's path.

    The band spans all seeds' 95 % intervals. Harder values are to the right. A cross marks where the success rate of a
    method falls below `BREAKING_SUCCESS`, unless it is below at the first value.

    If a method is evaluated after several numbers of training episodes, the results of the largest number are drawn.
    """
    width = max(4.4 * len(study.sweeps), 1.3 * len(study.methods))  # the legend is one line
    figure, axes = new_figure(1, len(study.sweeps), (width, 3.6))
    for axis, sweep in zip(axes.flat, study.sweeps, strict=True):
        for index, name in enumerate(study.methods):
            values, points = curve(sweep, rows, name)
            if not values:
                continue
            rate, low, high = np.array(points, dtype=float).T
            style, label = f"o{LINE_STYLES[index % len(LINE_STYLES)]}", name.replace("_", " ")
            (line,) = axis.plot(values, rate, style, color=f"C{index % 10}", markersize=3, label=label)
            axis.fill_between(values, low, high, color=line.get_color(), alpha=0.12, linewidth=0)
            at = breaking_point(values, rate.tolist())
            if isinstance(at, float):
                axis.plot(at, BREAKING_SUCCESS, "x", color=line.get_color(), markersize=9, markeredgewidth=2)
        axis.axhline(BREAKING_SUCCESS, color="0.7", linewidth=0.7, linestyle=":")
        axis.set(xlabel=sweep.quantity, ylabel="success", ylim=(-0.03, 1.03))
        values = list(sweep.at)
        if values[0] > values[-1]:
            axis.invert_xaxis()
    legend(figure, axes.flat[0])
    return save_figure(figure, path)


def breaking_points(study: Study, rows: pd.DataFrame) -> dict[str, str]:
    """Return the breaking point of each method in each sweep, as text by label."""
    texts = {}
    for sweep in study.sweeps:
        for name in study.methods:
            values, points = curve(sweep, rows, name)
            if values:
                label = f"{name}, below {BREAKING_SUCCESS:.0%} at {sweep.quantity}"
                texts[label] = format_breaking_point(values, points)
    return texts


def format_breaking_point(values: Sequence[float], points: Sequence[tuple[float, float, float]]) -> str:
    """Return the breaking point of a curve as text: a number, `NEVER` or `AT_ONCE`.

    `points` are success rate, lower and upper bound at each of `values`, as `curve` returns them.
    """
    at = breaking_point(values, [rate for rate, _, _ in points])
    return at if isinstance(at, str) else f"{at:.3g}"


def curve(sweep: Sweep, rows: pd.DataFrame, name: str) -> tuple[list[float], list[tuple[float, float, float]]]:
    """Return the values of a sweep at which the method `name` was evaluated, the easiest first, and a point for each.

    A point is the success rate of all seeds, and the lowest and highest end of the seeds' 95 % intervals.
    """
    points = {value: _pooled_success(rows, name, sweep.eval_set(value).name) for value in sweep.at}
    evaluated = {value: point for value, point in points.items() if point is not None}
    return list(evaluated), list(evaluated.values())


def breaking_point(values: Sequence[float], rates: Sequence[float]) -> float | str:
    """Return the value where the success rate first falls below `BREAKING_SUCCESS`, interpolated linearly.

    The result is `AT_ONCE` if the rate at the first, easiest value is below it, and `NEVER` if no rate is below it.
    """
    if rates[0] < BREAKING_SUCCESS:
        return AT_ONCE
    for (v0, r0), (v1, r1) in itertools.pairwise(zip(values, rates, strict=True)):
        if r1 < BREAKING_SUCCESS:
            return float(v0 + (v1 - v0) * (r0 - BREAKING_SUCCESS) / (r0 - r1))
    return NEVER


def _pooled_success(rows: pd.DataFrame, method: str, eval_set: str) -> tuple[float, float, float] | None:
    """Return the success rate of all seeds, and the lowest and highest end of their intervals; None without rows."""
    selected = rows[(rows["method"] == method) & (rows["eval_set"] == eval_set)]
    selected = selected[selected["after_episodes"] == selected["after_episodes"].max()]
    if not len(selected):
        return None
    episodes = selected["episodes"].astype(int)
    successes = (selected["success_rate"] * episodes).astype(float).round().astype(int)
    lows, highs = zip(*map(wilson, successes, episodes), strict=True)
    return successes.sum() / episodes.sum(), min(lows), max(highs)
