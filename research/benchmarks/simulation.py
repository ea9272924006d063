"""Speed of contact simulation: `python -m research.benchmarks simulation`.

The result is the best CPU time of several runs on one core, because the best time depends least on other processes.
Python's share is the time in callbacks of systems that are written in Python. The share is measured in further runs,
because timing the callbacks makes the simulation slower by a few percent.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from typing import Any
from unittest.mock import patch

import numpy as np

from guiderail.diagrams.envs.make import make_env
from guiderail.diagrams.envs.recording import DrivenStation, linear_motion
from guiderail.diagrams.stations.pouring import PouringConfig
from guiderail.diagrams.stations.registry import STATIONS
from guiderail.diagrams.stations.station import CONTROL_PERIOD
from guiderail.diagrams.tasks.bnc_connector import NUM_STEPS, BncWorkcell
from guiderail.diagrams.tasks.grid_clamp import GridClampWorkcell
from guiderail.models.common.transforms import POSE_SIZE
from guiderail.models.objects.bnc_connector.demonstrations import insert_and_lock
from guiderail.systems.cartesian_impedance_controller import CartesianImpedanceController
from guiderail.systems.cartesian_position_controller import CartesianPositionController
from guiderail.systems.poses import MeasuredPose
from guiderail.systems.recorder import Recorder
from guiderail.systems.support.last_valid import LastValidPose
from guiderail.systems.wrench_sensors import WrenchSensor
from guiderail.systems.wrench_signals import ContactDetector, ForceMonitor, PoseWrench
from research.benchmarks import with_progress

# Timed callbacks. The time of a callback inside another timed callback counts only for the outer callback.
CALLBACKS: tuple[tuple[type, str], ...] = (
    (WrenchSensor, "_sample"),
    (PoseWrench, "_wrench"),
    (CartesianImpedanceController, "_calc_law"),
    (CartesianPositionController, "_step"),
    (MeasuredPose, "_pose"),
    (ContactDetector, "_update"),
    (LastValidPose, "_update"),
    (LastValidPose, "eval"),
    (ForceMonitor, "_saturation"),
    (Recorder, "_record"),
)
CONTACT = (3.8, 7.6)  # interval from first contact of the plug to its release in the locked state [s]
# Motion of the clamp: dragged over the table into its holes and pushed until it snaps in. Times [s], x and z [m].
CLAMP_TIMES, CLAMP_X, CLAMP_Z = (0.0, 0.4, 2.4, 4.0), (-0.003, -0.003, 0.0, 0.0), (0.014, 0.009, 0.009, -0.005)
CLAMP_CONTACT = (0.4, 4.0)
# Motion of the thermos: moved to the mug, tilted and emptied. Times [s], poses of its tip in the target frame.
POUR_TIMES = (0.0, 1.0, 2.0, 4.5, 5.0, 7.6)
POUR_POSES = (
    (-0.063, -0.292, 0.169, -0.213, 0.0, 0.0),
    (0.012, -0.217, 0.225, 0.055, 0.0, 0.0),
    (0.056, -0.153, 0.176, 0.349, 0.0, -0.001),
    (0.018, -0.049, 0.076, 0.349, 0.0, -1.052),
    (0.013, -0.036, 0.072, 0.349, 0.0, -1.182),
    (0.013, -0.036, 0.075, 0.349, 0.0, -1.804),
)
POUR_CONTACT = (2.0, 7.6)  # the balls roll and fall
# Task of each simulation and its required real-time factor.
REQUIRED_FACTOR = {
    "gantry": ("BncConnector", 12.0),
    "arm": ("BncConnector", 8.0),
    "grid_clamp": ("GridClamp", 15.0),
    "pouring": ("Pouring", 15.0),
}
REQUIRED_SECONDS = 1.0  # largest CPU time of 400 control steps of the environment [s]
REPEATS = 3


@contextmanager
def timed_callbacks() -> Iterator[Callable[[], float]]:
    """Time the callbacks of systems built in the context; yield a function that returns the sum [s]."""
    spent = [0.0]
    depth = [0]

    def timed(method: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any) -> Any:
            depth[0] += 1
            start = time.process_time()
            try:
                return method(*arguments)
            finally:
                depth[0] -= 1
                if depth[0] == 0:
                    spent[0] += time.process_time() - start

        return call

    with ExitStack() as stack:
        for system, name in CALLBACKS:
            stack.enter_context(patch.object(system, name, timed(getattr(system, name))))
        yield lambda: spent[0]


def real_time_factor(name: str) -> dict[str, float]:
    """Return the largest real-time factor of `REPEATS` runs, and Python's smallest share of as many others."""
    factors = [simulated / seconds for simulated, seconds, _ in (_one_run(name) for _ in range(REPEATS))]
    shares = []
    for _ in range(REPEATS):
        with timed_callbacks() as spent:
            _, seconds, python_seconds = _one_run(name, spent)
        shares.append(python_seconds / seconds)
    return {"real_time_factor": max(factors), "python_share": min(shares)}


