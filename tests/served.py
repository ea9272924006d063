"""Run programs in forks of one interpreter that has imported the common packages.

Protocol: one line of JSON in, one out. In: `arguments` of an interpreter (`-c`, code and arguments, or a file and
arguments), the working `folder`, and changes of the `environment`. Out: `returncode`, `stdout` and `stderr`. A fork has
its own memory and exit code, and nothing that another program registered.
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

# Slow imports of other packages; none of guiderail's registries.
PRELOADED = (
    "pydrake.all", "torch", "stable_baselines3", "sb3_contrib", "gymnasium", "sklearn.mixture", "scipy.stats",
    "scipy.signal", "pandas", "pyarrow.parquet", "pydantic", "typer", "rich.progress", "jinja2", "safetensors.torch",
    "matplotlib.figure", "matplotlib.backends.backend_agg",
)  # fmt: skip


class Forks:
    """Server that runs programs in forks of this process."""

    def __init__(self) -> None:
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
        """Run an interpreter with these arguments, as `subprocess.run`."""
        words = [str(argument) for argument in arguments]
        print(json.dumps({"arguments": words, "folder": str(folder), "environment": environment}), file=self._requests)
        self._requests.flush()
        return subprocess.CompletedProcess(words, **json.loads(self._responses.readline()))

    def close(self) -> None:
        """Stop the server."""
        self._requests.close(), self._responses.close()
        os.waitpid(self._server, 0)


def begin_forkserver() -> None:
    """Start the fork server of multiprocessing as a fork of this process instead of as a new interpreter."""

    def begin(path: bytes, arguments: list[str], kept: list[int]) -> int:
        if number := os.fork():
            return number
        # The server ends with its parent, which alone may hold the other end of this pipe.
        pipe = os.fstat(kept[-1])
        for descriptor in set(range(3, 1024)) - set(kept):
            with contextlib.suppress(OSError):
                if os.path.samestat(os.fstat(descriptor), pipe):
                    os.close(descriptor)
        try:
            exec(arguments[arguments.index("-c") + 1], {})
        finally:  # the server ends with an exception
            os._exit(0)

    resource_tracker.ensure_running()
    original, util.spawnv_passfds = util.spawnv_passfds, begin
    try:
        forkserver.ensure_running()
    finally:
        util.spawnv_passfds = original


def child(arguments: list[str], folder: str, environment: dict[str, str], out: int, err: int) -> None:
    """Run the program in this process; never returns."""
    forkserver._forkserver._forkserver_pid = None  # a child of another process
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
    """Serve requests until the input ends."""
    for line in requests:
        program = json.loads(line)
        with tempfile.TemporaryFile("w+") as out, tempfile.TemporaryFile("w+") as err:
            if (number := os.fork()) == 0:
                child(**program, out=out.fileno(), err=err.fileno())
            returncode = os.waitstatus_to_exitcode(os.waitpid(number, 0)[1])
            out.seek(0), err.seek(0)
            result = {"returncode": returncode, "stdout": out.read(), "stderr": err.read()}
            print(json.dumps(result), file=responses, flush=True)


def main() -> None:
    """Serve the process that started this interpreter."""
    for name in PRELOADED:
        __import__(name)
    print("ready", flush=True)
    serve(sys.stdin, sys.stdout)


if __name__ == "__main__":
    main()
