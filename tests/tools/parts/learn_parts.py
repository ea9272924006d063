"""Learn six parts that no parameter was tuned for: create their tasks, train and evaluate with the commands alone.

`python tests/tools/parts/learn_parts.py --out FOLDER [--parts square_peg,dovetail] [--episodes 60] [--held-out 100]
[--seed 0] [--processes 2]`; `--episodes 0` creates the tasks only. The same command resumes an interrupted
run. It writes `table.md` and a log of each part.
"""

import argparse
import json
import os
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pandas as pd
import yaml

sys.path.insert(0, str(Path(__file__).parents[2]))

from oracles.parts import PARTS

COMMAND = [sys.executable, "-c", "from guiderail.tools.cli.main import main; main()"]
COLUMNS = (
    "part", "real-time factor", "deepest [mm]", "allowed [mm]", "aligned", "1.5 mm off", "demonstrations alone",
    "uniform_random",
    "held out", "episodes to convergence", "episodes", "minutes",
)  # fmt: skip


def guiderail(log: Path, *words: object) -> str:
    """Run a command, log it with its messages, and return its output."""
    with log.open("a", encoding="utf-8") as file:
        file.write(f"\n$ guiderail {' '.join(map(str, words))}\n")
        file.flush()
        environment = {**os.environ, "OMP_NUM_THREADS": "1"}
        done = subprocess.run(
            [*COMMAND, *map(str, words)], stdout=subprocess.PIPE, stderr=file, text=True, env=environment, check=False
        )
        file.write(done.stdout)
    if done.returncode:
        raise RuntimeError(f"guiderail {words[0]} ended with {done.returncode}: see {log}")
    return done.stdout


def finished(kept: Path, make) -> dict:
    """Return the result of a step with its duration [min], from its file if it exists."""
    if not kept.exists():
        start = time.perf_counter()
        result = make()
        kept.write_text(json.dumps({**result, "minutes": (time.perf_counter() - start) / 60}), encoding="utf-8")
    return json.loads(kept.read_text(encoding="utf-8"))


def create_task(name: str, out: Path, log: Path) -> dict:
    """Draw a part and create its task."""
    part, drawn, task = PARTS[name](), out / "drawn" / name, out / "tasks" / name
    drawn.mkdir(parents=True, exist_ok=True)
    plug, socket = part.write(drawn)
    if not task.exists():
        task.parent.mkdir(exist_ok=True)
        guiderail(log, "create-task", plug, socket, "--unit", "mm", *part.options, "--out", task)
    return yaml.safe_load((task / "task.yaml").read_text(encoding="utf-8"))["measured"]


def train(name: str, out: Path, log: Path, episodes: int, seed: int) -> dict:
    """Train with the task's own defaults."""
    run = out / "runs" / name
    if not (run / "policy.safetensors").exists():
        how = ["--resume", "--out", run] if (run / "config.yaml").exists() else [out / "tasks" / name, "--out", run]
        guiderail(log, "train", *how, *([] if "--resume" in how else ["--seed", seed]), "--episodes", episodes)
    rows = pd.read_csv(run / "episodes.csv")
    return {"episodes": len(rows), "training_minutes": rows["wall_time"].sum() / 60}


def evaluate(name: str, out: Path, log: Path, episodes: int) -> dict:
    """Evaluate on held-out conditions."""
    said = guiderail(
        log, "evaluate", out / "runs" / name, "--episodes", episodes, "--baselines", "uniform_random", "--json"
    )
    return json.loads(said.strip().splitlines()[-1])


def table_row(name: str, out: Path, episodes: int, seed: int, held_out: int) -> list[object]:
    """Return the row of a part in the table."""
    log, kept = out / "logs" / f"{name}.txt", out / "kept"
    measured = finished(kept / f"{name}-task.json", lambda: create_task(name, out, log))
    deepest = max(measured["penetration_mm"], measured["penetration_pushed_on_the_rim_mm"])
    clearance = measured["clearance_mm"]
    row: list[object] = [name, measured["real_time_factor"], deepest, round(clearance / 2, 4), measured["inserted"]]
    row.append("/".join("stopped" if one else "in" for one in measured["blocked_1.5_mm_off"]))
    if not episodes:
        return [*row, *[""] * 5, f"{measured['minutes']:.1f}"]
    trained = finished(kept / f"{name}-training.json", lambda: train(name, out, log, episodes, seed))
    result = finished(kept / f"{name}-evaluation.json", lambda: evaluate(name, out, log, held_out))
    minutes = measured["minutes"] + trained["training_minutes"] + result["minutes"]
    whose = ("demonstration_success_rate", "uniform_random_success_rate", "success_rate")
    alone, uniform_random, success = (f"{result[which] * result['episodes']:.0f}" for which in whose)
    return [
        *row,
        alone,
        uniform_random,
        f"{success} of {result['episodes']}",
        result["episodes_to_convergence"],
        trained["episodes"],
        f"{minutes:.1f}",
    ]


def main() -> None:
    """Run all unfinished steps, and print the table after each part."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--parts", default=",".join(PARTS))
    parser.add_argument("--episodes", type=int, default=60)
    parser.add_argument("--held-out", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--processes", type=int, default=2)
    args = parser.parse_args()
    for folder in ("drawn", "tasks", "runs", "logs", "kept"):
        (args.out / folder).mkdir(parents=True, exist_ok=True)
    rows, failed = {}, {}
    with ThreadPoolExecutor(args.processes) as pool:
        asked = {
            name: pool.submit(table_row, name, args.out, args.episodes, args.seed, args.held_out)
            for name in args.parts.split(",")
        }
        for name, one in asked.items():
            try:
                rows[name] = one.result()
            except (RuntimeError, OSError, ValueError) as error:
                failed[name] = str(error)
            lines = [
                "| " + " | ".join(map(str, row)) + " |" for row in (COLUMNS, ["---"] * len(COLUMNS), *rows.values())
            ]
            (args.out / "table.md").write_text("\n".join(lines) + "\n", encoding="utf-8")
    print((args.out / "table.md").read_text(encoding="utf-8"))
    for name, why in failed.items():
        print(f"{name}: {why}")
    sys.exit(1 if failed else 0)


if __name__ == "__main__":
    main()
