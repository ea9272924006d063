"""Studies: train and evaluate methods over seeds, and write a table with one row each.

Each seed has rows of its own, so that failures of single seeds are not averaged away. A study that was interrupted
resumes with the same call, and studies that share runs use them again. An engine runs the jobs; the rows are the same
from each engine.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Protocol

import pandas as pd
from rich.console import Console

from guiderail.models.common.errors import InputError, RunsFailedError
from guiderail.models.common.registry import did_you_mean
from guiderail.tools.environments import import_modules
from guiderail.tools.experiments.declaration import Ratio, Study
from guiderail.tools.experiments.engines.engine import Engine, Outcome, make_engine
from guiderail.tools.experiments.job import EVALUATED, TRAINING, Job, check_job, is_done, run_job
from guiderail.tools.experiments.progress import StudyProgress
from guiderail.tools.experiments.sweep import breaking_points, draw_sweeps
from guiderail.tools.experiments.worker import Attempt
from guiderail.tools.learning.run_folder import RunConfig, installed_versions
from guiderail.tools.tables import write_table

ALL_METHODS = "all methods"


class DescribeDifferences(Protocol):
    """Function that describes how a run's configuration differs from a reference, such as a publication."""

    def __call__(self, config: RunConfig, *, learns: bool = True) -> list[str]:
        """Return sentences; with `learns` False, none on the learner."""


def run_study(study: Study, out: Path, engine: Engine | None = None, console: Console | None = None) -> pd.DataFrame:
    """Run the jobs of a study that are not done.

    Args:
        study: Study.
        out: Folder of the study; runs in it are used again, and interrupted ones resume.
        engine: Engine that runs the jobs; two processes by default.
        console: Console of the progress; standard error by default.

    Returns:
        A row for each method, seed, number of training episodes and evaluation set, in this order.

    Raises:
        InputError: Before anything is written, if the declaration makes no sense or a folder holds another run.
        RunsFailedError: At the end, if some jobs failed.
    """
    if out.exists() and not out.is_dir():
        raise InputError(f"{out} is a file: name a folder with --out")
    # Workers may have another working directory.
    study, out = study.model_copy(update={"imports": import_modules(study.imports)}), out.absolute()
    jobs = [
        Job(study, name, seed, out) for name, method in study.methods.items() for seed in method.seeds or study.seeds
    ]
    _check_ratios(study)
    for job in jobs:
        check_job(job)
    _refuse_shared_folders(jobs)
    outcomes = _run_jobs(jobs, engine or make_engine(), console)
    rows = pd.DataFrame([row for index in range(len(jobs)) for row in outcomes[index].rows], dtype=object)
    failed = [
        f"{job.method}, seed {job.seed}, failed: {outcomes[index].failure}"
        for index, job in enumerate(jobs)
        if outcomes[index].failure
    ]
    if failed:
        raise RunsFailedError(failed, rows)
    return rows


def study_command(
    study: Study,
    out: Path,
    engine: Engine | None = None,
    table: str | None = None,
    describe_differences: DescribeDifferences | None = None,
) -> dict[str, Any]:
    """Run a study, write its table as `.csv` and `.md`, and return a summary with each seed by itself.

    Args:
        study: Study.
        out: Folder of the study.
        engine: Engine that runs the jobs; two processes by default.
        table: Name of the table; the study's name by default.
        describe_differences: Describes how a run's configuration differs from a reference, such as a publication.

    Returns:
        The summary; `differences` has the sentences of `describe_differences` by method, and `failed` those of failed
        jobs, which the table does not have.
    """
    result: dict[str, Any] = {}
    try:
        rows = run_study(study, out, engine)
    except RunsFailedError as error:
        rows, result["failed"] = error.rows, error.sentences
        if not len(rows):
            return result
    result["table"] = str(write_table(out / (table or study.name), rows.drop(columns="folder")))
    if study.sweeps:
        result["picture"] = str(draw_sweeps(study, rows, out / f"{table or study.name}.png"))
        result |= breaking_points(study, rows)
    for (method, episodes, eval_set), group in rows.groupby(["method", "after_episodes", "eval_set"], sort=False):
        after = f" after {episodes} episodes" if episodes else ""
        if eval_set:
            result[f"{method}{after}, {eval_set}, success of each seed"] = each(group, "success_rate", "{:.0%}")
        if episodes:
            result[f"{method}{after}, episodes to convergence, each seed"] = each(
                group, "training_episodes_to_convergence"
            )
    for one in study.ratios:
        result |= ratio(rows, one)
    if describe_differences is not None:
        result["differences"] = differences_by_method(study, describe_differences)
    return result


