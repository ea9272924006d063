"""Passports of several policies: is the success in an engine predicted from the other engines?

    python -m research.passports RUN [RUN ...] --out passports

Each policy is evaluated in the same held-out episodes in each installed engine at its default step, and in Drake with
other friction and clearance. Finished conditions are stored, and the same command resumes. The success in
an engine is predicted from the conditions of the others, as `guiderail passport` does. `passports.csv` has one row per
policy and condition, `predictions.csv` one per policy and engine.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from guiderail.tools.evaluation.episode import HELD_OUT_SEED
from guiderail.tools.tables import write_table
from guiderail_studies.converge import evaluate_conditions, find_run, success_and_force
from guiderail_studies.passport import installed_engines, passport_conditions, predict_left_out
from research.command import Parser, print_result, run_program
from research.stored import report

CHANGED = "drake"  # engine in which friction and clearance are changed
WITHIN = 0.05  # largest error of a good prediction


def main(arguments: list[str]) -> None:
    """Run the program."""
    parser = Parser(
        "passports",
        "Evaluate policies in all installed engines, and predict the success in each from the others.",
        "runs/connector runs/clamp --out passports",
    )
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN", help="trained run")
    parser.add_out("passports")
    parser.add_argument("--episodes", type=int, default=40, help="held-out episodes of a condition (default: 40)")
    parser.add_argument("--processes", type=int, help="processes that evaluate (default: number of cores)")
    parser.add_json()
    args = parser.parse_args(arguments)
    rows, predictions = [], []
    for run in args.runs:
        subject, out = find_run(run, None, args.out.resolve() / "rows" / run.resolve().name, "")
        config = subject.config
        assert config is not None  # a run has one
        possible = passport_conditions(
            config.task, subject.changed_environment({}), installed_engines(), lambda sentence: None
        )
        defaults = {c.engine: c for c in reversed(possible)}  # the first condition of each engine
        found = [c for c in possible if c is defaults[c.engine] or (c.change and c.engine == CHANGED)]
        evaluated = evaluate_conditions(
            subject, found, out, episodes=args.episodes, seed=HELD_OUT_SEED, processes=args.processes
        )
        own = [
            {
                "task": config.task, "run": run.resolve().name, "condition": condition.name, "engine": condition.engine,
                "step_ms": condition.step, "change": condition.change, **success_and_force(table),
            }
            for condition, table in zip(found, evaluated, strict=True)
        ]  # fmt: skip
        rows += own
        predictions += [{"task": config.task, "run": own[0]["run"], **p} for p in predict_left_out(own)]
        report(f"{own[0]['run']}: " + ", ".join(f"{row['condition']} {row['success_rate']:.0%}" for row in own))
        write_table(args.out / "passports", rows)
        write_table(args.out / "predictions", predictions)
    errors = np.abs([row["error"] for row in predictions])
    result = {"policies": len(args.runs), "within_5_points": float(np.mean(errors <= WITHIN + 1e-9))}
    print_result({**result, "mean_error": float(errors.mean())}, as_json=args.json)


if __name__ == "__main__":
    run_program(main)
