"""Command line of the generators."""

from pathlib import Path

from research.command import Parser, run_program
from research.generate import GENERATORS, generate


def main(arguments: list[str]) -> None:
    """Parse the arguments and write the files."""
    parser = Parser(
        "generate",
        "Write files that the package ships: recorded demonstrations, and objects from their dimensions.",
        "connector-demonstrations --out .",
    )
    parser.add_argument("name", metavar="NAME", help=f"one of {', '.join(GENERATORS)}")
    parser.add_argument("--out", type=Path, help="folder (default: the folder in the package)")
    args = parser.parse_args(arguments)
    generate(args.name, args.out)


if __name__ == "__main__":
    run_program(main)
