"""Command lines of the research programs, `python -m research.NAME`."""

import argparse
import sys
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, NoReturn

from guiderail.models.common.errors import InputError, RunsFailedError
from guiderail.tools.cli.app import to_json


class Parser(argparse.ArgumentParser):
    """Argument parser that reports a wrong argument as an `InputError`."""

    def __init__(self, program: str, description: str, example: str):
        """Construct the parser.

        Args:
            program: Name of the module, after `research.`.
            description: What the program does.
            example: Arguments of a complete call, shown at the end of the help.
        """
        name = f"python -m research.{program}"
        super().__init__(name, description=description, epilog=f"Example: {name} {example}")

    def error(self, message: str) -> NoReturn:
        """Raise an `InputError` with the message."""
        raise InputError(f"{message}: see {self.prog} --help")

    def add_out(self, default: str | None) -> None:
        """Add the option `--out`, a folder, required if there is no default."""
        text = "folder of the results; finished results in it are reused"
        if default is None:
            self.add_argument("--out", type=Path, required=True, help=text)
        else:
            self.add_argument("--out", type=Path, default=Path(default), help=f"{text} (default: {default})")

    def add_environment(self) -> None:
        """Add the options `--env` and `--import` of programs that build a task's environment."""
        self.add_argument(
            "--env", action="append", metavar="KEY=VALUE", help="option of the environment; can be repeated"
        )
        self.add_argument(
            "--import",
            dest="imports",
            action="append",
            default=[],
            metavar="MODULE",
            help="module or file (.py) that registers the task; can be repeated",
        )

    def add_json(self) -> None:
        """Add the switch `--json`."""
        self.add_argument("--json", action="store_true", help="print one JSON object")


def find_task(task: str, imports: Iterable[str]) -> tuple[str, tuple[str, ...]]:
    """Return the name of a task and the modules that register it.

    Args:
        task: Name of a task, or path of a task folder.
        imports: Modules or files (.py) to import first.

    Raises:
        InputError: If a module cannot be imported or a task folder is invalid.
    """
    from guiderail.tools.environments import task_named
    from guiderail.tools.imports import import_modules

    modules = import_modules(imports)
    name, folders = task_named(task)
    return name, (*modules, *folders)


def print_result(result: Mapping[str, Any], *, as_json: bool = False) -> None:
    """Print a result, one line per key, or as one JSON object in which infinity and NaN are null."""
    if as_json:
        print(to_json(result))
        return
    from guiderail.tools.tables import cell

    width = max(map(len, result), default=0)
    for key, value in result.items():
        print(f"{key.replace('_', ' '):<{width}}  {cell(value)}")


def print_rows(table: Path, rows: list[dict[str, Any]], *, as_json: bool) -> None:
    """Print the path of a table; as JSON, print its rows as well."""
    print_result({"table": str(table)} | ({"rows": rows} if as_json else {}), as_json=as_json)


def run_program(main: Callable[[list[str]], int | None], arguments: list[str] | None = None) -> NoReturn:
    """Run a program and exit: 0 for success, 1 if a check or a run failed, 2 for wrong input, 130 if interrupted.

    Args:
        main: Function from the arguments to the exit code, or to None for success.
        arguments: Arguments; by default the command-line arguments of the process.
    """
    try:
        code = main(sys.argv[1:] if arguments is None else arguments) or 0
    except InputError as error:
        code = _print_error(str(error), 2)
    except RunsFailedError as error:
        code = _print_error("\n".join(error.sentences), 1)
    except KeyboardInterrupt:
        code = _print_error("interrupted", 130)
    except BrokenPipeError:
        code = 1
    sys.exit(code)


def _print_error(message: str, code: int) -> int:
    for line in message.splitlines():
        print(f"research: {line}", file=sys.stderr, flush=True)
    return code
