"""Command line of action fuzzing."""

import json
import sys
from pathlib import Path

from guiderail.tools.cli.app import parse_environment, to_json
from research.action_fuzzing.tasks import ALL, CAMPAIGNS, fuzz
from research.command import Parser, find_task, run_program


def main(arguments: list[str]) -> int:
    """Run the program; the exit code is 1 if a check failed."""
    parser = Parser(
        "action_fuzzing",
        "Send random actions to a task and check the simulation, the commands and the task's limits. The exit code is "
        "1 if the simulation failed, a number was NaN or infinite, a prediction failed, a command of constrained "
        "guidance violated the constraints, the reported violation differs from the recomputed one, or a limit of the "
        "task was exceeded.",
        "BncConnector --episodes 1000 --out fuzzing.csv",
    )
    parser.add_argument("task", metavar="TASK", help=f"{', '.join(CAMPAIGNS)}, {ALL}, or another task or task folder")
    parser.add_argument("--episodes", type=int, help="number of episodes; one task only (default: 1000)")
    parser.add_argument("--steps", type=int, help="number of control steps, instead of --episodes")
    parser.add_argument("--seed", type=int, default=0, help="seed of the first episode (default: 0)")
    parser.add_argument(
        "--out", type=Path, help="table (.csv), or a folder for all tasks; an interrupted campaign is resumed"
    )
    parser.add_environment()
    parser.add_json()
    args = parser.parse_args(arguments)
    result = fuzz(
        find_task(args.task, args.imports)[0],
        episodes=args.episodes,
        steps=args.steps,
        seed=args.seed,
        out=args.out,
        environment=parse_environment(args.env),
        report=lambda line: print(line, file=sys.stderr, flush=True),
    )
    print(to_json(result) if args.json else json.dumps(result, indent=2))
    return 1 if result["failures"] else 0


if __name__ == "__main__":
    run_program(main)
