"""Jobs on processes of this machine."""

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
from guiderail.tools.experiments.engines.engine import ATTEMPTS, GIVEN_UP, Engine, Outcome, Work, register_engine

PROCESSES = 2


@register_engine("process")
class ProcessEngine(Engine):
    """Processes of this machine; one alone is this one."""

    def __init__(self, processes: int | None = None, address: str | None = None):
        """
        Args:
            processes: side by side.
            address: refused.

        Raises:
            InputError: if an address is given.
        """
        if address is not None:
            raise InputError("--address is of a Ray cluster: give --engine ray too, or leave it out")
        self.processes = PROCESSES if processes is None else processes
        self._workers: list[_Worker] = []

    def run(self, work: Work, jobs: Mapping[int, Any]) -> Iterator[tuple[int, Outcome]]:
        """The jobs' keys and outcomes as they are done."""
        if self.processes == 1:
            yield from ((key, work(job)) for key, job in jobs.items())
            return
        waiting, lost = deque(jobs), Counter[int]()
        while waiting or any(worker.key is not None for worker in self._workers):
            self._hand_out(waiting, work, jobs)
            busy = {worker.connection: worker for worker in self._workers if worker.key is not None}
            for connection in wait(list(busy)):
                worker = busy[cast(Connection, connection)]
                key, outcome = worker.finish()
                if outcome is not None:
                    yield key, outcome
                    continue
                self._workers.remove(worker)
                lost[key] += 1
                if lost[key] == ATTEMPTS:
                    yield key, Outcome(failure=f"{GIVEN_UP}, the last by {worker.end()}")
                else:
                    waiting.append(key)

    def _hand_out(self, waiting: deque[int], work: Work, jobs: Mapping[int, Any]) -> None:
        """Gives each worker that is free the next job, and starts workers as long as there are too few."""
        while waiting:
            worker = next((one for one in self._workers if one.key is None), None)
            if worker is None:
                if len(self._workers) == self.processes:
                    return
                worker = _Worker(work)
                self._workers.append(worker)
            if worker.begin(waiting[0], jobs[waiting[0]]):
                waiting.popleft()
            else:  # it died while it had nothing to do
                self._workers.remove(worker)

    def __exit__(self, *error: object) -> None:
        for worker in self._workers:
            worker.stop()
        self._workers.clear()


class _Worker:
    """A process, and the job that it has."""

    def __init__(self, work: Work):
        # Fresh processes: a forked one would inherit the threads and random generators of this one.
        context = multiprocessing.get_context("spawn")
        self.connection, theirs = context.Pipe()
        self.key: int | None = None
        self._process = context.Process(target=_serve, args=(theirs, work), daemon=True)
        self._process.start()
        theirs.close()  # so that the end of the process is the end of the connection

    def begin(self, key: int, job: Any) -> bool:
        """Gives it a job; False if there is nobody left to take it."""
        try:
            self.connection.send(job)
        except OSError:
            return False
        self.key = key
        return True

    def finish(self) -> tuple[int, Outcome | None]:
        """The job that it had, and what became of it: None if the process ended instead of saying so."""
        assert self.key is not None
        key, self.key = self.key, None
        try:
            return key, self.connection.recv()
        except (EOFError, OSError):
            self._process.join()
            return key, None

    def end(self) -> str:
        """How the process ended."""
        code = self._process.exitcode or 0
        return signal.Signals(-code).name if code < 0 else f"exit code {code}"

    def stop(self) -> None:
        """Ends the process at once: what it has done is on the disk or handed over, and the rest nobody waits for."""
        self._process.kill()
        self._process.join()
        self.connection.close()


def _serve(connection: Connection, work: Work) -> None:
    """What a worker does: one job after another, until nobody is left who gives it any."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all of a terminal's processes; one of them decides
    os.environ["OMP_NUM_THREADS"] = "1"
    threading.Thread(target=_end_with_parent, daemon=True).start()
    while True:
        try:
            job = connection.recv()
        except (EOFError, OSError):
            return
        connection.send(work(job))


def _end_with_parent() -> None:
    """Ends this process when the one that started it is gone, however it went, and whatever is going on here."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)
