"""Cost of saving a run: `python -m research.benchmarks saving`.

A short run is trained. The results are the fractions of its wall-clock time for writing its step log and its
checkpoints. Most of this time is spent waiting for the disk.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

from guiderail.tools.evaluation.step_log import StepLog
from guiderail.tools.learning import trainer
from guiderail.tools.learning.run_folder import RunFolder, configure
from research.benchmarks import with_progress

TASKS = {"NarrowPassage": 10, "BncConnector": 6}  # number of episodes
REQUIRED_SHARE = 0.03  # largest accepted sum of both fractions


@contextmanager
def timed(owner: Any, name: str) -> Iterator[list[float]]:
    """Time the calls of a function; yield the list of their durations [s]."""
    original, spent = getattr(owner, name), []

    def call(*arguments: Any) -> Any:
        started = time.perf_counter()
        try:
            return original(*arguments)
        finally:
            spent.append(time.perf_counter() - started)

    with patch.object(owner, name, call):
        yield spent


def saving_share(task: str, episodes: int, seed: int = 0) -> dict[str, float]:
    """Train a run in a temporary folder; return its duration [s], and the shares and numbers of saving."""
    config = configure(task, {}, **{"episodes": episodes, "seed": seed})
    with (
        tempfile.TemporaryDirectory() as folder,
        timed(StepLog, "on_episode_end") as step_log,
        timed(trainer.TrainingLoop, "write_checkpoint") as checkpoints,
    ):
        rows = trainer.run_training(RunFolder(Path(folder) / "run"), config)
    seconds = sum(row["wall_time"] for row in rows) + sum(checkpoints)
    return {
        "seconds": seconds,
        "step_log_share": sum(step_log) / seconds,
        "checkpoint_share": sum(checkpoints) / seconds,
        "checkpoints": len(checkpoints),
        "step_log_ms_per_episode": 1e3 * sum(step_log) / len(step_log),
    }


def measure() -> dict[str, Any]:
    """Run the benchmark."""
    results: dict[str, Any] = {task: saving_share(task, TASKS[task]) for task in with_progress(TASKS, "saving")}
    shares = [results[task]["step_log_share"] + results[task]["checkpoint_share"] for task in TASKS]
    results["cheap_enough"] = max(shares) <= REQUIRED_SHARE
    return results


def show(results: dict[str, Any]) -> None:
    """Print the results."""
    for task, episodes in TASKS.items():
        row = results[task]
        print(
            f"{task:14s} {episodes} episodes in {row['seconds']:.0f} s: step log {row['step_log_share']:.2%} "
            f"({row['step_log_ms_per_episode']:.1f} ms an episode), {row['checkpoints']} checkpoints "
            f"{row['checkpoint_share']:.2%} (at most {REQUIRED_SHARE:.0%} together)"
        )
