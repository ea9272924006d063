"""Profile of a training run: `python -m research.benchmarks training TASK --env station=arm`.

The profiled run of `guiderail train` is short, and its learner starts early. Wall-clock time counts only for the
innermost measured part: time in a system's callback does not count for the simulation, and the time in which Drake
evaluates a port does not count for the callback that reads the port. Drake's own computations (contact, solver,
kinematics) are one part.
"""

from __future__ import annotations

import inspect
import pkgutil
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from functools import wraps
from importlib import import_module
from pathlib import Path
from typing import Any
from unittest.mock import patch

from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import InputPort, OutputPort

import guiderail.systems
from guiderail.diagrams.envs.env import DiagramEnv
from guiderail.tools.learning import checkpoint, episodes, fast_sb3, off_policy, trainer
from guiderail.tools.learning.networks import DemonstrationReplayBuffer
from guiderail.tools.learning.run_folder import RunFolder, configure

TASK = "BncConnector"
EPISODES = 6
LEARNING_STARTS = 40  # transitions before the first gradient step

# Owner and name of each measured function, and its part.
PARTS: tuple[tuple[Any, str, str], ...] = (
    (trainer, "make_run_environment", "building the environment"),
    (episodes, "rollout", "rollout"),
    (trainer.TrainingLoop, "write_checkpoint", "checkpoint"),
    (DiagramEnv, "reset", "reset"),
    (DiagramEnv, "step", "environment"),
    (Simulator, "AdvanceTo", "Drake"),
    (InputPort, "Eval", "Drake, as a port is read"),
    (OutputPort, "Eval", "Drake, as a port is read"),
    (off_policy.OffPolicyLearner, "__init__", "building the learner"),
    (off_policy.OffPolicyLearner, "act", "acting"),
    (off_policy.OffPolicyLearner, "store", "replay buffer"),
    (off_policy.OffPolicyLearner, "learn", "gradient step"),
    (DemonstrationReplayBuffer, "sample", "replay"),
    (fast_sb3.FastTrainingStep, "train", "gradient step"),
    (fast_sb3.BatchedMLP, "forward", "forward"),
    (fast_sb3.BatchedMLP, "backward", "backward"),
    (fast_sb3.BatchedMLP, "input_gradient", "backward"),
    (fast_sb3.FlatAdam, "step", "optimizer"),
    (checkpoint, "save_checkpoint", "checkpoint"),
)
REST = "everything else"
CALLBACK = "Python: "


class Profiler:
    """Wall-clock time by part; each instant counts for the innermost part.

    Attributes:
        seconds: Duration of each part [s].
        calls: Number of calls of each part from another part.
    """

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {REST: 0.0}
        self.calls: dict[str, int] = {REST: 1}
        self._inside = [REST]
        self._last = time.perf_counter()

    def timed(self, function: Callable[..., Any], part: str) -> Callable[..., Any]:
        """Return the function wrapped so that its time counts for a part."""
        self.seconds.setdefault(part, 0.0)
        self.calls.setdefault(part, 0)
        inside, seconds, calls = self._inside, self.seconds, self.calls

        @wraps(function)
        def call(*given: Any, **named: Any) -> Any:
            now = time.perf_counter()
            seconds[inside[-1]] += now - self._last
            self._last = now
            calls[part] += inside[-1] != part
            inside.append(part)
            try:
                return function(*given, **named)
            finally:
                now = time.perf_counter()
                seconds[inside.pop()] += now - self._last
                self._last = now

        return call

    def restart(self) -> None:
        """Discard the time since the last measurement."""
        self._last = time.perf_counter()

    def stop(self) -> None:
        """Count the time since the last measurement."""
        now = time.perf_counter()
        self.seconds[self._inside[-1]] += now - self._last
        self._last = now


@contextmanager
def timed_parts() -> Iterator[Profiler]:
    """Profile all calls in the context."""
    parts = [*PARTS, *((system, name, CALLBACK + system.__name__) for system, name in _callbacks())]
    profiler = Profiler()
    with ExitStack() as stack:
        for owner, name, part in parts:
            stack.enter_context(patch.object(owner, name, profiler.timed(getattr(owner, name), part)))
        stack.callback(profiler.stop)
        profiler.restart()  # the patches are not a part of the run
        yield profiler


def _callbacks() -> Iterator[tuple[type, str]]:
    """Yield the methods of every system and of its support classes: Drake calls no other Python code."""
    for module_info in pkgutil.walk_packages(guiderail.systems.__path__, "guiderail.systems."):
        module = import_module(module_info.name)
        for kind in vars(module).values():
            if inspect.isclass(kind) and kind.__module__ == module.__name__:
                for name, value in vars(kind).items():
                    if inspect.isfunction(value) and not name.startswith("__"):
                        yield kind, name


def measure(
    task: str | None = None, environment: Mapping[str, Any] | None = None, episodes: int = EPISODES
) -> dict[str, Any]:
    """Profile one run; return its parts, the largest first.

    Args:
        task: Name of the task.
        environment: Options of its environment.
        episodes: Number of training episodes.
    """
    task = task or TASK
    settings = {"settings": {"learning_starts": LEARNING_STARTS}}
    config = configure(task, environment or {}, episodes=episodes, **settings)
    with tempfile.TemporaryDirectory() as folder, timed_parts() as profiler:
        start = time.perf_counter()
        rows = trainer.run_training(RunFolder(Path(folder) / "run"), config)
        wall = time.perf_counter() - start
    steps = sum(row["steps"] for row in rows)
    parts = [
        {"part": part, "seconds": seconds, "share": seconds / wall, "calls": profiler.calls[part]}
        for part, seconds in sorted(profiler.seconds.items(), key=lambda item: -item[1])
        if seconds > 0.0
    ]
    return {
        "task": task,
        "environment": dict(config.environment),
        "episodes": episodes,
        "wall_s": wall,
        "control_steps": steps,
        "python_share_of_simulation": _python_share(profiler.seconds),
        "parts": parts,
    }


def _python_share(seconds: Mapping[str, float]) -> float:
    python = sum(value for part, value in seconds.items() if part.startswith(CALLBACK))
    return python / max(python + sum(value for part, value in seconds.items() if part.startswith("Drake")), 1e-12)


def show(result: dict[str, Any]) -> None:
    """Print the table."""
    from rich.console import Console
    from rich.table import Table

    station = result["environment"].get("station")
    where = result["task"] if station is None else f"{result['task']}, {station}"
    table = Table(title=f"{where}: {result['episodes']} episodes in {result['wall_s']:.1f} s")
    for column, side in (("part", "left"), ("s", "right"), ("share", "right"), ("calls", "right"), ("ms", "right")):
        table.add_column(column, justify=side)  # type: ignore[arg-type]
    for row in result["parts"]:
        if row["share"] >= 0.001:
            each = 1e3 * row["seconds"] / max(row["calls"], 1)
            table.add_row(row["part"], f"{row['seconds']:.2f}", f"{row['share']:.1%}", f"{row['calls']}", f"{each:.3f}")
    console = Console()
    console.print(table)
    python = f"{result['python_share_of_simulation']:.0%}"
    console.print(f"{result['control_steps']} control steps; {python} of the simulation is Python")
