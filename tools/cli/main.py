"""Entry point of the `guiderail` command: reports errors as one sentence and an exit code."""

import errno
import io
import logging
import os
import sys
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any

import typer

from guiderail.models.common.errors import InputError, RunsFailedError, brief, explain_missing
from guiderail.models.common.registry import SIBLINGS, MissingSiblingError, did_you_mean, find_plugins
from guiderail.tools.cli.app import app, option_values, print_message
from guiderail.tools.terminal import protect_terminal

COMMANDS = ("train", "demo", "evaluate", "visualize", "list")
"""Names of the commands that `guiderail.tools.cli.commands` registers."""
ENVIRONMENT_OPTIONS = (
    "--guidance", "--station", "--difficulty", "--reward", "--observation", "--action-repeat", "--fixture-offset",
    "--robot",
)  # fmt: skip
"""Options of `train` and of commands of packages/hardware that other commands take as `--env NAME=VALUE`."""
INTERRUPTED = 130  # exit code after Ctrl-C


def load_commands(name: str = "") -> typer.Typer:
    """Return the application after importing the module of a command, or all modules if no command has that name.

    Raises:
        MissingSiblingError: If the command belongs to a sibling distribution that is not installed.
    """
    modules = dict.fromkeys(COMMANDS, "guiderail.tools.cli.commands")
    modules |= {command: point.value for command, point in find_plugins("command")}
    for sibling, names in SIBLINGS.items():
        if name in names and name not in modules:
            raise MissingSiblingError(f"guiderail {name}", sibling)
    for module in (modules[name],) if name in modules else dict.fromkeys(modules.values()):
        import_module(module)
    return app


def _print_version(requested: bool) -> None:
    """Print the version and exit, if it is requested."""
    if requested:
        import guiderail

        typer.echo(f"guiderail {guiderail.__version__}")
        raise typer.Exit


@app.callback()
def _guiderail(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    """Constrained reinforcement learning for contact-rich manipulation."""


def main(arguments: list[str] | None = None) -> None:
    """Run the command line, by default that of this process, and exit.

    The exit code is 0 for success, 1 for a failed run, 2 for wrong input and 130 if interrupted.
    """
    # Matrices are small here: threads cost more in synchronization than they save, and several runs share a machine.
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    arguments = (sys.argv[1:] if arguments is None else arguments) or ["--help"]
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # a terminal may lack the characters of a table or a bar
    protect_terminal()
    _show_messages()
    try:
        code = load_commands(*arguments[:1])(args=arguments, prog_name="guiderail", standalone_mode=False)
        if code == INTERRUPTED:  # typer returns this code instead of raising KeyboardInterrupt
            raise KeyboardInterrupt
    except InputError as error:
        print_message(str(error))
        code = 2
    except RunsFailedError as error:
        for sentence in error.sentences:
            print_message(sentence)
        code = 1
    except (KeyboardInterrupt, typer.Abort):
        print_message(f"stopped{_resume_hint(arguments)}")
        code = INTERRUPTED
    except BrokenPipeError:
        code = 1
    except OSError as error:
        if error.filename is None and error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
            message = f"the output cannot be written ({error.strerror}): choose a place with room to write"
        elif error.filename is not None and error.errno in (errno.ENAMETOOLONG, errno.EACCES):
            message = f"the path {brief(error.filename)} cannot be used ({error.strerror}): name another path"
        else:
            raise
        print_message(message)
        code = 2
    except Exception as error:
        missing = explain_missing(error) if isinstance(error, ImportError) else None
        if missing is None and not hasattr(error, "format_message"):
            raise
        print_message(str(missing) if missing is not None else _usage_sentence(error, arguments))
        code = 2
    sys.exit(code if isinstance(code, int) else 0)


class _MessageHandler(logging.Handler):
    """Handler that prints messages of the library on standard error."""

    def emit(self, record: logging.LogRecord) -> None:
        print_message(record.getMessage())


def _show_messages() -> None:
    """Print the library's messages, from level INFO on, and Drake's from level WARNING on."""
    logging.getLogger("drake").setLevel(logging.WARNING)
    logger = logging.getLogger("guiderail")
    logger.setLevel(logging.INFO)
    if not any(isinstance(handler, _MessageHandler) for handler in logger.handlers):
        logger.addHandler(_MessageHandler())
        logger.propagate = False


def _resume_hint(arguments: list[str]) -> str:
    """Return a hint on how to resume an interrupted command; empty if it cannot be resumed."""
    name, *words = map(str, [*arguments, ""])
    if name == "study":
        return "; the same command resumes it"
    folders = option_values(words, ["--out"])
    if name == "train" and folders and (Path(folders[-1]) / "checkpoint").is_dir():
        return "; resume with --resume"
    return ""


def _usage_sentence(error: Any, arguments: list[str]) -> str:
    """Return the usage error of typer as one sentence with a remedy."""
    message = " ".join(str(error.format_message()).split()).rstrip(".")
    message = message[:1].lower() + message[1:]
    context = getattr(error, "ctx", None)
    path = context.command_path if context is not None else "guiderail"
    if hasattr(error, "possibilities"):
        known = [name for parameter in context.command.params for name in parameter.opts] if context else []
        if "--env" in known and error.option_name in ENVIRONMENT_OPTIONS:
            value = (option_values(arguments, [error.option_name]) or [""])[-1] or "VALUE"
            name = error.option_name.removeprefix("--").replace("-", "_")
            return f"there is no option {error.option_name} here: give --env {name}={value}"
        return f"there is no option {error.option_name}: {did_you_mean(error.option_name, known)}"
    if "command" in message and context is not None and hasattr(context.command, "list_commands"):
        names = context.command.list_commands(context)
        if name := message.partition("'")[2].partition("'")[0]:
            return f"there is no command {name}: {did_you_mean(name, names)}"
        return f"{path} needs a command: choose one of {', '.join(names)}"
    return f"{message}: see {path} --help"
