"""Command line of the benchmarks."""

from pathlib import Path

from guiderail.tools.cli.app import parse_environment
from research.benchmarks import BENCHMARKS, run_benchmark
from research.command import Parser, find_task, print_result, run_program


def main(arguments: list[str]) -> None:
    """Run the program."""
    parser = Parser("benchmarks", "Measure the speed of a part on this machine.", "simulation --json")
    parser.add_argument("name", metavar="NAME", help=f"one of {', '.join(BENCHMARKS)}")
    parser.add_argument("task", metavar="TASK", nargs="?", help="task whose training is measured")
    parser.add_argument("--picture", type=Path, help="file of a picture of the results, of time_step and engines")
    parser.add_environment()
    parser.add_json()
    args = parser.parse_args(arguments)
    task, modules = (None, ()) if args.task is None else find_task(args.task, args.imports)
    options = {"task": task, "environment": parse_environment(args.env), "imports": modules}
    results, show = run_benchmark(args.name, picture=args.picture, **options)
    if args.json:
        print_result(results, as_json=True)
    else:
        show(results)


if __name__ == "__main__":
    run_program(main)
