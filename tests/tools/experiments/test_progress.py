import io
from pathlib import Path
from types import SimpleNamespace

from rich.console import Console

from guiderail.tools.experiments.engines.engine import Outcome
from guiderail.tools.experiments.progress import StudyProgress


def job(folder: Path, seed: int):
    (folder / f"run-{seed}").mkdir()
    run = SimpleNamespace(path=folder / f"run-{seed}")
    return SimpleNamespace(method="kgrl", seed=seed, after_episodes=[2, 4], folder=run, log=folder / f"{seed}.txt")


def begin(one, episodes, workers=1, call="now"):
    with one.log.open("a") as log:
        log.write(f"2026-01-01 attempt of study call {call} begins on here, process 1\n" * workers)
    if episodes:
        (one.folder.path / "episodes.csv").write_text("episode\n" + "0\n" * episodes)


def test_progress_shows_running_and_ended_jobs(tmp_path):
    jobs = {n: job(tmp_path, n) for n in range(5)}
    begin(jobs[4], 4, call="before")  # in an earlier study: it waits
    console = Console(file=io.StringIO(), force_terminal=True, width=120)
    board = StudyProgress(jobs, 6, "now", console)
    with board:
        begin(jobs[0], 3)
        begin(jobs[1], 4, workers=2)
        begin(jobs[2], 0)
        board.end(5, job(tmp_path, 5), Outcome())  # finished before
        board.end(2, jobs[2], Outcome(failure="learning diverged"))
        console.print(board._table())
    shown = console.file.getvalue()
    assert "1/6 kgrl, seed 5\r" in shown or "1/6 kgrl, seed 5\n" in shown
    assert "2/6 kgrl, seed 2: failed: learning diverged" in shown
    assert [line.split() for line in shown.splitlines() if "episodes" in line] == [
        ["kgrl,", "seed", "0", "3/4", "episodes"]
    ]
    assert "evaluated, by worker 2" in shown
    assert "2 of 6 ended, 1 failed, 2 waiting" in shown


def test_progress_prints_a_line_per_ended_job_in_a_file(tmp_path):
    one, console = job(tmp_path, 0), Console(file=io.StringIO())
    with StudyProgress({0: one}, 1, "now", console) as board:
        begin(one, 4, workers=2)
        begin(one, 0, call="other")  # by another process, which the lock of the run refuses
        board.end(0, one, Outcome(({"eval_set": "held out", "success_rate": 0.5},)))
    assert console.file.getvalue() == "1/1 kgrl, seed 0: held out 50% (by worker 2; the workers before it were lost)\n"
