"""Time from the start of the command to a trained policy: `python -m research.benchmarks cold_start`.

Each run is `guiderail train` in a new process, timed from its start to its end, including imports, saving and drawing.
The evaluation of its policy is not timed. For each seed, both kinds run one after the other, so that the load of the
machine is similar. No setting was tuned on these seeds.
"""

from __future__ import annotations

import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from guiderail.models.common.errors import InputError
from guiderail.models.policy import Policy
from guiderail.tools.evaluation.evaluate import evaluate_run
from guiderail.tools.evaluation.policies import check_compatible
from guiderail.tools.learning.run_folder import RunFolder
from research.benchmarks import with_progress

TASK = "BncConnector"
ENVIRONMENT: Mapping[str, Any] = {"guidance": "kgrl", "reward": "shaped", "fixture_offset": "per_run"}
EPISODES = 20  # with seeds 30 to 34, training has converged after at most 10 episodes
SEEDS = range(400, 405)
HELD_OUT = 100
KINDS = {"alternating": 0, "parallel": 1}  # the setting `num_envs`
REQUIRED_MEDIAN, REQUIRED_WORST = 60.0, 120.0  # largest accepted median and longest duration of a run [s]


def measure(
    task: str | None = None,
    environment: Mapping[str, Any] | None = None,
    imports: Sequence[str] = (),
    *,
    episodes: int = EPISODES,
    seeds: range = SEEDS,
    held_out: int = HELD_OUT,
) -> dict[str, Any]:
    """Measure the duration of each run and the success rate of its policy.

    Args:
        task: Name of the task.
        environment: Options of the task's environment; by default for the connector, `ENVIRONMENT`.
        imports: Modules or files that register the task.
        episodes: Training episodes of a run.
        seeds: Seeds of the runs.
        held_out: Held-out episodes of an evaluation.

    Raises:
        InputError: If a run fails.
    """
    options = environment or (ENVIRONMENT if task in (None, TASK) else {})
    task = task or TASK
    runs = []
    with tempfile.TemporaryDirectory() as folder:
        for seed, kind in with_progress([(seed, kind) for seed in seeds for kind in KINDS], "run"):
            out = Path(folder) / f"{seed}-{KINDS[kind]}"
            seconds = _train(task, options, episodes, seed, KINDS[kind], out, imports)
            rows = evaluate_run(RunFolder(out).config(), partial(check_compatible, Policy.load(out)), episodes=held_out)
            success = float((rows["termination"] == "success").mean())
            runs.append({"kind": kind, "seed": seed, "seconds": seconds, "success_rate": success})
    return {"task": task, "environment": dict(options), "episodes": episodes, "held_out": held_out, "runs": runs}


def _train(
    task: str, options: Mapping[str, Any], episodes: int, seed: int, num_envs: int, out: Path, imports: Sequence[str]
) -> float:
    command = [sys.executable, "-m", "guiderail", "train", task, "--json"]
    command += ["--episodes", str(episodes), "--seed", str(seed), "--set", f"num_envs={num_envs}", "--out", str(out)]
    for name, value in options.items():
        command += ["--env", f"{name}={value}"]
    for module in imports:
        command += ["--import", module]
    start = time.perf_counter()
    process = subprocess.run(command, capture_output=True, text=True)
    seconds = time.perf_counter() - start
    if process.returncode:
        lines = process.stderr.strip().splitlines() or [f"it ended with exit status {process.returncode}"]
        raise InputError(f"a run failed: {lines[-1]}")
    return seconds


def show(result: dict[str, Any]) -> None:
    """Print each run, the median and the worst of each kind, and the requirement."""
    print(f"{result['task']}, {result['episodes']} episodes, from the start of the command to its end")
    for kind in KINDS:
        runs = [run for run in result["runs"] if run["kind"] == kind]
        seconds = [run["seconds"] for run in runs]
        print(f"{kind}: median {statistics.median(seconds):.1f} s, worst {max(seconds):.1f} s")
        for run in runs:
            print(f"  seed {run['seed']}: {run['seconds']:.1f} s, {run['success_rate']:.0%} of {result['held_out']}")
    print(f"required for the connector with a hidden offset: {REQUIRED_MEDIAN:.0f} s, {REQUIRED_WORST:.0f} s")
