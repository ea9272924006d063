"""Runs the code of pages as a reader would, from top to bottom, and compares what it prints.

A fenced block is one step. `python` is run, in one namespace a page; `sh` is a line of the command each; a block whose
first line is `# file: NAME` is written to that file. A `text` block right after a step is what that step prints, where
`...` stands for anything. Of a notebook, the cells are run, and only they: what they print is no part of the page. Each
page has an empty folder of its own. Prints one JSON object: page to what was wrong.
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
FLAGS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE


def steps(page: Path) -> list[tuple[str, str]]:
    """Language and text of each block of a page, or of each cell of a notebook."""
    text = page.read_text(encoding="utf-8")
    return (CELL if "\nfile_format: mystnb\n" in text else FENCE).findall(text)


def command(line: str) -> None:
    """What a shell does with a line that begins with guiderail."""
    from guiderail.tools.cli.main import main

    words = shlex.split(line)
    if words[0] != "guiderail":
        raise ValueError(f"a page may only call guiderail, not {words[0]}")
    try:
        main(words[1:])
    except SystemExit as end:
        if end.code:
            raise RuntimeError(f"{line!r} ended with {end.code}") from None


class Shell:
    """A fork of this process as it is now, for lines that import what a page imports: here it would be there twice."""

    def __init__(self) -> None:
        context = multiprocessing.get_context("fork")
        self._connection, theirs = context.Pipe()
        self._process = context.Process(target=self._serve, args=(theirs, self._connection), daemon=True)
        self._process.start()
        theirs.close()

    def run(self, text: str) -> None:
        """Once only."""
        self._connection.send((os.getcwd(), text))
        out, err, wrong = self._connection.recv()
        print(out, end="")
        print(err, end="", file=sys.stderr)
        if wrong:
            raise RuntimeError(wrong)

    @staticmethod
    def _serve(connection, others) -> None:
        others.close()  # so that the end of the page is the end of this
        try:
            folder, text = connection.recv()
        except EOFError:  # the page ended before
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
    """What is wrong with a page; nothing where all of it runs and prints what it says."""
    namespace: dict = {"__name__": "page"}
    printed = None
    for language, text in steps(page):
        try:
            if language == "text":
                if printed is None:
                    raise ValueError("a text block follows what prints it")
                if not doctest.OutputChecker().check_output(text, printed, FLAGS):
                    raise ValueError(f"it prints\n{printed}\nand the page says\n{text}")
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
                        raise ValueError(f"nobody runs {language}")
                except Exception as error:
                    error.add_note(err.getvalue()[-2000:])
                    raise
            printed = out.getvalue()
        except Exception:
            return f"{text}\n{traceback.format_exc(limit=-3)}"
    return ""


def main(pages: list[Path]) -> None:
    """Runs pages one after the other."""
    found = {}
    shells = [Shell() if "--import" in page.read_text(encoding="utf-8") else None for page in pages]
    for page, shell in zip(pages, shells, strict=True):
        with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
            sys.path.insert(0, folder)
            found[page.stem] = run(page, shell)
            sys.path.remove(folder)
    print(json.dumps(found))
    sys.stdout.flush()
    os._exit(0)  # threads of what was run end with it


if __name__ == "__main__":
    main([Path(name).resolve() for name in sys.argv[1:]])
