"""What a person sees while episodes go on: success, return, worst violation and the time left."""

import time
from collections.abc import Mapping
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from guiderail.tools.evaluation.metrics import TOLERANCE

WINDOW = 10  # episodes of training that success and return are averaged over


class EpisodeProgress:
    """A bar on a terminal; elsewhere, in a log file or a pipe, a line now and then that says the same.

    Use it as a context and call `update` with each episode's row.
    """

    def __init__(
        self, episodes: int, *, name: str = "training", window: int | None = WINDOW, console: Console | None = None
    ):
        """
        Args:
            episodes: of the whole run; a run that goes on starts further along.
            name: what the bar is called.
            window: how many of the last episodes success and return are averaged over; all of them for None.
            console: where it is drawn; standard error by default, so that results can be piped.
        """
        self._console = console or Console(stderr=True)
        self._episodes, self._name = episodes, name
        self._done, self._seen, self._window = 0, 0, window
        self._recent: list[tuple[float, float]] = []
        self._worst = float("-inf")
        self._started = self._said = time.monotonic()
        self._bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(bar_width=24),
            MofNCompleteColumn(),
            TextColumn("{task.fields[said]}"),
            TimeRemainingColumn(compact=True, elapsed_when_finished=True),
            console=self._console,
            disable=not self._console.is_terminal,
        )
        self._task = self._bar.add_task(name, total=episodes, said="")

    def __enter__(self) -> "EpisodeProgress":
        self._bar.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._bar.stop()

    def update(self, row: Mapping[str, Any]) -> None:
        """Takes one finished episode in."""
        self._done, self._seen = int(row["episode"]) + 1, self._seen + 1
        self._recent = [*self._recent, (float(row["success"]), float(row["return"]))]
        if self._window is not None:
            self._recent = self._recent[-self._window :]
        self._worst = max(self._worst, float(row["max_commanded_violation"]))
        self._bar.update(self._task, completed=self._done, said=self.says())
        now = time.monotonic()
        due = self._seen == 1 or self._done == self._episodes or now - self._said > 10
        if self._bar.disable and due:
            self._said = now
            self._console.print(
                f"{self._name} {self._done}/{self._episodes}  {self.says()}  {self._left(now)}", soft_wrap=True
            )

    def says(self) -> str:
        """Success and return of the last episodes, how many they are, and the worst violation of all that were seen."""
        success, returns = (sum(values) / len(self._recent) for values in zip(*self._recent, strict=True))
        worst = "none" if self._worst <= TOLERANCE else f"{self._worst:.1e}"
        of_last = "" if self._window is None else f"last {len(self._recent)}: "
        return f"{of_last}success {success:.0%}  return {returns:.1f}  worst violation {worst}"

    def _left(self, now: float) -> str:
        if self._done == self._episodes:
            return f"done in {now - self._started:.0f} s"
        return f"{(now - self._started) / self._seen * (self._episodes - self._done):.0f} s left"
