"""Runs commands in forks of one interpreter, which imports what all of them need once.

A line of JSON in, `{"arguments": [...], "folder": ...}` as an interpreter takes them after its name (`-c`, code and
what follows), and one out: `{"returncode": ..., "stdout": ..., "stderr": ...}`. A fork has what any new process has:
its own memory and exit code, and no learner, task or environment that another one made.
"""

import json
import os
import sys
import tempfile
import traceback


def child(arguments: list[str], folder: str, out: int, err: int) -> None:
    """Becomes the command; never returns."""
    os.dup2(out, 1)
    os.dup2(err, 2)
    os.chdir(folder)
    sys.path[0] = ""
    code, sys.argv = arguments[1], ["-c", *arguments[2:]]
    status = 0
    try:
        exec(compile(code, "<string>", "exec"), {"__name__": "__main__"})
    except SystemExit as end:
        status = end.code if isinstance(end.code, int) else int(end.code is not None)
    except BaseException:
        traceback.print_exc()
        status = 1
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)


def main() -> None:
    """Serves until nobody asks any more."""
    # What takes long, and knows nothing of tasks: others' packages, and none of guiderail's registries.
    for name in ("pydrake.all", "torch", "stable_baselines3", "pandas", "scipy.linalg", "matplotlib.figure", "typer"):
        __import__(name)
    print("ready", flush=True)
    for line in sys.stdin:
        asked = json.loads(line)
        with tempfile.TemporaryFile("w+") as out, tempfile.TemporaryFile("w+") as err:
            if (number := os.fork()) == 0:
                child(asked["arguments"], asked["folder"], out.fileno(), err.fileno())
            returncode = os.waitstatus_to_exitcode(os.waitpid(number, 0)[1])
            out.seek(0), err.seek(0)
            print(json.dumps({"returncode": returncode, "stdout": out.read(), "stderr": err.read()}), flush=True)


if __name__ == "__main__":
    main()
