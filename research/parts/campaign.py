"""Steps of the benchmark for one pair, each run in its own processes and stored; table of the results."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import yaml

from guiderail.models.common.errors import InputError
from guiderail_parts.batch import create_with_shrink
from guiderail_parts.isolation import IsolatedError, run_isolated
from guiderail_parts.pairs import Pair

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
            file.write("".join(output.decode() for output in (error.stdout, error.stderr) if isinstance(output, bytes)))
            raise StepError(f"it took more than {timeout:g} s") from None
        file.write(done.stdout + done.stderr)
    if done.returncode:
        errors = [line for line in done.stderr.splitlines() if line.strip()]
        last = errors[-1] if errors else ""
        raise StepError(last.removeprefix("guiderail: ") if done.returncode == 2 else f"exit {done.returncode}: {last}")
    return done.stdout


def finish(stored: Path, step: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """Return the result of a step, and store it; a stored result is not computed again.

    The result of a failed step is {"error": reason}.
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

    As long as the parts overlap, the plug is shrunk by the distance in the `OverlapError`.

    Raises:
        StepError: If the pair is refused, or needs more than `timeout` [s] of CPU time.
    """
    log = out / "logs" / f"{pair.name}.txt"
    try:
        return dict(run_isolated(_prepare, pair, out / "tasks" / f".{pair.name}", log, cpu_seconds=int(timeout)))
    except IsolatedError as error:
        raise StepError(str(error).removeprefix("StepError: ")) from error


def _prepare(pair: Pair, folder: Path, log: Path) -> dict[str, Any]:
    with log.open("a", encoding="utf-8") as file:

        def write(line: str) -> None:
            file.write(f"{line}\n")
            file.flush()

        shutil.rmtree(folder, ignore_errors=True)
        try:
            return create_with_shrink(pair, folder, write, only_insert=True)
        except InputError as error:
            write(str(error))
            raise StepError(str(error)) from error


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
        shrink: Distance by which the plug's surface is moved inwards [mm].
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


MEASURED = (
    "clearance_mm",
    "shrink_mm",
    "deviation_mm",
    "triangles",
    "compliant",
    "pieces",
    "preparation_s",
    "inserted_s",
    "real_time_factor",
    "penetration_mm",
    "penetration_pushed_on_the_rim_mm",
    "force",
    "inserted",
)
LEARNED = (
    "demonstrations_seated",
    "total_s",
    "calibration",
    "success_rate",
    "uniform_random_success_rate",
    "scripted_success_rate",
    "demonstration_success_rate",
    "episodes_to_convergence",
    "training_episodes",
    "training_minutes",
    "peak_force",
    "max_commanded_violation",
)


def to_table(rows: Mapping[str, Mapping[str, Any]]) -> pd.DataFrame:
    """Return one row per pair; the columns of training results contain the difficulty and the seed."""
    lines = []
    for name, row in sorted(rows.items()):
        line: dict[str, Any] = {"part": name, **{key: row.get(key) for key in MEASURED}}
        for key, result in row.items():
            if isinstance(result, dict):
                line |= {f"{key} {column}": result.get(column) for column in LEARNED}
                line[f"{key} reason"] = result.get("error")
        lines.append({**line, "reason": row.get("error")})
    return pd.DataFrame(lines)


def summarize(rows: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Return counts and percentiles over all pairs."""
    prepared = [row for row in rows.values() if "error" not in row]
    inserted = [row for row in prepared if row["inserted"]]
    summary: dict[str, Any] = {"pairs": len(rows), "prepared": len(prepared), "inserted": len(inserted)}
    for key in ("preparation_s", "inserted_s", "real_time_factor"):
        values = [row[key] for row in prepared]
        if values:
            summary[f"{key} 50, 95 %"] = np.round(np.percentile(values, [50, 95]), 2).tolist()
    deep = [
        row
        for row in prepared
        if row["clearance_mm"] and row["penetration_pushed_on_the_rim_mm"] > 0.5 * row["clearance_mm"]
    ]
    summary["deeper than half the clearance"] = len(deep)
    summary["reasons"] = {name: row["error"] for name, row in sorted(rows.items()) if "error" in row}
    return summary
