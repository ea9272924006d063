"""Command line of the reproduction, `python -m research.thesis`."""

from guiderail.models.common.errors import InputError
from research.command import Parser
from research.reproduction.report import write_report
from research.reproduction.runs import FIGURES, find_runs, jobs_of, num_done, remaining_hours, train
from research.reproduction.tables import TABLES, store


def main(arguments: list[str]) -> None:
    """Run the program."""
    parser = Parser(
        "thesis",
        "Train the runs of the thesis's figures, store their episodes, and write the report docs/thesis.md. The cost "
        "of training in core-hours is printed first. Without --figure, the report is written from the stored tables.",
        "--figure 3.5 --resume",
    )
    parser.add_argument(
        "--figure", action="append", default=[], help=f"one of {', '.join(FIGURES)}, or all; can be repeated"
    )
    parser.add_argument("--resume", action="store_true", help="continue the runs in the folder")
    parser.add_argument("--cost", action="store_true", help="print the cost and train nothing")
    parser.add_argument("--store", action="store_true", help="store the runs so far and train nothing")
    parser.add_out("reproductions")
    args = parser.parse_args(arguments)
    studies = find_runs(FIGURES if "all" in args.figure else args.figure)
    hours = [remaining_hours(runs, args.out) for runs in studies]
    for runs, hour in zip(studies, hours, strict=True):
        print(f"{runs.study}: at most {hour:.1f} core-hours remain")
    if studies:
        print(f"all: at most {sum(hours):.1f} core-hours", flush=True)
    if args.cost:
        return
    if not (args.resume or args.store):
        for runs in studies:
            if any(num_done(job) for job in jobs_of(runs, args.out)):
                raise InputError(f"{args.out} has runs of {runs.study}: give --resume, or another folder with --out")
    for runs in studies:
        if not args.store:
            for _ in train(runs, args.out, lambda text: print(text, flush=True)):
                store(runs, args.out)
        for file in store(runs, args.out):
            print(file)
    for path in write_report(TABLES):
        print(path)
