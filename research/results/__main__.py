"""Command line of the pages of results."""

from pathlib import Path

from guiderail.tools.files import write_atomically
from research.command import Parser, run_program
from research.results.methods import README_COLUMNS, README_TITLES, hard_tasks_table, replace_table
from research.results.page import store, write_pages

TABLES = Path(__file__).parent
ROOT = TABLES.parents[1]


def main(arguments: list[str]) -> None:
    """Run the program."""
    parser = Parser(
        "results",
        "Store the tables of finished studies and figures, and write the pages of results. Without --out, the tables "
        "are in research/results and the pages in docs/results, and the tables of hard tasks in README.md and "
        "docs/results.md are updated.",
        "studies reproductions",
    )
    parser.add_argument(
        "folders",
        type=Path,
        nargs="*",
        metavar="FOLDER",
        help="folder of finished studies or figures; without a folder, the pages are written from the stored tables",
    )
    parser.add_argument("--out", type=Path, help="folder of tables and pages instead")
    args = parser.parse_args(arguments)
    tables = args.out or TABLES
    store(args.folders, tables)
    for page in write_pages(tables, args.out or ROOT / "docs" / "results"):
        print(page)
    if args.out is None:
        for page, table in (
            (ROOT / "README.md", hard_tasks_table(tables, README_COLUMNS, README_TITLES)),
            (ROOT / "docs" / "results.md", hard_tasks_table(tables)),
        ):
            write_atomically(page, replace_table(page.read_text("utf-8"), table).encode())
            print(page)


if __name__ == "__main__":
    run_program(main)
