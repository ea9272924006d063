"""One policy for parts that it was not trained on: `python -m research.unseen_parts --meshes MESHES --out unseen`.

The parts are split by a rule before anything is trained (`split_parts`), and the split is written to `split.json`.
Then the parts are prepared, a policy is trained over the training parts with each seed, and all policies are evaluated
on the held-out parts: uniform random actions, the scripted search (with the contact map, and by the center of pressure
alone), policies of single training parts, specialists of the held-out parts, the general policy of each seed, and the
mean of their actions. The general policies are also evaluated under the uncertainty that AutoMate states, in MuJoCo,
and on the first `--few-shot` parts with plant steps of 5 and 2.5 ms. On the same parts, specialists that learn from
scratch are compared with those that the general policy demonstrates to, and the former are evaluated on the others.
Every finished step is stored, and the same command resumes. `rows/` has the episodes of each policy on each part,
`table.md` the successes, `contact.csv` the drag of each held-out part on its rim.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
from scipy.stats import wilcoxon

from guiderail.diagrams.envs.config import EnvConfig
from guiderail.diagrams.tasks.contact_probe import SPEEDS, drag
from guiderail.models.common.errors import InputError
from guiderail.tools.environments import task_named
from guiderail.tools.files import write_atomically
from guiderail.tools.learning.run_folder import Choices
from guiderail.tools.learning.train import Training
from guiderail.tools.tables import read_table, write_table
from guiderail_parts.batch import create_tasks
from guiderail_parts.pairs import Pair, find_pairs
from guiderail_studies.ensemble import write_ensemble
from research.command import Parser, print_result, run_program
from research.stored import continue_run, evaluate_stored, report

TRAINING, HELD_OUT = 60, 30  # numbers of parts
HELD_OUT_FRACTION = 0.34  # fraction of all pairs from which the held-out parts are taken
ENVIRONMENT = {"guidance": "kgrl", "difficulty": "hard", "observation": "shared"}
CONDITIONS = {
    "hard": ENVIRONMENT,
    "automate": ENVIRONMENT | {"difficulty": "automate"},
    "mujoco": ENVIRONMENT | {"station": "mujoco"},
    "step_5_ms": ENVIRONMENT | {"time_step": 0.005},
    "step_2.5_ms": ENVIRONMENT | {"time_step": 0.0025},
    "center_of_pressure": ENVIRONMENT | {"observation": "center_of_pressure"},  # for a search without a contact map
}
FEW_SHOT = (10, 20, 40, 80)  # training episodes after which a specialist is evaluated
ENOUGH = 0.95  # success rate with which its training ends
DEMONSTRATED = {"demonstration_episodes": 5, "demonstration_fraction": 0.5, "exploration.constant_episodes": 0}
"""Settings of a specialist to which the general policy demonstrates: RLPD (Ball et al., 2023)."""
SETTINGS = {"symmetry": "near", "exploration.constant_episodes": 12}
SEARCH = {"time": 0, "height": 15, "above": -0.1, "after": 0.33, "amplitude": 1.5, "cycles": [4.4, 3.0]}
"""`RimSearch` of the mean of the seeds, in entries of the observation "shared": from 0.5 mm below the first contact."""
CALIBRATED = 10  # episodes that calibrate `difficulty=hard` of each held-out part, or compare policies of single parts
EASY_RANDOM, EASY_SEARCH = 0.2, 0.9  # success rates above which a part cannot show learning


def split_parts(names: Iterable[str]) -> tuple[list[str], list[str]]:
    """Return candidates for training and held-out parts, in the order in which they are used.

    All names are ordered by the SHA-256 digest of the name. The first `HELD_OUT_FRACTION` are held out. The split thus
    depends on neither the shapes nor any result. Parts that cannot be prepared are skipped.
    """
    ordered = sorted(names, key=lambda name: hashlib.sha256(name.encode()).hexdigest())
    number = round(HELD_OUT_FRACTION * len(ordered))
    return ordered[number:], ordered[:number]


def prepare(
    pairs: Mapping[str, Pair], names: Sequence[str], number: int, out: Path, processes: int, hard_episodes: int
) -> list[Path]:
    """Return the first `number` task folders that can be created, in the order of `names`."""
    folders: list[Path] = []
    for start in range(0, len(names), processes):
        if len(folders) >= number:
            break
        chunk = [pairs[name] for name in names[start : start + processes]]
        results = create_tasks(chunk, out, processes=processes, log=report, hard_episodes=hard_episodes)
        folders += [out / name for name, result in results.items() if "error" not in result]
    return folders[:number]


def prepared(folder: Path, names: Sequence[str], number: int) -> list[Path]:
    """Return the first `number` task folders that exist, in the order of `names`."""
    return [folder / name for name in names if (folder / name / "task.yaml").is_file()][:number]


def measure_drags(parts: Sequence[Path], file: Path) -> None:
    """Write a table of the ratio of drag to normal force of each part on its rim; empty if it does not stand there."""
    rows = []
    for part in parts:
        task = EnvConfig.resolve(task_named(str(part))[0], ENVIRONMENT).declared
        ratios = [drag(task.workcell(), task.rim_contact(), speed) for speed in SPEEDS]
        rows.append({"part": part.name, **{f"drag_{1e3 * v:g}": r for v, r in zip(SPEEDS, ratios, strict=True)}})
    write_table(file.with_suffix(""), rows)


def train_once(
    parts: Sequence[Path], run: Path, seed: int, episodes: int, settings: Mapping[str, Any] | None = None
) -> Path:
    """Train a policy over parts, or continue the run; return its folder."""
    names = [task_named(str(part)) for part in parts]
    if not continue_run(run, episodes):
        imports = [folder for _, folders in names for folder in folders]
        chosen = SETTINGS | dict(settings or {})
        choices = Choices(preset="tqc_contact", settings=chosen, episodes=episodes, seed=seed, step_log=False)
        Training(run, [name for name, _ in names], ENVIRONMENT, choices, imports=imports, pictures=False).start()
    return run


def evaluate_part(
    part: Path, policies: Mapping[str, Path | str], episodes: int, out: Path, condition: str = "hard"
) -> None:
    """Evaluate policies, folders of runs or names of baseline policies, on the same held-out episodes of a part.

    A part that cannot be simulated under the condition, such as one without convex pieces in MuJoCo, is reported.
    """
    sources = {out / "rows" / condition / name / f"{part.name}.csv": source for name, source in policies.items()}
    try:
        evaluate_stored(task_named(str(part))[0], CONDITIONS[condition], sources, episodes)
    except InputError as error:
        if condition == "hard":
            raise
        report(f"{part.name} is left out in {condition}: {error}")


def learn_few_shot(part: Path, general: Path, seed: int, evaluated: int, out: Path) -> None:
    """Train specialists of a part from scratch and demonstrated to, until one evaluation reaches `ENOUGH`.

    They are evaluated after each of `FEW_SHOT` training episodes.
    """
    for name, settings in (("scratch", {}), ("demonstrated", DEMONSTRATED | {"demonstrator": str(general)})):
        for episodes in FEW_SHOT:
            file = out / "rows/hard" / f"{name}-{episodes}" / f"{part.name}.csv"
            if not file.exists():
                run = train_once([part], out / "runs" / f"{name}-{part.name}", seed, episodes, settings)
                evaluate_part(part, {f"{name}-{episodes}": run}, evaluated, out)
            if read_table(file)["success"].mean() >= ENOUGH:
                break


def compare_single_parts(few: Sequence[Path], others: Sequence[Path], evaluated: int, out: Path) -> None:
    """Evaluate each policy of `learn_few_shot` from scratch on all parts `few`, and the best of them on the others.

    The best one has the highest mean on the parts that it did not learn.
    """
    runs = {f"single-part-{part.name}": out / "runs" / f"scratch-{part.name}" for part in few}
    rates: dict[str, list[float]] = {name: [] for name in runs}
    for part in few:
        evaluate_part(part, runs, CALIBRATED, out)
        for name in runs:
            if not name.endswith(part.name):
                rates[name].append(read_table(out / "rows/hard" / name / f"{part.name}.csv")["success"].mean())
    best = max((name for name in runs if rates[name]), key=lambda name: sum(rates[name]), default=None)
    for part in others if best is not None else ():
        evaluate_part(part, {str(best): runs[str(best)]}, evaluated, out)


def tabulate(rows: Path) -> tuple[pd.DataFrame, dict[str, Any]]:
    """Return the successes of each policy on each held-out part, and a summary, from the episodes below a folder."""
    rates: dict[str, dict[str, float]] = {}
    worst: dict[str, dict[str, float]] = {}
    for file in sorted(rows.glob("*/*.csv")):
        episodes = read_table(file)
        rates.setdefault(file.parent.name, {})[file.stem] = float(episodes["success"].mean())
        limits = worst.setdefault(file.parent.name, {"peak_force": 0.0, "collisions": 0, "violation": -1.0})
        limits["peak_force"] = max(limits["peak_force"], float(episodes["peak_force"].max()))
        limits["collisions"] += int((episodes["termination"] == "collision").sum())
        limits["violation"] = max(limits["violation"], float(episodes["max_commanded_violation"].max()))
    table = pd.DataFrame(rates)
    searched = table.get("scripted", pd.Series(0.0, table.index))
    table["shows_learning"] = ~((table.get("uniform_random", 0.0) > EASY_RANDOM) | (searched > EASY_SEARCH))
    summary: dict[str, Any] = {}
    for name in rates:
        column = table[name].dropna()
        gained = (column - searched)[searched < EASY_SEARCH].dropna()
        summary[name] = {
            "parts": len(column), "mean": round(float(column.mean()), 4), "worst": float(column.min()),
            "parts_from_90_percent": int((column >= 0.9).sum()),
            "mean_where_learning_shows": round(float(column[table["shows_learning"]].mean()), 4),
            "p_better_than_search": wilcoxon(gained, alternative="greater").pvalue if gained.any() else None,
            **worst[name],
        }  # fmt: skip
    return table, summary


def main(arguments: list[str]) -> None:
    """Run the program."""
    parser = Parser(
        "unseen_parts",
        "Train one policy over many parts, and evaluate it on parts that were held out by a rule. Each finished step "
        "is stored, and the same command resumes.",
        "--meshes meshes --out unseen --processes 2",
    )
    parser.add_argument("--meshes", type=Path, required=True, help="folder with a subfolder for each pair of meshes")
    parser.add_out("unseen_parts")
    parser.add_argument("--unit", default="m", help="unit of the meshes (default: m)")
    parser.add_argument("--prepared", type=Path, help="folder with prepared task folders, which are used as they are")
    parser.add_argument("--training", type=int, default=TRAINING, help=f"training parts (default: {TRAINING})")
    parser.add_argument("--held-out", type=int, default=HELD_OUT, help=f"held-out parts (default: {HELD_OUT})")
    parser.add_argument("--seeds", type=int, default=3, help="seeds of the general policy (default: 3)")
    parser.add_argument("--episodes", type=int, default=600, help="training episodes (default: 600)")
    parser.add_argument("--single", type=int, default=3, help="training parts with a policy of their own (default: 3)")
    parser.add_argument("--single-episodes", type=int, default=80, help="their training episodes (default: 80)")
    parser.add_argument(
        "--specialists", type=int, default=150, help="training episodes of each held-out part's specialist; 0: none"
    )
    parser.add_argument(
        "--few-shot", type=int, default=10, help="held-out parts for specialists and steps (default: 10)"
    )
    parser.add_argument("--evaluated", type=int, default=100, help="held-out episodes of each part (default: 100)")
    parser.add_argument("--processes", type=int, default=1, help="pairs that are prepared at a time (default: 1)")
    parser.add_json()
    args = parser.parse_args(arguments)
    out = args.out.resolve()
    out.mkdir(parents=True, exist_ok=True)
    pairs = {pair.name: pair for pair in find_pairs(args.meshes, args.unit)}
    training_names, held_out_names = split_parts(pairs)
    split = {"training_candidates": training_names, "held_out_candidates": held_out_names}
    file = out / "split.json"
    if file.exists() and json.loads(file.read_text(encoding="utf-8")) != split:
        raise InputError(f"{file} has the split of other meshes: name another folder with --out")
    write_atomically(file, json.dumps(split, indent=1).encode())
    tasks = out / "tasks" if args.prepared is None else args.prepared.resolve()
    held_out, training = (
        prepare(pairs, names, number, tasks, args.processes, hard_episodes)
        if args.prepared is None
        else prepared(tasks, names, number)
        for names, number, hard_episodes in (
            (held_out_names, args.held_out, CALIBRATED),
            (training_names, args.training, 0),  # a calibration costs more than the rest of the preparation
        )
    )
    used = {"training": [part.name for part in training], "held_out": [part.name for part in held_out]}
    write_atomically(out / "parts.json", json.dumps(used, indent=1).encode())
    if not (out / "contact.csv").exists():
        measure_drags(held_out, out / "contact.csv")
    runs = [train_once(training, out / "runs" / f"general-{seed}", seed, args.episodes) for seed in range(args.seeds)]
    policies: dict[str, Path | str] = {name: name for name in ("zero", "uniform_random", "scripted")}
    policies |= {run.name: run for run in runs}
    if len(runs) > 1:
        mean = out / "runs" / "general-mean"
        if not (mean / "policy.json").exists():
            write_ensemble(runs, mean, SEARCH)
        policies["general-mean"] = mean
    for part in training[: args.single]:
        run = out / "runs" / f"single-{part.name}"
        policies[run.name] = train_once([part], run, 0, args.single_episodes)
    for part in held_out:
        evaluate_part(part, policies, args.evaluated, out)
    general = {name: run for name, run in policies.items() if name.startswith("general-")}
    for part in held_out:
        evaluate_part(part, {"scripted": "scripted"}, args.evaluated, out, "center_of_pressure")
    few = held_out[: args.few_shot]
    for condition, parts in {"automate": held_out, "mujoco": held_out, "step_5_ms": few, "step_2.5_ms": few}.items():
        for part in parts:
            evaluate_part(part, general, args.evaluated, out, condition)
    for part in held_out if args.specialists else ():
        run = train_once([part], out / "runs" / f"specialist-{part.name}", 0, args.specialists)
        evaluate_part(part, {"specialist": run}, args.evaluated, out)
    for part in few:
        learn_few_shot(part, out / "runs" / "general-mean", 0, args.evaluated, out)
    compare_single_parts(few, held_out[args.few_shot :], args.evaluated, out)
    summary = {}
    for condition in CONDITIONS:
        if (out / "rows" / condition).is_dir():
            table, summary[condition] = tabulate(out / "rows" / condition)
            write_table(out / f"table_{condition}", table.reset_index(names="part"))
    write_atomically(out / "summary.json", json.dumps(summary, indent=1).encode())
    print_result(
        {"training_parts": len(training), "held_out_parts": len(held_out), **summary.get("hard", {})}, as_json=args.json
    )


if __name__ == "__main__":
    run_program(main)
