"""Progress of a study: running jobs, their episodes, and finished jobs."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from contextlib import suppress
from typing import Any

from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from guiderail.tools.progress import PrintableConsole
from guiderail_studies.engines.engine import Outcome
from guiderail_studies.job import count_attempts

MAX_SHOWN = 20  # largest number of jobs in the table; the others are counted below it
TERMINAL_PERIOD, LOG_PERIOD = 1.0, 60.0  # time between two updates [s]


class StudyProgress:
    """Table of running jobs on a terminal; one line per minute in a log file or a pipe.

    In either case a line is printed for each finished job. Progress is read from the runs' folders, so workers and
    engines need not report it. Use it as a context manager.
    """

    def __init__(self, jobs: Mapping[int, Any], total: int, call: str, console: Console | None = None):
        """Construct the display.

        Args:
            jobs: Jobs to run, by key.
            total: Number of jobs of the study, including those that are done.
            call: Identifier of the attempts of this call in the logs, which other processes may write too.
            console: Console; standard error by default, so that results can be piped.
        """
        self._console = console or PrintableConsole(stderr=True)
        self._call = call
        self._open = {key: (job, job.folder.path / "episodes.csv") for key, job in jobs.items()}
        self._total, self._num_ended, self._num_failed = total, 0, 0
        terminal = self._console.is_terminal
        self._period = TERMINAL_PERIOD if terminal else LOG_PERIOD
        self._live = Live(console=self._console, auto_refresh=False, transient=True) if terminal and jobs else None
        self._is_over = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def __enter__(self) -> StudyProgress:
        if self._live is not None:
            self._live.start()
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._is_over.set()
        self._thread.join()
        if self._live is not None:
            self._live.stop()

    def end(self, key: int, job: Any, outcome: Outcome) -> None:
        """Print the outcome of a job."""
        attempts = count_attempts(job.log, self._call) if key in self._open else 0
        self._open = {k: entry for k, entry in self._open.items() if k != key}  # copy: `_watch` may be iterating
        self._num_ended += 1
        self._num_failed += bool(outcome.failure)
        text = f": failed: {outcome.failure}" if outcome.failure else ""
        if outcome.rows and (last := outcome.rows[-1])["eval_set"]:
            text = f": {last['eval_set']} {last['success_rate']:.0%}"
        retry = f" (by worker {attempts}; the workers before it were lost)" if attempts > 1 else ""
        self._print(f"{self._num_ended}/{self._total} {job.method}, seed {job.seed}{text}{retry}")

    def _print(self, text: str) -> None:
        self._console.print(text, soft_wrap=True, highlight=False, markup=False)

    def _watch(self) -> None:
        while not self._is_over.wait(self._period):
            if self._live is None:
                self._print("; ".join([*map(" ".join, self._running()), self._counts()]))
            else:
                self._live.update(self._table(), refresh=True)

    def _running(self) -> list[tuple[str, str]]:
        """Return the name and the state of each running job."""
        running = []
        for job, table in self._open.values():
            attempts = count_attempts(job.log, self._call)
            if not attempts:
                continue
            done, episodes = 0, job.after_episodes[-1]
            with suppress(OSError):
                done = table.read_bytes().count(b"\n") - 1
            state = f"{done}/{episodes} episodes" if done < episodes else "evaluated"
            retry = f", by worker {attempts}" if attempts > 1 else ""
            running.append((f"{job.method}, seed {job.seed}", state + retry))
        return running

    def _counts(self) -> str:
        num_waiting = len(self._open) - len(self._running())
        failed = f", {self._num_failed} failed" if self._num_failed else ""
        return f"{self._num_ended} of {self._total} ended{failed}, {num_waiting} waiting"

    def _table(self) -> Group:
        table = Table("run", "state", box=None, pad_edge=False)
        running = self._running()
        for name, state in running[:MAX_SHOWN]:
            table.add_row(name, state)
        more = f"and {len(running) - MAX_SHOWN} more running; " if len(running) > MAX_SHOWN else ""
        return Group(*([table] if running else []), Text(more + self._counts()))
