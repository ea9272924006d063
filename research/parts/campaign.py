"""Steps of the benchmark for one pair. Each step runs in its own processes, and its result is stored."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pandas as pd
import yaml

from guiderail.models.common.errors import InputError
from guiderail.models.common.isolation import IsolatedError, run_isolated
from guiderail.models.parts.assembly_check import MAX_SHRINK, OverlapError
from guiderail.tools.parts.create_task import create_task
from research.parts.pairs import Pair

COMMAND = (sys.executable, "-m", "guiderail")


class StepError(Exception):
    """Error of a failed step; for a failed command the message is the last line of its error output."""


def run_guiderail(log: Path, timeout: float, *arguments: object) -> str:
    """Run a `guiderail` command, append its output to a log, and return its standard output.

    Args:
        log: Log file.
        timeout: Wall time after which the command is killed [s].
        arguments: Arguments of `guiderail`.

    Raises:
        StepError: If the command fails or takes too long.
    """
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONUNBUFFERED": "1"}
    with log.open("a", encoding="utf-8") as file:
        file.write(f"\n$ guiderail {' '.join(map(str, arguments))}\n")
        file.flush()
        try:
            done = subprocess.run(
                [*COMMAND, *map(str, arguments)],
                capture_output=True,
                text=True,
                env=environment,
                timeout=timeout,
                check=False,
            )
        except subprocess.TimeoutExpired as error:
            file.write("".join(one.decode() for one in (error.stdout, error.stderr) if isinstance(one, bytes)))
            raise StepError(f"it took more than {timeout:g} s") from None
        file.write(done.stdout + done.stderr)
    if done.returncode:
        errors = [line for line in done.stderr.splitlines() if line.strip()]
        last = errors[-1] if errors else ""
        raise StepError(last.removeprefix("guiderail: ") if done.returncode == 2 else f"exit {done.returncode}: {last}")
    return done.stdout


def finish(stored: Path, step: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """Return the result of a step, and store it; a stored result is not computed again.

    A failed step has the result {"error": reason}.
    """
    if not stored.exists():
        try:
            result = step()
        except StepError as error:
            result = {"error": str(error)}
        part = stored.with_suffix(".part")
        part.write_text(json.dumps(result), encoding="utf-8")
        part.replace(stored)
    return dict(json.loads(stored.read_text(encoding="utf-8")))


def prepare(pair: Pair, out: Path, timeout: float) -> dict[str, Any]:
    """Prepare a pair and insert the plug from its aligned pose.

    While the parts overlap, the plug is shrunk by the distance in the `OverlapError`.

    Raises:
        StepError: If the pair is refused, or needs more than `timeout` [s] of CPU time.
    """
    log = out / "logs" / f"{pair.name}.txt"
    try:
        return dict(run_isolated(_prepare, pair, out / "tasks" / f".{pair.name}", log, cpu_seconds=int(timeout)))
    except IsolatedError as error:
        raise StepError(str(error).removeprefix("StepError: ")) from error


def _prepare(pair: Pair, folder: Path, log: Path) -> dict[str, Any]:
    shrink = 0.0
    with log.open("a", encoding="utf-8") as file:

        def write(line: str) -> None:
            file.write(f"{line}\n")
            file.flush()

        while True:
            shutil.rmtree(folder, ignore_errors=True)
            try:
                measured = create_task(
                    pair.plug, pair.socket, folder, unit=pair.unit, shrink=shrink, only_insert=True, log=write
                )
            except OverlapError as error:
                write(str(error))
                if error.shrink is None or shrink + error.shrink > MAX_SHRINK:
                    raise StepError(str(error)) from error
                shrink += error.shrink  # repeated until the parts no longer overlap
            except InputError as error:
                write(str(error))
                raise StepError(str(error)) from error
            else:
                return {**measured, "shrink_mm": 1e3 * shrink}


def write_task(pair: Pair, out: Path, timeout: float, shrink: float) -> Path:
    """Create the task folder of a prepared pair and return it."""
    folder, log = out / "tasks" / pair.name, out / "logs" / f"{pair.name}.txt"
    if not (folder / "task.yaml").exists():
        words = (pair.plug, pair.socket, "--unit", pair.unit, "--shrink", shrink)
        run_guiderail(log, timeout, "create-task", *words, "--out", folder)
    return folder


def learn(
    pair: Pair,
    out: Path,
    difficulty: str,
    seed: int,
    episodes: int,
    held_out: int,
    timeout: float,
    shrink: float,
) -> dict[str, Any]:
    """Create the task, train and evaluate a policy with the task's own defaults, and evaluate baselines.

    Args:
        pair: Pair.
        out: Folder of the benchmark.
        difficulty: Value of the environment's option.
        seed: Seed of the training.
        episodes: Number of training episodes.
        held_out: Number of evaluated episodes.
        timeout: Wall time of each command [s].
        shrink: Distance by which the plug is smaller [mm].
    """
    folder = write_task(pair, out, timeout, shrink)
    run = out / "runs" / f"{pair.name}-{difficulty}-{seed}"
    log = out / "logs" / f"{pair.name}-{difficulty}.txt"
    if not (run / "policy.safetensors").exists():
        start = ("--resume",) if (run / "config.yaml").exists() else (folder, "--seed", seed)
        chosen = () if "--resume" in start else ("--env", f"difficulty={difficulty}", "--env", "guidance=kgrl")
        run_guiderail(log, timeout, "train", *start, *chosen, "--out", run, "--episodes", episodes)
    rows = pd.read_csv(run / "episodes.csv")
    baselines = ("--baselines", "uniform_random,scripted")
    output = run_guiderail(log, timeout, "evaluate", run, "--episodes", held_out, *baselines, "--json")
    result = dict(json.loads(output.strip().splitlines()[-1]))
    measured = yaml.safe_load((folder / "task.yaml").read_text(encoding="utf-8"))["measured"]
    result |= {key: measured[key] for key in ("demonstrations_seated", "total_s")}
    if difficulty == "hard":
        result["calibration"] = describe_calibration(measured.get("hard"))
    return {**result, "training_episodes": len(rows), "training_minutes": rows["wall_time"].sum() / 60}


def describe_calibration(measured: dict[str, Any] | None) -> str:
    """Return a table cell that describes the calibration of `hard` that `create-task` stored."""
    if measured is None:
        return "not calibrated"
    nearest, farthest = measured["offset_mm"]
    text = f"{nearest:g} to {farthest:g} mm, {measured['turn_degrees']:g}°, {measured['force_limit']:g} N: random "
    text += f"{measured['uniform_random']}, scripted {measured['scripted']}"
    return text if measured["calibrated"] else f"{text} (not as hard as required)"
