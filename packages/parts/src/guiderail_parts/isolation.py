"""Execution of a function in a process of its own, because compiled libraries may abort or never return."""

from __future__ import annotations

import math
import multiprocessing
import os
import resource
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

_WALL_FACTOR, _WALL_SLACK = 6.0, 20.0  # limit of wall time: multiple of the limit of CPU time, plus a constant [s]


class IsolatedError(Exception):
    """Exception, abort, kill or exceeded limit of an isolated function; the message gives the reason."""


def run_isolated(function: Callable[..., Any], *arguments: Any, cpu_seconds: int, max_bytes: int | None = None) -> Any:
    """Return `function(*arguments)`, computed in a forked process; the result is pickled.

    Args:
        function: Function; it need not be importable, because the child process is a copy of the calling process.
        arguments: Arguments of the function, which are not pickled.
        cpu_seconds: Limit of the function's CPU time [s].
        max_bytes: Limit of the memory that the function allocates [bytes]; no limit by default.

    Raises:
        IsolatedError: If the function raised, its result cannot be pickled, or its process aborted, was killed or
            exceeded a limit.
    """
    context = multiprocessing.get_context("fork")
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_run_child, args=(sender, function, arguments, cpu_seconds, max_bytes))
    seconds_before = _children_seconds()
    process.start()
    sender.close()
    try:
        if not receiver.poll(_WALL_FACTOR * cpu_seconds + _WALL_SLACK):
            raise IsolatedError(f"it took more than {cpu_seconds} s")
        is_result, value = receiver.recv()
    except EOFError:
        process.join()
        # If a library ignores SIGXCPU, the kernel sends SIGKILL, as it does if the machine's memory is exhausted.
        is_killed = process.exitcode == -signal.SIGKILL
        is_late = is_killed and _children_seconds() - seconds_before > cpu_seconds
        if process.exitcode == -signal.SIGXCPU or is_late:
            raise IsolatedError(f"it took more than {cpu_seconds} s of CPU time") from None
        if is_killed:
            raise IsolatedError("its process was killed, maybe for lack of memory") from None
        raise IsolatedError(f"the library aborted (exit status {process.exitcode})") from None
    finally:
        process.kill()
        process.join()
        receiver.close()
    if not is_result:
        raise IsolatedError(value)
    return value


def _children_seconds() -> float:
    """Return the CPU time of all finished child processes [s]."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def _set_limit(kind: int, soft: int, hard: int) -> None:
    """Set a limit of this process, at most the current hard limit, which only root may raise."""
    current = resource.getrlimit(kind)[1]
    largest = math.inf if current == resource.RLIM_INFINITY else current
    resource.setrlimit(kind, (int(min(soft, largest)), int(min(hard, largest))))


def _run_child(
    sender: Any, function: Callable[..., Any], arguments: tuple[Any, ...], cpu_seconds: int, max_bytes: int | None
) -> None:
    """Set the limits of the child process, and send (True, result) or (False, reason of the failure)."""
    used_seconds = int(sum(os.times()[:2])) + 1
    _set_limit(resource.RLIMIT_CPU, used_seconds + cpu_seconds, used_seconds + cpu_seconds + 1)
    _set_limit(resource.RLIMIT_CORE, 0, 0)
    if max_bytes is not None:
        pages = int(Path("/proc/self/statm").read_text().split()[0])  # address space inherited from the parent
        size = pages * resource.getpagesize() + max_bytes
        _set_limit(resource.RLIMIT_AS, size, size)
    devnull = os.open(os.devnull, os.O_WRONLY)
    os.dup2(devnull, 1)  # compiled libraries print progress and reasons of aborts
    os.dup2(devnull, 2)
    try:
        sender.send((True, function(*arguments)))
    except MemoryError:
        sender.send((False, "it needs too much memory"))
    except BaseException as error:
        sender.send((False, f"{type(error).__name__}: {error}"))
    finally:
        sender.close()
        os._exit(0)
