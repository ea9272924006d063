"""Run the code of pages from top to bottom and compare what it prints.

A fenced block is one step. `python` is run in one namespace per page; each line of `sh` is a command; a block whose
first line is `# file: NAME` is written to that file. A `text` block after a step is its expected output, in which `...`
matches anything. Of a notebook only the cells are run, and their output is not compared. Each page has an empty folder.
Prints one JSON object from page to failure.
"""

import contextlib
import doctest
import io
import json
import multiprocessing
import os
import re
import shlex
import sys
import tempfile
import traceback
from pathlib import Path

FENCE = re.compile(r"^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
CELL = re.compile(r"^```\{code-cell\} (\w+)\n(?:---\n.*?^---\n)?(.*?)^```$", re.MULTILINE | re.DOTALL)
SHORTER = {"create-task": ["--hard-episodes", "1"]}  # options that a page leaves at defaults that take a minute
FLAGS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE


def steps(page: Path) -> list[tuple[str, str]]:
    """Return language and text of each block of a page, or of each cell of a notebook."""
    text = page.read_text(encoding="utf-8")
    return (CELL if "\nfile_format: mystnb\n" in text else FENCE).findall(text)


def command(line: str) -> None:
    """Run a line that begins with guiderail, as a shell does."""
    from guiderail.tools.cli.main import main

    words = shlex.split(line)
    if words[0] != "guiderail":
        raise ValueError(f"a page may only call guiderail, not {words[0]}")
    try:
        main(words[1:] + SHORTER.get(words[1], []))
    except SystemExit as end:
        if end.code:
            raise RuntimeError(f"{line!r} ended with {end.code}") from None


class Shell:
    """Fork of this process for one step, whose imports must not happen twice in this process."""

    def __init__(self) -> None:
        context = multiprocessing.get_context("fork")
        self._connection, child_end = context.Pipe()
        self._process = context.Process(target=self._serve, args=(child_end, self._connection), daemon=True)
        self._process.start()
        child_end.close()

    def run(self, text: str) -> None:
        """Run a step in the fork; only once."""
        self._connection.send((os.getcwd(), text))
        out, err, wrong = self._connection.recv()
        print(out, end="")
        print(err, end="", file=sys.stderr)
        if wrong:
            raise RuntimeError(wrong)

    @staticmethod
    def _serve(connection, parent_end) -> None:
        parent_end.close()  # so that this process ends when the page ends
        try:
            folder, text = connection.recv()
        except EOFError:  # the page has ended
            return
        os.chdir(folder)
        wrong = None
        with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.redirect_stderr(io.StringIO()) as err:
            try:
                for line in text.splitlines():
                    command(line)
            except Exception as error:
                wrong = str(error)
        connection.send((out.getvalue(), err.getvalue(), wrong))


def run(page: Path, shell: Shell | None) -> str:
    """Return what fails on a page; an empty text if nothing does."""
    namespace: dict = {"__name__": "page"}
    printed = None
    for language, text in steps(page):
        try:
            if language == "text":
                if printed is None:
                    raise ValueError("a text block must follow a step that prints")
                if not doctest.OutputChecker().check_output(text, printed, FLAGS):
                    raise ValueError(f"it prints\n{printed}\nbut the page shows\n{text}")
                printed = None
                continue
            with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.redirect_stderr(io.StringIO()) as err:
                try:
                    if text.startswith("# file: "):
                        first, _, rest = text.partition("\n")
                        Path(first.removeprefix("# file: ")).write_text(rest, encoding="utf-8")
                    elif language == "python":
                        exec(compile(text, str(page), "exec"), namespace)
                    elif shell and language == "sh" and "--import" in text:
                        shell.run(text)
                    elif language == "sh":
                        for line in text.splitlines():
                            command(line)
                    else:
                        raise ValueError(f"{language} cannot be run")
                except Exception as error:
                    error.add_note(err.getvalue()[-2000:])
                    raise
            printed = out.getvalue()
        except Exception:
            return f"{text}\n{traceback.format_exc(limit=-3)}"
    return ""


def plain_pictures() -> None:
    """Skip the layout of labels, and show one episode on the page of a training, as in the tests of the tools."""
    from guiderail.tools.visualization import replay, style

    style.LAYOUT, replay.EPISODES = None, 1


def main(pages: list[Path]) -> None:
    """Run pages one after the other."""
    plain_pictures()
    failures = {}
    shells = [Shell() if "--import" in page.read_text(encoding="utf-8") else None for page in pages]
    for page, shell in zip(pages, shells, strict=True):
        with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
            sys.path.insert(0, folder)
            failures[page.stem] = run(page, shell)
            sys.path.remove(folder)
    print(json.dumps(failures))
    sys.stdout.flush()
    os._exit(0)  # ends threads as well


if __name__ == "__main__":
    main([Path(name).resolve() for name in sys.argv[1:]])