def differences_by_method(study: Study, describe_differences: DescribeDifferences) -> dict[str, list[str]]:
    """Return the differences from a reference: first those of all methods, then those of groups of methods."""
    differences = {}
    for method in study.methods:
        job = Job(study, method, study.seeds[0], Path())
        differences[method] = describe_differences(job.config(job.after_episodes[-1]), learns=job.learns)
    first, *others = differences.values()
    common = [sentence for sentence in first if all(sentence in other for other in others)]
    groups: dict[tuple[str, ...], list[str]] = {}
    for method, sentences in differences.items():
        groups.setdefault(tuple(one for one in sentences if one not in common), []).append(method)
    shared = {ALL_METHODS: common} if common else {}
    return shared | {", ".join(methods): list(sentences) for sentences, methods in groups.items() if sentences}


def each(rows: pd.DataFrame, column: str, form: str = "{}") -> str:
    """Return the values of a column, one per seed; "never" for a missing one."""
    return ", ".join("never" if pd.isna(value) else form.format(value) for value in rows[column])


def ratio(rows: pd.DataFrame, wanted: Ratio) -> dict[str, str]:
    """Return the ratio of a column between two methods, for each seed and for the sums; empty if a row is missing."""
    of, against = (rows[rows["method"] == method] for method in (wanted.method, wanted.against))
    if not len(of) or of["seed"].tolist() != against["seed"].tolist():
        return {}
    numerator, denominator = (one[wanted.of].to_numpy(float) for one in (of, against))
    label = f"{wanted.of.replace('_', ' ')} of {wanted.method} as a part of {wanted.against}'s"
    return {
        f"{label}, each seed": ", ".join(f"{value:.2f}" for value in numerator / denominator),
        f"{label}, all seeds together": f"{numerator.sum() / denominator.sum():.2f}",
    }


def _check_ratios(study: Study) -> None:
    known = {*EVALUATED, *(f"training_{name}" for name in (*TRAINING, *study.statistics))}
    for one in study.ratios:
        if one.of not in known:
            raise InputError(f"the study {study.name} has no column {one.of!r}: {did_you_mean(one.of, known)}")


def _run_jobs(jobs: list[Job], engine: Engine, console: Console | None) -> dict[int, Outcome]:
    """Return the outcome of each job; those that are done are read in this process."""
    done = {index: job for index, job in enumerate(jobs) if is_done(job)}
    to_run = {index: job for index, job in enumerate(jobs) if index not in done}
    outcomes: dict[int, Outcome] = {}
    with StudyProgress(to_run, len(jobs), console) as progress:
        for index, job in done.items():
            try:
                outcomes[index] = Outcome(tuple(run_job(job)))
            except InputError as error:
                outcomes[index] = Outcome(failure=str(error))
            progress.end(index, job, outcomes[index])
        if to_run:
            with engine:
                _make_log_folder(jobs[0])
                for index, outcome in engine.run(Attempt(run_job, installed_versions()), to_run):
                    outcomes[index] = outcome
                    progress.end(index, jobs[index], outcome)
    return outcomes


def _make_log_folder(job: Job) -> None:
    try:
        job.log.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{job.out} cannot be written ({error.strerror}): name another folder with --out") from error


def _refuse_shared_folders(jobs: list[Job]) -> None:
    """Raise an InputError if two jobs have the same folder: two workers would overwrite each other's files."""
    owners: dict[Path, Job] = {}
    for job in jobs:
        other = owners.setdefault(job.folder.path, job)
        if other is not job:
            raise InputError(
                f"{job.folder.path} would hold both runs of {other.method}, seed {other.seed} and of {job.method}, "
                f"seed {job.seed}: write the study's folder with {{method}} and {{seed}}"
            )
