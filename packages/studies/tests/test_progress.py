import io
from pathlib import Path
from types import SimpleNamespace

from rich.console import Console

from guiderail_studies.engines.engine import Outcome
from guiderail_studies.progress import StudyProgress


def make_job(folder: Path, seed: int):
    (folder / f"run-{seed}").mkdir()
    run = SimpleNamespace(path=folder / f"run-{seed}")
    return SimpleNamespace(method="kgrl", seed=seed, after_episodes=[2, 4], folder=run, log=folder / f"{seed}.txt")


def begin(job, episodes, workers=1, call="this call"):
    """Log the attempts of workers at a job, and write the table of its training episodes."""
    with job.log.open("a") as log:
        log.write(f"2026-01-01 attempt of study call {call} begins on here, process 1\n" * workers)
    if episodes:
        (job.folder.path / "episodes.csv").write_text("episode\n" + "0\n" * episodes)


def test_progress_shows_running_and_ended_jobs(tmp_path):
    jobs = {seed: make_job(tmp_path, seed) for seed in range(5)}
    begin(jobs[4], 4, call="earlier call")  # waits, because the attempt belongs to another call
    console = Console(file=io.StringIO(), force_terminal=True, width=120)
    with StudyProgress(jobs, 6, "this call", console) as progress:
        begin(jobs[0], 3)
        begin(jobs[1], 4, workers=2)
        begin(jobs[2], 0)
        progress.end(5, make_job(tmp_path, 5), Outcome())  # finished by an earlier call
        progress.end(2, jobs[2], Outcome(failure="learning diverged"))
        console.print(progress._table())
    printed = console.file.getvalue()
    assert "1/6 kgrl, seed 5\r" in printed or "1/6 kgrl, seed 5\n" in printed
    assert "2/6 kgrl, seed 2: failed: learning diverged" in printed
    assert [line.split() for line in printed.splitlines() if "episodes" in line] == [
        ["kgrl,", "seed", "0", "3/4", "episodes"]
    ]
    assert "evaluated, by worker 2" in printed
    assert "2 of 6 ended, 1 failed, 2 waiting" in printed


def test_progress_prints_a_line_per_ended_job_in_a_file(tmp_path):
    job, console = make_job(tmp_path, 0), Console(file=io.StringIO())
    with StudyProgress({0: job}, 1, "this call", console) as progress:
        begin(job, 4, workers=2)
        begin(job, 0, call="other call")  # of another process, which the lock of the run refuses
        progress.end(0, job, Outcome(({"eval_set": "held out", "success_rate": 0.5},)))
    assert console.file.getvalue() == "1/1 kgrl, seed 0: held out 50% (by worker 2; the workers before it were lost)\n"
