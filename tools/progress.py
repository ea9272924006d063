"""Progress bar of many episodes, and a console of the package `rich` without escape sequences from outside."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from rich.console import Console, ConsoleOptions, RenderableType
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.segment import Segment

from guiderail.tools.terminal import printable


class PrintableConsole(Console):
    """Console whose texts are printable; its own colors and bars remain."""

    @property
    def file(self) -> Any:
        """Stream of the console, without the filter of `PrintableStream`."""
        return getattr(stream := super().file, "inner", stream)

    @file.setter
    def file(self, new_file: Any) -> None:
        self._file = new_file

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        """Return the segments of a renderable object with printable text."""
        for text, style, control in super().render(renderable, options):
            yield Segment(text if control else printable(text), style, control)


WINDOW = 10  # default number of last episodes over which success and return are averaged
INTERVAL = 10.0  # time between lines if standard error is not a terminal [s]


class EpisodeProgress:
    """Progress bar on a terminal; elsewhere, in a log file or a pipe, lines with the same content.

    It is a context manager; call `update` with the row of each episode.
    """

    def __init__(
        self,
        episodes: int,
        *,
        name: str = "training",
        window: int | None = WINDOW,
        console: Console | None = None,
        asks: bool = False,
    ):
        """Construct the progress.

        Args:
            episodes: Number of episodes of the whole run, including those before it was resumed.
            name: Name of the bar.
            window: Number of last episodes over which success and return are averaged; None for all episodes.
            console: Console; standard error by default, so that results can be piped.
            asks: True if the program asks questions while the bar is shown. The bar is then redrawn only after
                episodes, so that it covers no question.
        """
        self._console = console or PrintableConsole(stderr=True)
        self._episodes, self._name = episodes, name
        self._done, self._count, self._window = 0, 0, window
        self._recent: deque[tuple[float, float]] = deque(maxlen=window)
        self._max_violation = float("-inf")
        self._reports_success = False
        self._started = self._printed = time.monotonic()
        self._bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(bar_width=24),
            MofNCompleteColumn(),
            TextColumn("{task.fields[status]}"),
            TimeRemainingColumn(compact=True, elapsed_when_finished=True),
            console=self._console,
            auto_refresh=not asks,
            disable=not self._console.is_terminal,
        )
        self._task = self._bar.add_task(name, total=episodes, status="")

    def __enter__(self) -> EpisodeProgress:
        self._bar.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._bar.stop()

    def update(self, row: Mapping[str, Any]) -> None:
        """Add a finished episode, given its row."""
        from guiderail.tools.evaluation.metrics import REPORTS_SUCCESS  # imports pandas, which takes a second

        self._done, self._count = int(row["episode"]) + 1, self._count + 1
        self._recent.append((float(row["success"]), float(row["return"])))
        self._reports_success |= bool(row.get(REPORTS_SUCCESS, True))
        violation = float(row.get("max_commanded_violation", -math.inf))
        self._max_violation = float(np.maximum(self._max_violation, violation))  # NaN if any violation is NaN
        self._bar.update(self._task, completed=self._done, status=self.status(), refresh=True)
        now = time.monotonic()
        is_due = self._count == 1 or self._done == self._episodes or now - self._printed > INTERVAL
        if self._bar.disable and is_due:
            self._printed = now
            text = f"{self._name} {self._done}/{self._episodes}  {self.status()}  {self._remaining(now)}"
            self._console.print(text, soft_wrap=True)

    def status(self) -> str:
        """Return success rate and mean return of the last episodes, and the largest violation of all, as text.

        At least one `update` must precede the call. The success rate is left out if the environment reports no success.
        """
        from guiderail.tools.evaluation.metrics import violation_text  # imports pandas, which takes a second

        success, returns = (sum(values) / len(self._recent) for values in zip(*self._recent, strict=True))
        prefix = "" if self._window is None else f"last {len(self._recent)}: "
        prefix += f"success {success:.0%}  " if self._reports_success else ""
        return f"{prefix}return {returns:.1f}  largest violation {violation_text(self._max_violation)}"

    def _remaining(self, now: float) -> str:
        if self._done == self._episodes:
            return f"done in {now - self._started:.0f} s"
        return f"{(now - self._started) / self._count * (self._episodes - self._done):.0f} s left"
