"""Server that runs programs in forks of one interpreter, after the imports of the common packages.

Each request is one line of JSON: `arguments` of an interpreter (`-c`, code and arguments, or a file and arguments), the
working `folder`, and changes of the `environment`. Each response is one line of JSON: `returncode`, `stdout` and
`stderr`. Programs share no memory, and what a program registers is unknown to the next program.
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
from collections.abc import Sequence
from multiprocessing import forkserver, resource_tracker, util
from typing import Any, TextIO

# Packages that take long to import. Modules of guiderail are not preloaded, because imports fill its registries.
PRELOADED = (
    "pydrake.all", "torch", "stable_baselines3", "sb3_contrib", "gymnasium", "sklearn.mixture", "scipy.stats",
    "scipy.signal", "pandas", "pyarrow.parquet", "pydantic", "typer", "rich.progress", "jinja2", "safetensors.torch",
    "matplotlib.figure", "matplotlib.backends.backend_agg",
)  # fmt: skip


class Forks:
    """Connection to a server process that runs programs in forks of this process, or of a new interpreter.

    Args:
        interpreter: Path of the new interpreter, which imports the common packages; None to fork this process.
        preloaded: Modules that the new interpreter imports, too.
        keywords: Arguments of `subprocess.Popen` for a new interpreter.
    """

    def __init__(self, interpreter: str | None = None, preloaded: Sequence[str] = (), **keywords: Any) -> None:
        self._process = None
        if interpreter is not None:
            self._process = subprocess.Popen(
                [interpreter, __file__, *preloaded],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
                **keywords,
            )
            self._requests, self._responses = self._process.stdin, self._process.stdout
            assert self._responses.readline() == "ready\n"
            return
        parent_end, child_end = socket.socketpair()
        self._server = os.fork()
        if not self._server:
            parent_end.close()  # so that the server ends with this process
            serve(child_end.makefile("r"), child_end.makefile("w"))
            os._exit(0)
        child_end.close()
        self._requests, self._responses = parent_end.makefile("w"), parent_end.makefile("r")
        parent_end.close()

    def run(self, *arguments: object, folder: object = ".", **environment: str) -> subprocess.CompletedProcess:
        """Run an interpreter with these arguments in `folder`; return the result as `subprocess.run` does."""
        texts = [str(argument) for argument in arguments]
        print(json.dumps({"arguments": texts, "folder": str(folder), "environment": environment}), file=self._requests)
        self._requests.flush()
        return subprocess.CompletedProcess(texts, **json.loads(self._responses.readline()))

    def close(self) -> None:
        """Stop the server."""
        self._requests.close(), self._responses.close()
        os.waitpid(self._server, 0) if self._process is None else self._process.wait()


def start_forkserver() -> None:
    """Start the fork server of multiprocessing as a fork of this process instead of as a new interpreter."""

    def spawn(path: bytes, arguments: list[str], inherited: list[int]) -> int:
        if pid := os.fork():
            return pid
        # The server ends when the writing end of this pipe is closed, so only the parent may have that end open.
        pipe = os.fstat(inherited[-1])
        for descriptor in set(range(3, 1024)) - set(inherited):
            with contextlib.suppress(OSError):
                if os.path.samestat(os.fstat(descriptor), pipe):
                    os.close(descriptor)
        try:
            exec(arguments[arguments.index("-c") + 1], {})
        finally:  # the server ends with an exception
            os._exit(0)

    resource_tracker.ensure_running()
    original, util.spawnv_passfds = util.spawnv_passfds, spawn
    try:
        forkserver.ensure_running()
    finally:
        util.spawnv_passfds = original


def run_program(arguments: list[str], folder: str, environment: dict[str, str], out: int, err: int) -> None:
    """Run the program in this process and end the process.

    Args:
        arguments: Arguments of an interpreter.
        folder: Working directory.
        environment: Changes of the environment variables.
        out: File descriptor of the standard output.
        err: File descriptor of the standard error.
    """
    forkserver._forkserver._forkserver_pid = None  # that fork server is no child of this process
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


def serve(requests: TextIO, responses: TextIO) -> None:
    """Run one program per request, one after the other, until the requests end."""
    for line in requests:
        program = json.loads(line)
        with tempfile.TemporaryFile("w+") as out, tempfile.TemporaryFile("w+") as err:
            if (pid := os.fork()) == 0:
                run_program(**program, out=out.fileno(), err=err.fileno())
            returncode = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
            out.seek(0), err.seek(0)
            result = {"returncode": returncode, "stdout": out.read(), "stderr": err.read()}
            print(json.dumps(result), file=responses, flush=True)


def main() -> None:
    """Import the common packages, print "ready", and serve requests from the standard input."""
    for name in (*PRELOADED, *sys.argv[1:]):
        __import__(name)
    print("ready", flush=True)
    serve(sys.stdin, sys.stdout)
    os._exit(0)  # the end of an interpreter with these packages takes seconds


if __name__ == "__main__":
    main()
