"""What it costs that nothing of a run is lost: `guiderail bench saving`.

A short run is trained, and the time for its step log and its checkpoints is given as a part of the whole: in wall clock,
as most of it is waiting for the disk.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from guiderail.tools.evaluation.step_log import StepLog
from guiderail.tools.learning import trainer as train
from guiderail.tools.learning.run_folder import RunFolder
from guiderail.tools.learning.train import configure, with_defaults
from research.benchmarks import with_progress

TASKS = {"NarrowPassage": 10, "BncConnector": 6}  # and so many episodes
REQUIRED_SHARE = 0.03


@contextmanager
def timed(owner: Any, name: str) -> Iterator[list[float]]:
    """While it lasts, calls of a function are timed: yields the seconds of each."""
    original, spent = getattr(owner, name), []

    def call(*arguments: Any) -> Any:
        started = time.perf_counter()
        try:
            return original(*arguments)
        finally:
            spent.append(time.perf_counter() - started)

    setattr(owner, name, call)
    try:
        yield spent
    finally:
        setattr(owner, name, original)


def saving_share(task: str, episodes: int, seed: int = 0) -> dict[str, float]:
    """Trains a run of so many episodes in a temporary folder: what saving it took, as parts of the whole."""
    config = configure(task, {}, **with_defaults(task, {"episodes": episodes, "seed": seed}))
    with (
        tempfile.TemporaryDirectory() as folder,
        timed(StepLog, "on_episode_end") as step_log,
        timed(train, "_save") as checkpoints,
    ):
        rows = train.train(RunFolder(Path(folder) / "run"), config)
    seconds = sum(row["wall_time"] for row in rows) + sum(checkpoints)
    return {
        "seconds": seconds,
        "step_log_share": sum(step_log) / seconds,
        "checkpoint_share": sum(checkpoints) / seconds,
        "checkpoints": len(checkpoints),
        "step_log_ms_per_episode": 1e3 * sum(step_log) / len(step_log),
    }


def measure() -> dict[str, Any]:
    """All of it, as a program may read it."""
<<<<<<< HEAD
    results: dict[str, Any] = {task: saving_share(task, TASKS[task]) for task in told(TASKS, "saving")}
    shares = [results[task]["step_log_share"] + results[task]["checkpoint_share"] for task in TASKS]
=======
    results: dict[str, Any] = {task: saving_share(task, TASKS[task]) for task in with_progress(TASKS, "saving")}
    shares = [results[task]["ledger_share"] + results[task]["checkpoint_share"] for task in TASKS]
>>>>>>> bd4af1f (Command lines of benchmarks, action fuzzing and generators; campaigns in plain words)
    results["cheap_enough"] = max(shares) <= REQUIRED_SHARE
    return results


def show(results: dict[str, Any]) -> None:
    """Prints what was measured."""
    for task, episodes in TASKS.items():
        row = results[task]
        print(
            f"{task:14s} {episodes} episodes in {row['seconds']:.0f} s: step log {row['step_log_share']:.2%} "
            f"({row['step_log_ms_per_episode']:.1f} ms an episode), {row['checkpoints']} checkpoints "
            f"{row['checkpoint_share']:.2%} (at most {REQUIRED_SHARE:.0%} together)"
        )
