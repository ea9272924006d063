"""Progress of episodes on standard error: success, return, largest violation and remaining time."""

import math
import time
from collections.abc import Mapping
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from guiderail.tools.evaluation.metrics import TOLERANCE, VIOLATION

WINDOW = 10  # training episodes that success and return are averaged over
INTERVAL = 10.0  # time between lines where standard error is not a terminal [s]


class EpisodeProgress:
    """Progress bar on a terminal; elsewhere, in a log file or a pipe, lines with the same content.

    It is a context manager; call `update` with the row of each episode.
    """

    def __init__(
        self, episodes: int, *, name: str = "training", window: int | None = WINDOW, console: Console | None = None
    ):
        """Construct the progress.

        Args:
            episodes: Number of episodes of the whole run; a resumed run starts further along.
            name: Name of the bar.
            window: Number of last episodes that success and return are averaged over; None for all of them.
            console: Console; standard error by default, so that results can be piped.
        """
        self._console = console or Console(stderr=True)
        self._episodes, self._name = episodes, name
        self._done, self._count, self._window = 0, 0, window
        self._recent: list[tuple[float, float]] = []
        self._max_violation = float("-inf")
        self._started = self._printed = time.monotonic()
        self._bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(bar_width=24),
            MofNCompleteColumn(),
            TextColumn("{task.fields[status]}"),
            TimeRemainingColumn(compact=True, elapsed_when_finished=True),
            console=self._console,
            disable=not self._console.is_terminal,
        )
        self._task = self._bar.add_task(name, total=episodes, status="")

    def __enter__(self) -> "EpisodeProgress":
        self._bar.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._bar.stop()

    def update(self, row: Mapping[str, Any]) -> None:
        """Add a finished episode."""
        self._done, self._count = int(row["episode"]) + 1, self._count + 1
        self._recent = [*self._recent, (float(row["success"]), float(row["return"]))]
        if self._window is not None:
            self._recent = self._recent[-self._window :]
        self._max_violation = max(self._max_violation, float(row.get("max_commanded_violation", -math.inf)))
        self._bar.update(self._task, completed=self._done, status=self.status())
        now = time.monotonic()
        is_due = self._count == 1 or self._done == self._episodes or now - self._printed > INTERVAL
        if self._bar.disable and is_due:
            self._printed = now
            text = f"{self._name} {self._done}/{self._episodes}  {self.status()}  {self._remaining(now)}"
            self._console.print(text, soft_wrap=True)

    def status(self) -> str:
        """Return success and return of the last episodes, and the largest constraint violation of all."""
        success, returns = (sum(values) / len(self._recent) for values in zip(*self._recent, strict=True))
        violation = "none" if self._max_violation <= TOLERANCE else f"{self._max_violation:.1e} {VIOLATION}"
        prefix = "" if self._window is None else f"last {len(self._recent)}: "
        return f"{prefix}success {success:.0%}  return {returns:.1f}  largest violation {violation}"

    def _remaining(self, now: float) -> str:
        if self._done == self._episodes:
            return f"done in {now - self._started:.0f} s"
        return f"{(now - self._started) / self._count * (self._episodes - self._done):.0f} s left"
