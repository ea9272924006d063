"""Command line of the generators."""

from pathlib import Path

from research.command import Parser, run_program
from research.generate import GENERATORS, generate


def main(arguments: list[str]) -> None:
    """Run the program."""
    parser = Parser(
        "generate",
        "Write files that the package ships: recorded demonstrations, and objects from their dimensions.",
        "connector-demonstrations --out .",
    )
    parser.add_argument("name", metavar="NAME", help=f"one of {', '.join(GENERATORS)}")
    parser.add_argument("--out", type=Path, help="folder (default: where the package has its own)")
    given = parser.parse_args(arguments)
    generate(given.name, given.out)


if __name__ == "__main__":
    run_program(main)
