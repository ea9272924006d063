"""Computation of independent results in forks of this process, which has imported and built everything already."""

from __future__ import annotations

import gc
import multiprocessing
import os
import pickle
import signal
import sys
import traceback
from collections.abc import Callable, Iterator, Sequence
from multiprocessing.connection import Connection, wait
from typing import Any, TypeVar

from guiderail.models.common.errors import InputError

Result = TypeVar("Result")


def num_cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def check_processes(processes: int | None) -> int:
    """Return a number of processes; that of the cores for None.

    Raises:
        InputError: If it is less than 1.
    """
    if processes is None:
        return num_cores()
    if processes < 1:
        raise InputError(f"an evaluation needs at least one process, not {processes}")
    return processes


def forked_map(compute: Callable[[int], Result], count: int, processes: int) -> Iterator[Result]:
    """Yield `compute(0)`, …, `compute(count - 1)` in this order, computed in forks of this process.

    A fork starts with the state of this process, and changes of its state are lost: results must not depend on the
    order of the calls. They are computed in this process if one process is enough, or if the system cannot fork.

    Args:
        compute: Returns a result that can be pickled.
        count: Number of results.
        processes: Largest number of processes.

    Raises:
        RuntimeError: If a process is killed. An exception of `compute` is raised as it is.
    """
    processes = min(processes, count)
    can_fork = "fork" in multiprocessing.get_all_start_methods() and not multiprocessing.current_process().daemon
    if processes < 2 or not can_fork:
        yield from map(compute, range(count))
        return
    context = multiprocessing.get_context("fork")
    connections: list[Connection] = []
    workers = []
    results: dict[int, Any] = {}
    assigned, given = 0, 0
    try:
        for _ in range(processes):
            here, there = context.Pipe()
            connections.append(here)
            workers.append(context.Process(target=_serve, args=(compute, there, connections), daemon=True))
            workers[-1].start()
            there.close()
            here.send(assigned)
            assigned += 1
        while given < count:
            for connection in wait(connections):
                assert isinstance(connection, Connection)
                index, result = _receive(connection)
                results[index] = result
                if assigned < count:
                    connection.send(assigned)
                    assigned += 1
            while given in results:
                yield results.pop(given)
                given += 1
    finally:
        for worker in workers:
            worker.terminate()
        for worker, connection in zip(workers, connections, strict=False):
            worker.join()
            connection.close()


def _receive(connection: Connection) -> tuple[int, Any]:
    try:
        index, result, error, text = pickle.loads(connection.recv_bytes())
    except (EOFError, ConnectionError):
        raise RuntimeError("a process that evaluated episodes was killed: give a smaller --processes") from None
    if error is not None:
        error.add_note(text)
        raise error
    return index, result


def _serve(compute: Callable[[int], Any], connection: Connection, others: Sequence[Connection]) -> None:
    """Answer each index with its result until the other end is closed."""
    for one in others:
        one.close()  # ends of the parent, which would keep this process alive after it
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends its processes
    gc.freeze()  # a collection would visit, and so copy, everything that the parent has built
    if "torch" in sys.modules:
        sys.modules["torch"].set_num_threads(1)  # threads of the parent do not exist here
    while True:
        try:
            index = connection.recv()
        except EOFError:
            return
        try:
            answer = pickle.dumps((index, compute(index), None, ""))
        except Exception as error:
            text = traceback.format_exc()
            try:
                answer = pickle.dumps((index, None, error, text))
                pickle.loads(answer)
            except Exception:
                answer = pickle.dumps((index, None, RuntimeError(f"{type(error).__name__}: {error}"), text))
        connection.send_bytes(answer)
