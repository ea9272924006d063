"""Several runs side by side: the same task, guidances and learners over seeds, two runs at a time."""

import multiprocessing
import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from guiderail.models.errors import InputError
from guiderail.tools.files import write_atomically
from guiderail.tools.learning.run_folder import RunConfig, RunFolder, converged_after, table_text

PROCESSES = 2


@dataclass(frozen=True)
class Job:
    """One run of a study, and where it goes."""

    name: str  # the same for all seeds
    config: RunConfig
    folder: Path
    evaluations: int = 0  # held-out episodes afterwards


def run_jobs(jobs: Sequence[Job], processes: int = PROCESSES) -> list[dict[str, Any]]:
    """Runs what is not there yet, each in its own process with one thread, and returns a row for each job.

    A run that is complete is used again; one that was interrupted goes on.

    Raises:
        InputError: if a folder holds another run than the one wanted.
    """
    for job in jobs:
        _refuse_another(job)  # before anything starts
    results = {index: run_job(job) for index, job in enumerate(jobs) if _finished(job) and not job.evaluations}
    waiting = [index for index in range(len(jobs)) if index not in results]
    if waiting:
        results |= _run_in_processes(jobs, waiting, min(processes, len(waiting)))
    return [results[index] for index in range(len(jobs))]


def _run_in_processes(jobs: Sequence[Job], indices: Sequence[int], processes: int) -> dict[int, dict[str, Any]]:
    """Runs those jobs side by side, and says how far it is."""
    results: dict[int, dict[str, Any]] = {}
    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    # Fresh processes: a forked one would inherit the threads and random generators of this one.
    context = multiprocessing.get_context("spawn")
    with (
        Progress(*columns, console=console, disable=not console.is_terminal) as progress,
        ProcessPoolExecutor(max_workers=processes, mp_context=context, initializer=_one_thread) as pool,
    ):
        bar = progress.add_task("runs", total=len(indices))
        waiting = {pool.submit(run_job, jobs[index]): index for index in indices}
        for future in as_completed(waiting):
            index = waiting[future]
            results[index] = future.result()
            progress.advance(bar)
            if not console.is_terminal:
                job = jobs[index]
                console.print(f"{len(results)}/{len(indices)} runs: {job.name}, seed {job.config.seed}", soft_wrap=True)
    return results


def run_job(job: Job) -> dict[str, Any]:
    """Trains one run of a study, or finds it finished; returns what it came to."""
    from guiderail.models.policy import Policy
    from guiderail.tools.learning.train import train
    from guiderail.tools.rollouts.judging import held_out

    folder = RunFolder(job.folder)
    _refuse_another(job)
    rows = folder.episodes() if _finished(job) else train(folder, job.config, resume=_begun(job))
    result = {"name": job.name, "seed": job.config.seed, **summary(rows), "folder": str(job.folder)}
    if job.evaluations:
        judged = held_out(job.config, Policy.load(job.folder), episodes=job.evaluations)
        result["held_out_success"] = float(np.mean([row["success"] for row in judged]))
        result["held_out_return"] = float(np.mean([row["return"] for row in judged]))
    return result


def summary(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """A run in a row of a table: all of it comes from `episodes.csv`."""
    last = rows[-10:]
    mean = {key: float(np.mean([row[key] for row in last])) for key in ("success", "return")}
    return {
        "episodes": len(rows),
        "success": float(np.mean([row["success"] for row in rows])),
        "converged_after": converged_after(bool(row["success"]) for row in rows),
        "success_last_10": mean["success"],
        "return_last_10": mean["return"],
        "collisions": float(np.sum([row["collisions"] for row in rows])),
        "episodes_with_violation": sum(row["worst_measured_violation"] > 1e-9 for row in rows),
        "worst_violation": float(np.max([row["worst_violation"] for row in rows])),
        "worst_measured_violation": float(np.max([row["worst_measured_violation"] for row in rows])),
        "peak_force": float(np.max([row["peak_force"] for row in rows])),
        "jerk_commanded_linear": float(np.mean([row["jerk_commanded_linear"] for row in rows[:10]])),
        "jerk_measured_linear": float(np.mean([row["jerk_measured_linear"] for row in rows[:10]])),
        "wall_time": float(np.sum([row["wall_time"] for row in rows])),
    }


def write_table(path: Path, rows: Sequence[Mapping[str, Any]]) -> Path:
    """The same rows as `path`.csv, exact, and as `path`.md, readable; returns the latter."""
    write_atomically(path.with_suffix(".csv"), table_text(rows).encode())
    keys = [key for key in rows[0] if key != "folder"]
    lines = ["| " + " | ".join(key.replace("_", " ") for key in keys) + " |", "|" + "---|" * len(keys)]
    lines += ["| " + " | ".join(_cell(row[key]) for key in keys) + " |" for row in rows]
    write_atomically(path.with_suffix(".md"), ("\n".join(lines) + "\n").encode())
    return path.with_suffix(".md")


def study(
    task: str,
    out: Path,
    *,
    guidance: Sequence[str],
    algorithms: Sequence[str],
    seeds: int,
    episodes: int,
    preset: str = "robust",
    hold: int | None = None,
    evaluations: int = 20,
) -> dict[str, Any]:
    """Trains every combination over seeds 0 … seeds − 1 and writes `study.csv` and `study.md` with one row a run."""
    from guiderail.tools.learning.configure import configure

    if seeds < 1:
        raise InputError(f"a study needs at least one seed, not {seeds}")
    jobs = []
    for algorithm in algorithms:
        for one in guidance:
            environment = {"guidance": one} | ({} if hold is None else {"hold": hold})
            for seed in range(seeds):
                config = configure(task, environment, algorithm=algorithm, preset=preset, episodes=episodes, seed=seed)
                name = f"{one}-{algorithm}"
                jobs.append(Job(name, config, out / f"{name}-{seed}", evaluations))
    rows = run_jobs(jobs)
    table = write_table(out / "study", rows)
    return {"table": str(table), "runs": len(rows)} | {
        f"{name}_held_out_success": float(np.mean([row["held_out_success"] for row in rows if row["name"] == name]))
        for name in dict.fromkeys(row["name"] for row in rows)
        if evaluations
    }


def _one_thread() -> None:
    os.environ["OMP_NUM_THREADS"] = "1"


def _begun(job: Job) -> bool:
    return (job.folder / "config.yaml").exists()


def _finished(job: Job) -> bool:
    complete = _begun(job) and (job.folder / "policy.json").exists()
    return complete and len(RunFolder(job.folder).episodes()) == job.config.episodes


def _refuse_another(job: Job) -> None:
    """A folder that holds another run is never trained further as if it were this one."""
    if not _begun(job):
        return RunFolder(job.folder).refuse_existing()
    return RunFolder(job.folder).refuse_another(job.config, also=["episodes"])


def _cell(value: Any) -> str:
    return "–" if value is None else f"{value:.4g}" if isinstance(value, float) else str(value)
