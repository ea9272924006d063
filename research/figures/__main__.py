"""Command line of the figures."""

from research.command import Parser, print_result, run_program
from research.figures import FIGURES, reproduce


def main(arguments: list[str]) -> None:
    """Run the program."""
    parser = Parser(
        "figures", "Reproduce a figure of the thesis: a picture, and a table with its numbers.", "5.6 --seeds 3"
    )
    parser.add_argument("figure", metavar="FIGURE", help=f"one of {', '.join(FIGURES)}")
    parser.add_argument("--seeds", type=int, default=3, help="runs of each method (default: 3)")
    parser.add_argument("--episodes", type=int, help="episodes of each run (default: the figure's own)")
    parser.add_out("reproductions")
    parser.add_json()
    args = parser.parse_args(arguments)
    result = reproduce(args.figure, seeds=args.seeds, episodes=args.episodes, out=args.out)
    print_result(result, as_json=args.json)


if __name__ == "__main__":
    run_program(main)
