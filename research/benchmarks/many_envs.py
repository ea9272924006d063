"""Environments that step at once, a process each: `guiderail bench many_envs`.

Gymnasium's own vector environment (`gymnasium.make_vec`) waits for the slowest of its processes at every step, and what
it does itself, sending actions and reading what came, it does one environment after the other: its own time an
environment is the serial part. Where there are fewer cores than asked about, what is printed is that sum and not a
measurement: n environments on as many cores take the time of one, and the serial part n − 1 times more.
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
ASKED = 16  # cores
STEPS = 300  # of the vector environment, in each measurement


def measure(*, steps: int = STEPS, counts: tuple[int, ...] | None = None) -> dict[str, Any]:
    """Control steps a second by number of environments, measured and reckoned.

    Args:
        steps: of the vector environment.
        counts: how many environments; one, and as many as there are cores, unless given.
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
        "serial_ms_an_environment": 1e3 * serial,
        "reckoned_cores": ASKED,
        "reckoned_control_steps_per_second": action_repeat * ASKED / (alone["seconds"] + (ASKED - 1) * serial),
    }


def _measured(count: int, steps: int) -> dict[str, float]:
    """Seconds of a step of the vector environment, and those that its own process worked."""
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
    """Prints what was measured, and what follows from it."""
    for count, rate in result["control_steps_per_second"].items():
        print(f"{count:3d} environments  {rate:7.0f} control steps a second, measured on {result['cores']} cores")
    print(
        f"{result['reckoned_cores']:3d} environments  {result['reckoned_control_steps_per_second']:7.0f} on as many "
        f"cores, reckoned from one and the serial part of {result['serial_ms_an_environment']:.2f} ms an environment"
    )