def _one_run(name: str, spent: Callable[[], float] = lambda: 0.0) -> tuple[float, float, float]:
    """Return the simulated time, the CPU time and the increase of `spent` while there is contact [s]."""
    workcell, times, poses, contact = scripted_motion(REQUIRED_FACTOR[name][0])
    station = STATIONS.get(name if name in STATIONS.names() else "gantry").build(workcell)
    driven = DrivenStation(station, linear_motion(times, poses), num_samples=NUM_STEPS)
    driven.start(poses[0])
    first, last = (round(t / CONTROL_PERIOD) for t in contact)
    driven.run(first)
    spent_before, start = spent(), time.process_time()
    driven.run(last - first)
    return (last - first) * CONTROL_PERIOD, time.process_time() - start, spent() - spent_before


def scripted_motion(task: str) -> tuple[Any, np.ndarray, np.ndarray, tuple[float, float]]:
    """Return the workcell of a task, times [s] and commanded poses, and the interval of contact [s]."""
    if task == "BncConnector":
        return BncWorkcell(), *insert_and_lock(), CONTACT
    if task == "Pouring":
        return PouringConfig(), np.array(POUR_TIMES), np.array(POUR_POSES), POUR_CONTACT
    poses = np.zeros((len(CLAMP_TIMES), POSE_SIZE))
    poses[:, 0], poses[:, 2] = CLAMP_X, CLAMP_Z
    return GridClampWorkcell(), np.array(CLAMP_TIMES), poses, CLAMP_CONTACT


def env_seconds(guidance: str = "kgrl") -> float:
    """Return the best CPU time of 400 control steps on the gantry with random actions [s]."""
    env = make_env("BncConnector", guidance=guidance, fixture_offset="per_episode", action_repeat=5)
    rng = np.random.default_rng(0)
    best = np.inf
    for episode in range(1 + REPEATS):
        env.reset(seed=episode)
        start, finished = time.process_time(), False
        while not finished:
            _, _, terminated, truncated, info = env.step(rng.uniform(-1.0, 1.0, env.action_space.shape))
            finished = terminated or truncated
        if episode > 0:  # in the first episode, the primitive's matrices are factored
            best = min(best, (time.process_time() - start) / info["control_steps"] * NUM_STEPS)
    return best


def measure() -> dict[str, Any]:
    """Run the benchmark."""
    measurements: dict[str, Callable[[], Any]] = {name: partial(real_time_factor, name) for name in REQUIRED_FACTOR}
    measurements["env_seconds_per_400_steps"] = env_seconds
    results: dict[str, Any] = {name: measurements[name]() for name in with_progress(measurements, "simulation")}
    results["fast_enough"] = (
        all(results[name]["real_time_factor"] >= factor for name, (_, factor) in REQUIRED_FACTOR.items())
        and results["env_seconds_per_400_steps"] <= REQUIRED_SECONDS
    )
    return results


def show(results: dict[str, Any]) -> None:
    """Print the results."""
    for name, (_, factor) in REQUIRED_FACTOR.items():
        row = results[name]
        print(
            f"{name:10s}  {row['real_time_factor']:4.1f} times real time in contact (at least {factor:.0f}), "
            f"{100 * row['python_share']:.0f} % of it Python"
        )
    seconds = results["env_seconds_per_400_steps"]
    print(f"env         {seconds:4.2f} s for 400 control steps (at most {REQUIRED_SECONDS:.0f})")
