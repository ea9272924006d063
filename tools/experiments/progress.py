"""What a person sees while a study goes on: what runs, how far it is, and what has ended."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from typing import Any

from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from guiderail.tools.experiments.engines.engine import Outcome
from guiderail.tools.experiments.worker import attempts

SHOWN = 20  # jobs in the table; the others are counted
TERMINAL_PERIOD, LOG_PERIOD = 1.0, 60.0  # s


class Board:
    """On a terminal a table of what is going on; elsewhere, in a log file or a pipe, a line a minute that says it.

    Either gets a line for each job that ends. All of it is read from the folders of the runs: it costs the workers
    nothing, and no engine has to report anything. Use it as a context.
    """

    def __init__(self, jobs: Mapping[int, Any], total: int, console: Console | None = None):
        """
        Args:
            jobs: that are to be run, by their keys.
            total: of the whole study; those that are not among `jobs` were finished before, and end too.
            console: where it is drawn; standard error by default, so that results can be piped.
        """
        self._console = console or Console(stderr=True)
        self._open = {
            key: (job, job.folder.path / "episodes.csv", job.log.stat().st_size if job.log.exists() else 0)
            for key, job in jobs.items()
        }
        self._total, self._ended, self._failed = total, 0, 0
        terminal = self._console.is_terminal
        self._period = TERMINAL_PERIOD if terminal else LOG_PERIOD
        self._live = Live(console=self._console, auto_refresh=False, transient=True) if terminal and jobs else None
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def __enter__(self) -> Board:
        if self._live is not None:
            self._live.start()
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._over.set()
        self._thread.join()
        if self._live is not None:
            self._live.stop()

    def end(self, key: int, job: Any, outcome: Outcome) -> None:
        """Says what became of a job."""
        before = self._open.get(key)
        workers = attempts(job.log, before[2]) if before is not None else 0
        self._open = {other: one for other, one in self._open.items() if other != key}
        self._ended += 1
        self._failed += bool(outcome.failure)
        words = "".join(
            f": {row['eval_set']} {row['success_rate']:.0%}" for row in outcome.rows[-1:] if row["eval_set"]
        )
        words = f": failed: {outcome.failure}" if outcome.failure else words
        again = f" (by worker {workers}, those before it were lost)" if workers > 1 else ""
        self._say(f"{self._ended}/{self._total} {job.method}, seed {job.seed}{words}{again}")

    def _say(self, words: str) -> None:
        self._console.print(words, soft_wrap=True, highlight=False, markup=False)

    def _watch(self) -> None:
        while not self._over.wait(self._period):
            if self._live is None:
                self._say("; ".join([*map(" ".join, self._running()), self._counts()]))
            else:
                self._live.update(self._table(), refresh=True)

    def _running(self) -> list[tuple[str, str]]:
        """What runs, and how far it is."""
        found = []
        for job, table, known in self._open.values():
            workers = attempts(job.log, known)
            if not workers:
                continue
            again = f", by worker {workers}" if workers > 1 else ""
            found.append((f"{job.method}, seed {job.seed}", self._state(job, table) + again))
        return found

    @staticmethod
    def _state(job: Any, table: Any) -> str:
        episodes = job.after_episodes[-1]
        try:
            done = table.read_bytes().count(b"\n") - 1
        except OSError:
            done = 0
        return f"{done}/{episodes} episodes" if done < episodes else "judged"

    def _counts(self) -> str:
        waiting = len(self._open) - len(self._running())
        failed = f", {self._failed} failed" if self._failed else ""
        return f"{self._ended} of {self._total} ended{failed}, {waiting} wait"

    def _table(self) -> Group:
        table = Table("run", "is at", box=None, pad_edge=False)
        running = self._running()
        for name, state in running[:SHOWN]:
            table.add_row(name, state)
        more = f"and {len(running) - SHOWN} more run; " if len(running) > SHOWN else ""
        counts = Text(more + self._counts())
        return Group(table, counts) if running else Group(counts)
