"""One connector skill for several engines, arms and contacts: `python -m research.engines --out engines`.

A policy is trained with each seed over a set of environments (`VARIANTS`): on an arm with a sensor at its wrist, the
same with other friction, and in MuJoCo. It is evaluated in held-out episodes under each of `CONDITIONS`,
beside the scripted policy and policies that lack one part of the method (`ABLATIONS`). Every finished step is stored,
and the same command resumes. `rows/` has the episodes, `engines.csv` one row per policy and condition.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pandas as pd

from guiderail.tools.files import write_atomically
from guiderail.tools.learning.train import train
from guiderail.tools.tables import read_table, table_text
from research.command import Parser, print_result, run_program
from research.results.methods import markdown_table
from research.stored import continue_run, evaluate_stored

TASK = "BncConnector"
ENVIRONMENT: dict[str, Any] = {"guidance": "kgrl", "difficulty": "hard", "reward": "aligned", "sensing": "wrist"}
VARIANTS: dict[str, dict[str, Any]] = {
    "arm": {"station": "arm"},
    "friction": {"station": "arm", "disturbances.friction_factor": (0.5, 2.0)},
    "mujoco": {"station": "mujoco"},
}
SETTINGS: dict[str, Any] = {"symmetry": "near", "privileged_critic": True}
CONDITIONS: dict[str, tuple[dict[str, Any], int]] = {
    "Drake 5 ms": ({}, 100),
    "Drake 2.5 ms": ({"time_step": 0.0025}, 40),
    "Drake 1.25 ms": ({"time_step": 0.00125}, 40),
    "MuJoCo": ({"station": "mujoco"}, 100),
    "Bullet": ({"station": "pybullet"}, 40),
    "PhysX": ({"station": "sapien"}, 40),
    "gantry": ({"station": "gantry"}, 40),
    "Panda": ({"robot": "panda"}, 40),
    "UR5e": ({"robot": "ur5e"}, 40),
    "friction × 0.5 to 2": ({"disturbances.friction_factor": (0.5, 2.0)}, 40),
    "half clearance": ({"bore_clearance": 0.00005}, 40),
    "sensors of a robot": ({"sensing": "robot"}, 40),
}
"""Options of the environment that differ from training on the arm, and held-out episodes, by condition."""
NO_MEMORY = {"observation": "center_of_pressure"}
ABLATIONS: dict[str, dict[str, Any]] = {
    "kgrl": {},
    "no contact memory": {"environment": NO_MEMORY},
    "own observation": {"settings": {"privileged_critic": False}},
    "one engine": {"variants": {"arm": VARIANTS["arm"]}},
    "half in MuJoCo": {"variants": {**VARIANTS, "mujoco friction": {**VARIANTS["friction"], "station": "mujoco"}}},
    "residual": {"environment": {"guidance": "residual", "action_scale": 1.85}},
    "safe residual": {"environment": {"guidance": "safe_residual", "action_scale": 1.85}},
}
"""Differences from the method, by its name; `kgrl` is the method."""


def train_once(method: str, seed: int, episodes: int, out: Path) -> Path:
    """Train a method with a seed, or continue its run; return the folder of the run."""
    run, change = out / "runs" / f"{method}-{seed}", ABLATIONS[method]
    if not continue_run(run, episodes):
        train(
            TASK,
            out=run,
            episodes=episodes,
            seed=seed,
            settings={**SETTINGS, **change.get("settings", {})},
            variants=change.get("variants", VARIANTS),
            pictures=False,
            **ENVIRONMENT,
            **change.get("environment", {}),
        )
    return run


def evaluate_once(source: Path | str, method: str, condition: str, file: Path) -> None:
    """Evaluate the policy of a run, or a baseline policy, under a condition, unless its episodes are stored."""
    change, episodes = CONDITIONS[condition]
    options = {**ENVIRONMENT, "station": "arm", **ABLATIONS.get(method, {}).get("environment", {}), **change}
    evaluate_stored(TASK, options, {file: source}, episodes)


def tabulate(out: Path) -> pd.DataFrame:
    """Return one row per policy and condition, from the stored episodes and the training episodes of the runs."""
    table = []
    files = [file for name in CONDITIONS for file in sorted((out / "rows").glob(f"*/{name}.csv"))]
    for file in files:
        rows, (method, _, seed) = read_table(file), file.parent.name.rpartition("-")
        row: dict[str, Any] = {"method": method, "seed": seed, "condition": file.stem, "episodes": len(rows)}
        row["successes"] = int(rows["success"].sum())
        for name in ("peak_force", "peak_contact_force", "quasi_static_force", "max_commanded_violation"):
            row[name] = float(rows[name].max())
        row["collisions"] = int((rows["termination"] == "collision").sum())
        trained = out / "runs" / file.parent.name / "episodes.csv"
        if trained.exists():
            training = read_table(trained)
            row["training_episodes"] = len(training)
            row["training_collisions"] = int((training["termination"] == "collision").sum())
            row["training_peak_force"] = float(training["peak_force"].max())
            row["training_seconds"] = round(float(training["wall_time"].sum()), 1)
        table.append(row)
    return pd.DataFrame(table)


def condition_table(table: pd.DataFrame) -> str:
    """Return a Markdown table with a row for each condition and the successes of each method, one number per seed."""
    methods = [name for name in (*ABLATIONS, "scripted", "uniform_random") if name in set(table["method"])]
    lines = [["condition", "episodes", *methods]]
    for condition, rows in table.groupby("condition", sort=False):
        cells = [rows.loc[rows["method"] == name].sort_values("seed")["successes"] for name in methods]
        lines.append(
            [str(condition), str(rows["episodes"].max()), *(", ".join(map(str, cell)) or "–" for cell in cells)]
        )
    return markdown_table(lines[0], lines[1:])


def main(arguments: list[str]) -> None:
    """Run the program."""
    parser = Parser(
        "engines",
        "Train the connector's skill over several engines, and evaluate it under conditions that it was not trained "
        "in. Each finished step is stored, and the same command resumes.",
        "--out engines --seeds 3000001,3000002",
    )
    parser.add_out("engines")
    parser.add_argument("--seeds", default="3000001", help="seeds, comma-separated (default: 3000001)")
    parser.add_argument("--methods", default="kgrl", help=f"methods, comma-separated: {', '.join(ABLATIONS)}")
    parser.add_argument("--episodes", type=int, default=120, help="training episodes (default: 120)")
    parser.add_argument("--conditions", default=",".join(CONDITIONS), help="conditions (default: all)")
    parser.add_argument("--baselines", default="scripted,uniform_random", help="baseline policies")
    parser.add_json()
    args = parser.parse_args(arguments)
    out = args.out.resolve()
    policies: list[tuple[Path | str, str, str]] = [(name, name, f"{name}-0") for name in args.baselines.split(",")]
    for seed in args.seeds.split(","):
        for method in args.methods.split(","):
            run = train_once(method, int(seed), args.episodes, out)
            policies.append((run, method, run.name))
            for condition in args.conditions.split(","):
                evaluate_once(run, method, condition, out / "rows" / run.name / f"{condition}.csv")
    for source, method, name in policies:
        for condition in args.conditions.split(","):
            evaluate_once(source, method, condition, out / "rows" / name / f"{condition}.csv")
    table = tabulate(out)
    write_atomically(out / "engines.csv", table_text(table).encode())
    print_result({"rows": len(table), "table": str(out / "engines.csv")}, as_json=args.json)


if __name__ == "__main__":
    run_program(main)
