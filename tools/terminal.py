r"""Output on a terminal without escape sequences from outside.

Names of folders, versions of packages, texts of files and messages of exceptions may contain control characters, with
which a terminal changes colors, titles or earlier lines, or runs commands. They are printed as `\x1b`.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterable
from typing import Any

# Control characters except tab and newline, line separators, and marks that change the direction of text
_CONTROLS = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u2028\u2029\u202a-\u202e\u2066-\u2069]")


def printable(text: str) -> str:
    r"""Return a text with its control characters, except tab and newline, replaced by their escapes, such as `\x1b`."""
    return _CONTROLS.sub(lambda match: match[0].encode("unicode_escape").decode(), text)


class PrintableStream:
    """Text stream that writes `printable` text to another stream, `inner`, and has its other attributes."""

    def __init__(self, inner: Any):
        """Construct the stream."""
        self.inner = inner

    def __getattr__(self, name: str) -> Any:
        """Return an attribute of the other stream."""
        return getattr(self.inner, name)

    def write(self, text: str) -> int:
        """Write a text; return its length."""
        self.inner.write(printable(text))
        return len(text)

    def writelines(self, lines: Iterable[str]) -> None:
        """Write texts."""
        for line in lines:
            self.write(line)


def protect_terminal() -> None:
    """Make standard output and standard error of this process write printable text."""
    for name in ("stdout", "stderr"):
        if not isinstance(stream := getattr(sys, name), PrintableStream):
            setattr(sys, name, PrintableStream(stream))
