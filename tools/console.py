"""Console of the package `rich` for progress bars and tables, without escape sequences from outside."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from rich.console import Console, ConsoleOptions, RenderableType
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
