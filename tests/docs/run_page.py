"""Run the code of a page from top to bottom and compare its output with the page.

A fenced block is one step. All `python` blocks of a page run in one namespace. Each line of an `sh` block is a command.
A block whose first line is `# file: NAME` is written to that file. A `text` block is the expected output of the
previous step, in which `...` matches anything. In a notebook, only the cells run, and their output is not compared.
The page runs in an empty folder. A failure ends the program with the block and the traceback on standard error.
"""

import contextlib
import doctest
import functools
import io
import multiprocessing
import os
import re
import shlex
import sys
import tempfile
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
        """Run an `sh` block in the fork; can be called once.

        Raises:
            EOFError: If the block fails; the fork has printed the traceback.
        """
        self._connection.send((os.getcwd(), text))
        print(self._connection.recv(), end="")

    @staticmethod
    def _serve(connection, parent_end) -> None:
        parent_end.close()  # so that recv raises an EOFError when the parent ends
        try:
            folder, text = connection.recv()
        except EOFError:
            return
        os.chdir(folder)
        with contextlib.redirect_stdout(io.StringIO()) as out:
            for line in text.splitlines():
                command(line)
        connection.send(out.getvalue())


def run(page: Path, shell: Shell | None) -> None:
    """Run the steps of a page."""
    namespace: dict = {"__name__": "page"}
    output = None
    for language, text in steps(page):
        print(f"Step of {page.name}:\n{text}", file=sys.stderr)
        if language == "text":
            if output is None:
                raise ValueError("a text block must follow a step")
            if not doctest.OutputChecker().check_output(text, output, FLAGS):
                raise ValueError(f"the step prints\n{output}\nbut the page shows\n{text}")
            output = None
            continue
        with contextlib.redirect_stdout(io.StringIO()) as out:
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
        output = out.getvalue()


def shorten_pictures() -> None:
    """Omit the layout of labels, show one episode on a training's page, and draw no pictures of a resumed training."""
    from guiderail.tools.learning import train
    from guiderail.tools.visualization import figures, replay

    figures.LAYOUT, replay.EPISODES = None, 1
    train.draw_pictures = functools.cache(train.draw_pictures)


def shorten_create_task() -> None:
    """Shorten what no page shows: contact map, size of the mixture, pieces for MuJoCo, one of two misaligned trials.

    Also leave out the episodes of the calibration, and the choice of a contact by its speed.
    """
    with contextlib.suppress(ImportError):  # guiderail-parts is missing
        from guiderail.models.primitives import mixture
        from guiderail_parts import contact, contact_map, create_task, difficulty, trial

        contact_map.TOUCHES, contact.MIN_SPEED = 4, 0.0
        contact.MISALIGNMENTS = create_task.MISALIGNMENTS = contact.MISALIGNMENTS[:1]
        trial.add_convex_pieces = lambda folder, file, *_: file
        mixture._MAX_COMPONENTS = 1
        difficulty.score_setting = lambda *_: difficulty.Score(0, 1, 1, 1)


def main(page: Path) -> None:
    """Run a page."""
    shorten_pictures()
    shorten_create_task()
    shell = Shell() if "--import" in page.read_text(encoding="utf-8") else None
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        sys.path.insert(0, folder)
        run(page, shell)
    sys.stdout.flush()
    os._exit(0)  # does not wait for threads


if __name__ == "__main__":
    main(Path(sys.argv[1]).resolve())
