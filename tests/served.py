"""Runs programs in forks of one interpreter, which imported what all of them need once.

A line of JSON in, and one out. In: `arguments` as an interpreter takes them after its name (`-c`, code and what
follows, or a file and what follows), the `folder` to run in, and what of the `environment` is other. Out: `returncode`,
`stdout` and `stderr`. A fork has what any new process has: its own memory and exit code, and no learner, task or
environment that another one made.
"""

import contextlib
import json
import os
import runpy
import socket
import subprocess
import sys
import tempfile
import traceback
from multiprocessing import forkserver, resource_tracker, util
from typing import TextIO

# What takes long, and knows nothing of tasks: others' packages, and none of guiderail's registries.
PRELOADED = (
    "pydrake.all", "torch", "stable_baselines3", "sb3_contrib", "gymnasium", "sklearn.mixture", "scipy.stats",
    "scipy.signal", "pandas", "pyarrow.parquet", "pydantic", "typer", "rich.progress", "jinja2", "safetensors.torch",
    "matplotlib.figure", "matplotlib.backends.backend_agg",
)  # fmt: skip


class Forks:
    """Programs in forks of this process as it is now."""

    def __init__(self) -> None:
        ours, theirs = socket.socketpair()
        self._server = os.fork()
        if not self._server:
            ours.close()  # so that the end of this process is the server's
            serve(theirs.makefile("r"), theirs.makefile("w"))
            os._exit(0)
        theirs.close()
        self._asked, self._answered = ours.makefile("w"), ours.makefile("r")
        ours.close()

    def run(self, *arguments: object, folder: object = ".", **environment: str) -> subprocess.CompletedProcess:
        """As `subprocess.run` of an interpreter with these arguments."""
        words = [str(argument) for argument in arguments]
        print(json.dumps({"arguments": words, "folder": str(folder), "environment": environment}), file=self._asked)
        self._asked.flush()
        return subprocess.CompletedProcess(words, **json.loads(self._answered.readline()))

    def close(self) -> None:
        """Ends the server."""
        self._asked.close(), self._answered.close()
        os.waitpid(self._server, 0)


def begin_forkserver() -> None:
    """Begins the standard library's server of forks as a fork of this process, where it would be a new interpreter."""

    def begin(path: bytes, arguments: list[str], kept: list[int]) -> int:
        if number := os.fork():
            return number
        # It is to end with its parent, which alone may hold the other end of a pipe for that.
        pipe = os.fstat(kept[-1])
        for descriptor in set(range(3, 1024)) - set(kept):
            with contextlib.suppress(OSError):
                if os.path.samestat(os.fstat(descriptor), pipe):
                    os.close(descriptor)
        try:
            exec(arguments[arguments.index("-c") + 1], {})
        finally:  # it ends by an exception: nobody is left who asks
            os._exit(0)

    resource_tracker.ensure_running()
    usual, util.spawnv_passfds = util.spawnv_passfds, begin
    try:
        forkserver.ensure_running()
    finally:
        util.spawnv_passfds = usual


def child(arguments: list[str], folder: str, environment: dict[str, str], out: int, err: int) -> None:
    """Becomes the program; never returns."""
    forkserver._forkserver._forkserver_pid = None  # another process's child
    os.dup2(out, 1)
    os.dup2(err, 2)
    sys.stdout, sys.stderr = (open(number, "w", closefd=False) for number in (1, 2))  # noqa: SIM115
    os.environ.update(environment)
    os.chdir(folder)
    status = 0
    try:
        if arguments[0] == "-c":
            sys.path[0], sys.argv = "", ["-c", *arguments[2:]]
            exec(compile(arguments[1], "<string>", "exec"), {"__name__": "__main__"})
        else:
            sys.path[0], sys.argv = os.path.dirname(arguments[0]), arguments
            runpy.run_path(arguments[0], run_name="__main__")
    except SystemExit as end:
        status = end.code if isinstance(end.code, int) else int(end.code is not None)
    except BaseException:
        traceback.print_exc()
        status = 1
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)


def serve(asked: TextIO, answered: TextIO) -> None:
    """Serves until nobody asks any more."""
    for line in asked:
        program = json.loads(line)
        with tempfile.TemporaryFile("w+") as out, tempfile.TemporaryFile("w+") as err:
            if (number := os.fork()) == 0:
                child(**program, out=out.fileno(), err=err.fileno())
            returncode = os.waitstatus_to_exitcode(os.waitpid(number, 0)[1])
            out.seek(0), err.seek(0)
            result = {"returncode": returncode, "stdout": out.read(), "stderr": err.read()}
            print(json.dumps(result), file=answered, flush=True)


def main() -> None:
    """Serves who started this interpreter."""
    for name in PRELOADED:
        __import__(name)
    print("ready", flush=True)
    serve(sys.stdin, sys.stdout)


if __name__ == "__main__":
    main()
