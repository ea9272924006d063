"""Entry point of `guiderail` and `python -m guiderail`; it also starts if optional dependencies are missing."""

import sys

from guiderail.models.common.errors import explain_missing


def main() -> None:
    """Run the command; if one of its dependencies is not installed, print one sentence and exit with code 2."""
    try:
        from guiderail.tools.cli import main as command
    except ModuleNotFoundError as error:
        missing = explain_missing(error)
        if missing is None:
            raise
        print(f"guiderail: {missing}", file=sys.stderr)
        sys.exit(2)
    command.main()


if __name__ == "__main__":
    main()
