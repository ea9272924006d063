"""What studies by seeds share on the command line: their options, a line for every row, one sentence for an error."""

import argparse
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from guiderail.models.errors import InputError


def numbers(text: str) -> list[int]:
    """Whole numbers, separated by commas."""
    return [int(number) for number in text.split(",")]


def study_parser(description: str | None, *, methods: str, seeds: str) -> argparse.ArgumentParser:
    """A parser with what every study has; `methods` and `seeds` are its defaults, separated by commas."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--out", type=Path, required=True, help="the folder; runs in it are used again")
    parser.add_argument("--methods", type=lambda text: text.split(","), default=methods, help="separated by commas")
    parser.add_argument("--seeds", type=numbers, default=seeds, help="separated by commas")
    parser.add_argument("--evaluations", type=int, default=100, help="held-out episodes each time")
    return parser


def run_study(
    study: Callable[..., dict[str, Any]], parser: argparse.ArgumentParser, arguments: Sequence[str] | None
) -> None:
    """Calls the study with what was given, by name; exits with 2 and one sentence where that was wrong."""
    given = vars(parser.parse_args(arguments))
    try:
        result = study(given.pop("out"), **given, report=lambda row: print(json.dumps(row), flush=True))
    except InputError as error:
        parser.exit(2, f"guiderail: {error}\n")
    print(json.dumps(result, indent=2, ensure_ascii=False))
