"""Benchmark of the drawn parts without tuned parameters: create their tasks, train and evaluate by the command line.

Run `python -m research.parts.learn_parts --out FOLDER [--parts square_peg,dovetail] [--episodes 60]
[--held-out 100] [--seed 0] [--processes 2]`. With `--episodes 0` the tasks are only created. The same command
continues after an interruption. The results are `table.md` and a log of each part.
"""

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pandas as pd
import yaml

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))

from oracles.parts import PARTS

COMMAND = [sys.executable, "-c", "from guiderail.tools.cli.main import main; main()"]
COLUMNS = (
    "part", "real-time factor", "deepest penetration [mm]", "half the clearance [mm]", "inserted if aligned",
    "offset of 1.5 mm along x/y", "successes of the demonstration", "successes of uniform_random",
    "successes of the policy", "episodes to convergence", "training episodes", "duration [min]",
)  # fmt: skip


def guiderail(log: Path, *arguments: object) -> str:
    """Run a command of guiderail, append its messages and its output to `log`, and return its output."""
    with log.open("a", encoding="utf-8") as file:
        file.write(f"\n$ guiderail {' '.join(map(str, arguments))}\n")
        file.flush()
        environment = {**os.environ, "OMP_NUM_THREADS": "1"}
        result = subprocess.run(
            [*COMMAND, *map(str, arguments)],
            stdout=subprocess.PIPE,
            stderr=file,
            text=True,
            env=environment,
            check=False,
        )
        file.write(result.stdout)
    if result.returncode:
        raise RuntimeError(f"guiderail {arguments[0]} ended with exit code {result.returncode}: see {log}")
    return result.stdout


def run_once(file: Path, step: Callable[[], dict]) -> dict:
    """Return the result of `step` with its duration [min]; read the result from `file` if the step was run before."""
    if not file.exists():
        start = time.perf_counter()
        result = step()
        file.write_text(json.dumps({**result, "minutes": (time.perf_counter() - start) / 60}), encoding="utf-8")
    return json.loads(file.read_text(encoding="utf-8"))


def create_task(name: str, out: Path, log: Path) -> dict:
    """Write the meshes of a part, create its task, and return the measured properties."""
    part, meshes, task = PARTS[name](), out / "meshes" / name, out / "tasks" / name
    meshes.mkdir(parents=True, exist_ok=True)
    plug, socket = part.write(meshes)
    if not task.exists():
        task.parent.mkdir(exist_ok=True)
        guiderail(log, "create-task", plug, socket, "--unit", "mm", *part.options, "--out", task)
    return yaml.safe_load((task / "task.yaml").read_text(encoding="utf-8"))["measured"]


def train(name: str, out: Path, log: Path, episodes: int, seed: int) -> dict:
    """Train with the defaults of the task; return the number of episodes and the duration [min]."""
    run = out / "runs" / name
    if not (run / "policy.safetensors").exists():
        is_begun = (run / "config.yaml").exists()
        arguments = ["--resume"] if is_begun else [out / "tasks" / name, "--seed", seed]
        guiderail(log, "train", *arguments, "--out", run, "--episodes", episodes)
    rows = pd.read_csv(run / "episodes.csv")
    return {"episodes": len(rows), "training_minutes": rows["wall_time"].sum() / 60}


def evaluate(name: str, out: Path, log: Path, episodes: int) -> dict:
    """Return the evaluation of the policy on held-out conditions."""
    output = guiderail(
        log, "evaluate", out / "runs" / name, "--episodes", episodes, "--baselines", "uniform_random", "--json"
    )
    return json.loads(output.strip().splitlines()[-1])


def table_row(name: str, out: Path, episodes: int, seed: int, held_out: int) -> list[object]:
    """Return the row of a part in the table."""
    log, results = out / "logs" / f"{name}.txt", out / "results"
    measured = run_once(results / f"{name}-task.json", lambda: create_task(name, out, log))
    deepest = max(measured["penetration_mm"], measured["penetration_pushed_on_the_rim_mm"])
    clearance = measured["clearance_mm"]
    row: list[object] = [name, measured["real_time_factor"], deepest, round(clearance / 2, 4), measured["inserted"]]
    row.append("/".join("blocked" if is_blocked else "inserted" for is_blocked in measured["blocked_1.5_mm_off"]))
    if not episodes:
        return [*row, *[""] * 5, f"{measured['minutes']:.1f}"]
    trained = run_once(results / f"{name}-training.json", lambda: train(name, out, log, episodes, seed))
    result = run_once(results / f"{name}-evaluation.json", lambda: evaluate(name, out, log, held_out))
    minutes = measured["minutes"] + trained["training_minutes"] + result["minutes"]
    rates = ("demonstration_success_rate", "uniform_random_success_rate", "success_rate")
    demonstration, uniform_random, policy = (f"{result[rate] * result['episodes']:.0f}" for rate in rates)
    return [
        *row,
        demonstration,
        uniform_random,
        f"{policy} of {result['episodes']}",
        result["episodes_to_convergence"],
        trained["episodes"],
        f"{minutes:.1f}",
    ]


def main() -> None:
    """Run all unfinished steps, write the table after each part, and print it at the end."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder of the results")
    parser.add_argument("--parts", default=",".join(PARTS), help="names of the parts, separated by commas")
    parser.add_argument("--episodes", type=int, default=60, help="training episodes of each part")
    parser.add_argument("--held-out", type=int, default=100, help="held-out episodes of each evaluation")
    parser.add_argument("--seed", type=int, default=0, help="seed of the trainings")
    parser.add_argument("--processes", type=int, default=2, help="parts that are processed at a time")
    args = parser.parse_args()
    for folder in ("meshes", "tasks", "runs", "logs", "results"):
        (args.out / folder).mkdir(parents=True, exist_ok=True)
    rows, failed = {}, {}
    with ThreadPoolExecutor(args.processes) as pool:
        futures = {
            name: pool.submit(table_row, name, args.out, args.episodes, args.seed, args.held_out)
            for name in args.parts.split(",")
        }
        for name, future in futures.items():
            try:
                rows[name] = future.result()
            except (RuntimeError, OSError, ValueError) as error:
                failed[name] = str(error)
            lines = [
                "| " + " | ".join(map(str, row)) + " |" for row in (COLUMNS, ["---"] * len(COLUMNS), *rows.values())
            ]
            (args.out / "table.md").write_text("\n".join(lines) + "\n", encoding="utf-8")
    print((args.out / "table.md").read_text(encoding="utf-8"))
    for name, message in failed.items():
        print(f"{name}: {message}")
    sys.exit(1 if failed else 0)


if __name__ == "__main__":
    main()
