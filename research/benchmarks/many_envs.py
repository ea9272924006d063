"""Parallel environments, one process each: `python -m research.benchmarks many_envs`.

Gymnasium's vector environment (`gymnasium.make_vec`) waits for the slowest process at every step. It sends actions to
and reads results from one environment after the other. The serial part is the duration of this communication per
environment. The rate for more cores than the machine has is extrapolated: n environments on n cores take the time of a
single environment plus n − 1 serial parts.
"""

from __future__ import annotations

import multiprocessing
import os
import time
from typing import Any

import gymnasium

import guiderail  # noqa: F401 (registers the environments)
from research.benchmarks import with_progress

ENVIRONMENT = "guiderail/BncConnector-v0"
OPTIONS: dict[str, Any] = {"guidance": "kgrl", "fixture_offset": "per_episode", "action_repeat": 5}
CORES = 16  # cores of the extrapolation
STEPS = 300  # steps of the vector environment in each measurement


def measure(*, steps: int = STEPS, counts: tuple[int, ...] | None = None) -> dict[str, Any]:
    """Measure control steps per second by number of environments, and extrapolate.

    Args:
        steps: Steps of the vector environment.
        counts: Numbers of environments; one and the number of cores by default.
    """
    cores = len(os.sched_getaffinity(0))
    counts = counts or tuple(sorted({1, cores}))
    multiprocessing.set_forkserver_preload(["guiderail.diagrams.envs.make"])
    measured = {count: _measured(count, steps) for count in with_progress(counts, "environments")}
    alone = measured[min(measured)]
    serial = measured[max(measured)]["own_seconds"] / max(measured)
    action_repeat = OPTIONS["action_repeat"]
    return {
        "cores": cores,
        "control_steps_per_second": {count: action_repeat * count / row["seconds"] for count, row in measured.items()},
        "serial_ms_per_environment": 1e3 * serial,
        "extrapolated_cores": CORES,
        "extrapolated_control_steps_per_second": action_repeat * CORES / (alone["seconds"] + (CORES - 1) * serial),
    }


def _measured(count: int, steps: int) -> dict[str, float]:
    """Return the wall-clock time of a step of the vector environment and the CPU time of this process in it [s]."""
    envs = gymnasium.make_vec(
        ENVIRONMENT,
        num_envs=count,
        vectorization_mode="async",
        vector_kwargs={"context": "forkserver"},
        **OPTIONS,
    )
    try:
        envs.reset(seed=0)
        envs.action_space.seed(0)
        envs.step(envs.action_space.sample())
        start, own = time.perf_counter(), time.process_time()
        for _ in range(steps):
            envs.step(envs.action_space.sample())
        return {"seconds": (time.perf_counter() - start) / steps, "own_seconds": (time.process_time() - own) / steps}
    finally:
        envs.close()


def show(result: dict[str, Any]) -> None:
    """Print the measured and the extrapolated rates."""
    for count, rate in result["control_steps_per_second"].items():
        print(f"{count:3d} environments  {rate:7.0f} control steps per second, measured on {result['cores']} cores")
    rate, serial = result["extrapolated_control_steps_per_second"], result["serial_ms_per_environment"]
    print(
        f"{result['extrapolated_cores']:3d} environments  {rate:7.0f} on as many cores, extrapolated from one and a "
        f"serial part of {serial:.2f} ms per environment"
    )
