"""Command line of the benchmark of parts."""

from __future__ import annotations

import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from guiderail.models.common.errors import InputError
from guiderail.tools.tables import write_table
from guiderail_parts.pairs import Pair, find_pairs
from research.command import Parser, print_result, run_program
from research.parts.campaign import finish, learn, prepare, summarize, to_table

DIFFICULTIES = ("standard", "hard", "automate")


def main(arguments: list[str]) -> None:
    """Run the program."""
    parser = Parser(
        "parts",
        "Create a task from every pair of meshes below a folder, test the insertion without an offset, and with "
        "--learn train and evaluate a policy. Each finished step is stored, and the same command resumes.",
        "--meshes assets --out parts --processes 2 --learn hard",
    )
    parser.add_argument("--meshes", type=Path, required=True, help="folder with the meshes; nothing is written to it")
    parser.add_out("parts_benchmark")
    parser.add_argument("--unit", default="m", help="unit of the meshes (default: m)")
    parser.add_argument("--pairs", help="names of pairs, separated by commas (default: all)")
    parser.add_argument("--every", type=int, default=1, help="learn only every n-th prepared pair (default: 1)")
    parser.add_argument("--learn", help=f"difficulties to learn, separated by commas: {', '.join(DIFFICULTIES)}")
    parser.add_argument("--episodes", type=int, default=150, help="training episodes (default: 150)")
    parser.add_argument("--held-out", type=int, default=100, help="evaluated episodes (default: 100)")
    parser.add_argument("--seeds", type=int, default=1, help="seeds of the training (default: 1)")
    parser.add_argument("--cpu", type=float, default=120.0, help="CPU time of a preparation [s] (default: 120)")
    parser.add_argument("--timeout", type=float, default=900.0, help="wall time of one command [s] (default: 900)")
    parser.add_argument("--processes", type=int, default=1, help="pairs at a time (default: 1)")
    parser.add_json()
    args = parser.parse_args(arguments)
    difficulties = args.learn.split(",") if args.learn else []
    for name in difficulties:
        if name not in DIFFICULTIES:
            raise InputError(f"--learn takes {', '.join(DIFFICULTIES)}, not {name!r}")
    pairs = find_pairs(args.meshes, args.unit)
    if args.pairs:
        selected = args.pairs.split(",")
        missing = sorted(set(selected) - {pair.name for pair in pairs})
        if missing:
            raise InputError(f"{args.meshes} has no pair {missing[0]!r}")
        pairs = [pair for pair in pairs if pair.name in selected]
    out = args.out.resolve()
    for folder in ("tasks", "runs", "logs", "steps"):
        (out / folder).mkdir(parents=True, exist_ok=True)
    rows: dict[str, dict[str, Any]] = {}

    def prepare_pair(pair: Pair) -> None:
        rows[pair.name] = finish(out / "steps" / f"{pair.name}.json", lambda: prepare(pair, out, args.cpu))
        row = rows[pair.name]
        print(f"{pair.name}: {row.get('error') or row['real_time_factor']}", file=sys.stderr, flush=True)

    def learn_pair(pair: Pair) -> None:
        shrink = rows[pair.name]["shrink_mm"]
        for difficulty in difficulties:
            for seed in range(args.seeds):
                result = finish(
                    out / "steps" / f"{pair.name}-{difficulty}-{seed}.json",
                    lambda d=difficulty, s=seed: learn(  # type: ignore[misc]
                        pair, out, d, s, args.episodes, args.held_out, args.timeout, shrink
                    ),
                )
                rows[pair.name] = {**rows[pair.name], f"{difficulty}-{seed}": result}
                print(f"{pair.name} {difficulty}: {result.get('error') or result['success_rate']}", file=sys.stderr)
        write_table(out / "table", to_table(rows))

    with ThreadPoolExecutor(args.processes) as pool:
        list(pool.map(prepare_pair, pairs))
        write_table(out / "table", to_table(rows))
        chosen = [pair for pair in pairs if "error" not in rows[pair.name]][:: args.every]
        list(pool.map(learn_pair, chosen if difficulties else []))
    print_result(summarize(rows), as_json=args.json)


if __name__ == "__main__":
    run_program(main)
