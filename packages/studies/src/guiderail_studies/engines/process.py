"""Engine that runs jobs in processes of this machine."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections import Counter, deque
from collections.abc import Iterator, Mapping
from multiprocessing.connection import Connection, wait
from typing import Any, cast

from guiderail.models.common.errors import InputError
from guiderail_studies.engines.engine import GIVEN_UP, MAX_ATTEMPTS, Engine, Outcome, Work, register_engine

DEFAULT_PROCESSES = 2


@register_engine("process")
class ProcessEngine(Engine):
    """Engine of processes on this machine; with one process, jobs run in the current process."""

    def __init__(self, processes: int | None = None, address: str | None = None):
        """Construct the engine with a number of processes, 2 by default; raise an InputError if `address` is given."""
        if address is not None:
            raise InputError("--address is that of a Ray cluster: give --engine ray too, or leave it out")
        self.processes = DEFAULT_PROCESSES if processes is None else processes
        self._workers: list[_Worker] = []

    def run(self, work: Work, jobs: Mapping[int, Any]) -> Iterator[tuple[int, Outcome]]:
        """Yield keys and outcomes of the jobs as they finish."""
        if self.processes == 1:
            yield from ((key, work(job)) for key, job in jobs.items())
            return
        waiting, num_lost = deque(jobs), Counter[int]()
        while waiting or any(worker.key is not None for worker in self._workers):
            self._assign(waiting, work, jobs)
            busy = {worker.connection: worker for worker in self._workers if worker.key is not None}
            for connection in wait(list(busy)):
                worker = busy[cast(Connection, connection)]
                key, outcome = worker.finish()
                if outcome is not None:
                    yield key, outcome
                    continue
                self._workers.remove(worker)
                num_lost[key] += 1
                if num_lost[key] == MAX_ATTEMPTS:
                    yield key, Outcome(failure=f"{GIVEN_UP}, the last by {worker.end()}")
                else:
                    waiting.append(key)

    def _assign(self, waiting: deque[int], work: Work, jobs: Mapping[int, Any]) -> None:
        """Assign waiting jobs to free workers; start workers until there are `processes` of them."""
        while waiting:
            worker = next((worker for worker in self._workers if worker.key is None), None)
            if worker is None:
                if len(self._workers) == self.processes:
                    return
                worker = _Worker(work)
                self._workers.append(worker)
            if worker.begin(waiting[0], jobs[waiting[0]]):
                waiting.popleft()
            else:  # the worker died while idle
                self._workers.remove(worker)

    def __exit__(self, *error: object) -> None:
        for worker in self._workers:
            worker.stop()
        self._workers.clear()


class _Worker:
    """Worker process with its current job."""

    def __init__(self, work: Work):
        # A fork would copy the random generators of this process, and locks that its other threads hold.
        context = multiprocessing.get_context("spawn")
        self.connection, child_connection = context.Pipe()
        self.key: int | None = None
        self._process = context.Process(target=_serve, args=(child_connection, work), daemon=True)
        self._process.start()
        child_connection.close()  # otherwise the connection would stay open after the process ends

    def begin(self, key: int, job: Any) -> bool:
        """Send a job; return False if the process has ended."""
        try:
            self.connection.send(job)
        except OSError:
            return False
        self.key = key
        return True

    def finish(self) -> tuple[int, Outcome | None]:
        """Return the job's key and its outcome; the outcome is None if the process ended before the job was done."""
        assert self.key is not None
        key, self.key = self.key, None
        try:
            return key, self.connection.recv()
        except (EOFError, OSError):
            self._process.join()
            return key, None

    def end(self) -> str:
        """Return the signal or exit code that the process ended with."""
        code = self._process.exitcode or 0
        return signal.Signals(-code).name if code < 0 else f"exit code {code}"

    def stop(self) -> None:
        """Kill the process, whose results are on disk or already received."""
        self._process.kill()
        self._process.join()
        self.connection.close()


def _serve(connection: Connection, work: Work) -> None:
    """Run the jobs that arrive until the connection is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all processes of a terminal; the parent handles it
    os.environ["OMP_NUM_THREADS"] = "1"
    threading.Thread(target=_end_with_parent, daemon=True).start()
    while True:
        try:
            job = connection.recv()
        except (EOFError, OSError):
            return
        connection.send(work(job))


def _end_with_parent() -> None:
    """End this process when its parent has ended, even if the parent was killed."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)
