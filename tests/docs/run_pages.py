"""Run the code of pages from top to bottom and compare its output with the page.

A fenced block is one step. All `python` blocks of a page run in one namespace. Each line of an `sh` block is a command.
A block whose first line is `# file: NAME` is written to that file. A `text` block is the expected output of the
previous step, in which `...` matches anything. In a notebook, only the cells run, and their output is not compared.
Each page runs in an empty folder. The program prints a JSON object that maps the name of each page to its failure.
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
SHORTER = {"create-task": ["--hard-episodes", "1"]}  # options whose default value takes a minute
FLAGS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE


def steps(page: Path) -> list[tuple[str, str]]:
    """Return the language and the text of each block of a page, or of each cell of a notebook."""
    text = page.read_text(encoding="utf-8")
    return (CELL if "\nfile_format: mystnb\n" in text else FENCE).findall(text)


def command(line: str) -> None:
    """Run one shell line, which must begin with `guiderail`."""
    from guiderail.tools.cli.main import main

    words = shlex.split(line)
    if words[0] != "guiderail":
        raise ValueError(f"a page may run only the command guiderail, not {words[0]}")
    try:
        main(words[1:] + SHORTER.get(words[1], []))
    except SystemExit as end:
        if end.code:
            raise RuntimeError(f"{line!r} ended with exit code {end.code}") from None


class Shell:
    """Fork of this process that runs one `sh` block with `--import`, because a process registers a task only once."""

    def __init__(self) -> None:
        context = multiprocessing.get_context("fork")
        self._connection, child_end = context.Pipe()
        self._process = context.Process(target=self._serve, args=(child_end, self._connection), daemon=True)
        self._process.start()
        child_end.close()

    def run(self, text: str) -> None:
        """Run an `sh` block in the fork; can be called once."""
        self._connection.send((os.getcwd(), text))
        out, err, failure = self._connection.recv()
        print(out, end="")
        print(err, end="", file=sys.stderr)
        if failure:
            raise RuntimeError(failure)

    @staticmethod
    def _serve(connection, parent_end) -> None:
        parent_end.close()  # so that recv raises an EOFError when the parent ends
        try:
            folder, text = connection.recv()
        except EOFError:
            return
        os.chdir(folder)
        failure = None
        with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.redirect_stderr(io.StringIO()) as err:
            try:
                for line in text.splitlines():
                    command(line)
            except Exception as error:
                failure = str(error)
        connection.send((out.getvalue(), err.getvalue(), failure))


def run(page: Path, shell: Shell | None) -> str:
    """Return the failure of a page, or an empty text."""
    namespace: dict = {"__name__": "page"}
    output = None
    for language, text in steps(page):
        try:
            if language == "text":
                if output is None:
                    raise ValueError("a text block must follow a step")
                if not doctest.OutputChecker().check_output(text, output, FLAGS):
                    raise ValueError(f"the step prints\n{output}\nbut the page shows\n{text}")
                output = None
                continue
            with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.redirect_stderr(io.StringIO()) as err:
                try:
                    if text.startswith("# file: "):
                        first_line, _, content = text.partition("\n")
                        Path(first_line.removeprefix("# file: ")).write_text(content, encoding="utf-8")
                    elif language == "python":
                        exec(compile(text, str(page), "exec"), namespace)
                    elif shell and language == "sh" and "--import" in text:
                        shell.run(text)
                    elif language == "sh":
                        for line in text.splitlines():
                            command(line)
                    else:
                        raise ValueError(f"a block of {language} cannot be run")
                except Exception as error:
                    error.add_note(err.getvalue()[-2000:])
                    raise
            output = out.getvalue()
        except Exception:
            return f"{text}\n{traceback.format_exc(limit=-3)}"
    return ""


def shorten_pictures() -> None:
    """Omit the layout of labels and show one episode on a training's page, which saves time in tests."""
    from guiderail.tools.visualization import figures, replay

    figures.LAYOUT, replay.EPISODES = None, 1


def main(pages: list[Path]) -> None:
    """Run pages one after the other and print their failures."""
    shorten_pictures()
    failures = {}
    shells = [Shell() if "--import" in page.read_text(encoding="utf-8") else None for page in pages]
    for page, shell in zip(pages, shells, strict=True):
        with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
            sys.path.insert(0, folder)
            failures[page.stem] = run(page, shell)
            sys.path.remove(folder)
    print(json.dumps(failures))
    sys.stdout.flush()
    os._exit(0)  # does not wait for threads


if __name__ == "__main__":
    main([Path(name).resolve() for name in sys.argv[1:]])
