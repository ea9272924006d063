"""Parallel actors: `python -m research.benchmarks actors [TASK --env ...]`.

Short runs with 0 (on one core), 1 and 2 actors are trained. The wall-clock time of an episode is compared with a model,
which is then extrapolated to more cores. The model uses the processor times of simulation and learning.
"""

from __future__ import annotations

import os
import resource
import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from guiderail.tools.learning.run_folder import RunFolder, configure
from guiderail.tools.learning.trainer import Observers, run_training
from research.benchmarks import with_progress

EPISODES, SKIPPED = 12, 5  # number of episodes of a run, and number of the first ones, which are not timed
MEASURED = ((1, 0), (2, 1), (2, 2))  # numbers of cores and of actors of the measured runs
EXTRAPOLATED = ((16, 4), (100, 4))  # numbers of cores and of actors for which the model is evaluated


def seconds_per_episode(simulation: float, learning: float, cores: int, num_envs: int) -> float:
    """Return the wall-clock time of a training episode [s].

    Without actors, one process simulates and learns in turn. With N actors, the time is the largest of three times: all
    work divided by the number of cores, the learning in one process, and the simulation divided by N.

    Args:
        simulation: Processor time of an episode's simulation [s].
        learning: Processor time of learning from an episode [s].
        cores: Number of cores.
        num_envs: Number N of actors; 0 for none.
    """
    if num_envs == 0:
        return simulation + learning
    return max((simulation + learning) / cores, learning, simulation / num_envs)


def measure(task: str = "BncConnector", environment: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Run the benchmark."""
    environment = {"difficulty": "hard"} if environment is None else environment
    runs = {
        (cores, num_envs): _run(task, environment, cores, num_envs)
        for cores, num_envs in with_progress(MEASURED, "actors")
    }
    parallel = runs[2, 2]  # separate processes simulate and learn
    simulation, learning = parallel["actors"], parallel["learner"]
    rows = [
        {
            "cores": cores,
            "actors": num_envs,
            "measured": runs.get((cores, num_envs), {}).get("wall"),
            "model": seconds_per_episode(simulation, learning, cores, num_envs),
        }
        for cores, num_envs in MEASURED + EXTRAPOLATED
    ]
    return {"task": task, "simulation": simulation, "learning": learning, "rows": rows}


def _run(task: str, environment: Mapping[str, Any], cores: int, num_envs: int) -> dict[str, float]:
    """Train a run; return the wall-clock time and the processor times of learner and actors, per episode [s]."""
    config = configure(task, environment, **{"episodes": EPISODES, "settings": _settings(num_envs)})
    clocks: list[tuple[float, float]] = []
    before = _time_of_children()
    with _cores(cores), tempfile.TemporaryDirectory() as folder:
        run_training(
            RunFolder(Path(folder) / "run"),
            config,
            observers=Observers(lambda row: clocks.append((time.perf_counter(), time.process_time()))),
        )
    timed = EPISODES - SKIPPED
    wall, own = ((clocks[-1][i] - clocks[SKIPPED - 1][i]) / timed for i in range(2))
    return {"wall": wall, "learner": own, "actors": (_time_of_children() - before) / EPISODES}


def _settings(num_envs: int) -> dict[str, Any]:
    return {"num_envs": num_envs, "exploration.constant_episodes": 0}  # constant actions end some episodes early


def _time_of_children() -> float:
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


@contextmanager
def _cores(number: int) -> Iterator[None]:
    """Let this process and its forks use at most `number` cores."""
    own = os.sched_getaffinity(0)
    os.sched_setaffinity(0, sorted(own)[:number])
    try:
        yield
    finally:
        os.sched_setaffinity(0, own)


def show(results: dict[str, Any]) -> None:
    """Print the results."""
    print(
        f"{results['task']}: {results['simulation']:.2f} s to simulate an episode, {results['learning']:.2f} s to learn"
    )
    for row in results["rows"]:
        measured = "" if row["measured"] is None else f", measured {row['measured']:.2f} s"
        print(f"{row['cores']:4d} cores, {row['actors']} actors: {row['model']:.2f} s an episode{measured}")
