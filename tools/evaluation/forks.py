"""Parallel computation of independent results in forks, which inherit everything that this process has imported."""

from __future__ import annotations

import gc
import multiprocessing
import os
import pickle
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from multiprocessing.connection import Connection, wait
from typing import Any, TypeVar

from guiderail.models.common.arrays import as_whole

Result = TypeVar("Result")
_PARENT_CHECKS = 0.2  # period of a fork's checks that its parent is alive [s]


def num_cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def check_processes(processes: int | None) -> int:
    """Return `processes` as an int, or the number of cores for None."""
    return num_cores() if processes is None else as_whole(processes, "the number of processes", 1)


def can_fork() -> bool:
    """Return True if this system has forks and this process may have children."""
    return "fork" in multiprocessing.get_all_start_methods() and not multiprocessing.current_process().daemon


class Forks:
    """Forks of this process, each of which computes one result at a time.

    A fork starts with a copy of the state of this process, and its own changes do not reach this process. A fork exits
    when this process ends, even if this process is killed.
    """

    def __init__(self, compute: Callable[[Any], Any], processes: int):
        """Start `processes` forks that call `compute`, whose arguments and results must support pickling."""
        context = multiprocessing.get_context("fork")
        self._idle: list[Connection] = []
        self._busy: list[Connection] = []
        self._workers = []
        for _ in range(processes):
            parent_end, fork_end = context.Pipe()
            self._idle.append(parent_end)
            arguments = (compute, fork_end, list(self._idle), os.getpid())
            self._workers.append(context.Process(target=_serve, args=arguments, daemon=True))
            self._workers[-1].start()
            fork_end.close()

    @property
    def has_idle(self) -> bool:
        """True if a process waits for an argument."""
        return bool(self._idle)

    def submit(self, argument: Any) -> None:
        """Send `argument` to an idle process; there must be one (`has_idle`).

        Raises:
            KilledError: If the process was killed.
        """
        connection = self._idle.pop(0)
        try:
            connection.send(argument)
        except (BrokenPipeError, ConnectionError):
            raise KilledError from None
        self._busy.append(connection)

    def collect(self, timeout: float | None = None) -> list[Any]:
        """Return the results that are complete, at least one unless the timeout [s] passes.

        At least one process must be computing. An exception of `compute` is raised again, with the traceback of the
        fork as a note. An exception that cannot be pickled is replaced by a RuntimeError.

        Raises:
            KilledError: If a process was killed.
        """
        results = []
        for connection in wait(self._busy, timeout):
            assert isinstance(connection, Connection)
            try:
                result, error, text = pickle.loads(connection.recv_bytes())
            except (EOFError, ConnectionError):
                raise KilledError from None
            if error is not None:
                error.add_note(text)
                raise error
            self._busy.remove(connection)
            self._idle.append(connection)
            results.append(result)
        return results

    def close(self) -> None:
        """End the processes."""
        for worker in self._workers:
            worker.terminate()
        for worker in self._workers:
            worker.join()
        for connection in (*self._idle, *self._busy):
            connection.close()


def forked_map(compute: Callable[[int], Result], count: int, processes: int) -> Iterator[Result]:
    """Yield `compute(0)`, …, `compute(count - 1)` in this order, computed in `Forks` of this process.

    Results must not depend on the order of the calls. They are computed in this process if `processes` or `count` is
    less than 2, or if this process cannot have forks (`can_fork`). An exception of `compute` is raised as by
    `Forks.collect`.

    Raises:
        KilledError: If a process is killed.
    """
    processes = min(processes, count)
    if processes < 2 or not can_fork():
        yield from map(compute, range(count))
        return
    results: dict[int, Result] = {}
    num_submitted, next_index = 0, 0
    with closing(Forks(lambda index: (index, compute(index)), processes)) as forks:
        while next_index < count:
            while forks.has_idle and num_submitted < count:
                forks.submit(num_submitted)
                num_submitted += 1
            results |= dict(forks.collect())
            while next_index in results:
                yield results.pop(next_index)
                next_index += 1


class KilledError(RuntimeError):
    """Error for a fork that was killed."""

    def __init__(self) -> None:
        super().__init__("a process that simulated episodes was killed: give fewer processes, or more memory")


def _serve(
    compute: Callable[[Any], Any], connection: Connection, parent_ends: Sequence[Connection], parent: int
) -> None:
    """Compute and send the result of each received argument, until the other end of the connection is closed."""
    for parent_end in parent_ends:
        parent_end.close()  # otherwise it would stay open after the parent has ended
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # on Ctrl-C the parent ends its forks
    # A fork inherits the parent's file locks, so it must not outlive the parent.
    threading.Thread(target=_exit_with_parent, args=(parent,), daemon=True).start()
    gc.freeze()  # garbage collection would write to, and so copy, the memory shared with the parent
    if "torch" in sys.modules:
        sys.modules["torch"].set_num_threads(1)  # a fork does not have the parent's threads
    while True:
        try:
            argument = connection.recv()
        except EOFError:
            return
        try:
            answer = pickle.dumps((compute(argument), None, ""))
        except (Exception, SystemExit) as error:  # Drake's own assertions arrive as SystemExit
            text = traceback.format_exc()
            try:
                answer = pickle.dumps((None, error, text))
                pickle.loads(answer)
            except Exception:  # not every exception can be pickled; its text is sent instead
                answer = pickle.dumps((None, RuntimeError(f"{type(error).__name__}: {error}"), text))
        connection.send_bytes(answer)


def _exit_with_parent(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(_PARENT_CHECKS)
    os._exit(1)
