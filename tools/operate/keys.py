"""What a person at the keyboard wants of a moving arm."""

from __future__ import annotations

import gc
import select
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager

PAUSE = "p"


class Keys:
    """Listens without waiting: Enter or Ctrl-C stops the arm, p and Enter pauses it where an episode ends.

    Attributes:
        wants_pause: whether somebody asked for one; who pauses takes it back.
    """

    def __init__(self) -> None:
        self.wants_pause = False
        self._is_stopped = False

    def stops(self) -> bool:
        """Whether somebody wants the arm to stop, since this was last taken back."""
        if not self._is_stopped and sys.stdin.isatty() and select.select([sys.stdin], [], [], 0.0)[0]:
            if sys.stdin.readline().strip().lower() == PAUSE:
                self.wants_pause = True
            else:
                self._is_stopped = True
        return self._is_stopped

    def words(self, *, pauses: bool = False) -> str:
        """What a person is told of them: where nobody can type, Ctrl-C alone; `pauses` where there are episodes."""
        if not sys.stdin.isatty():
            return "Ctrl-C stops the arm"
        return "Enter or Ctrl-C stops the arm" + pauses * ", p and Enter pauses it at the end of an episode"

    def press(self) -> None:
        """As if Enter had been pressed."""
        self._is_stopped = True

    def take_back(self) -> None:
        """Somebody said to go on."""
        self._is_stopped = False


@contextmanager
def listening() -> Iterator[Keys]:
    """Keys, and Ctrl-C as one of them; the second Ctrl-C in a row ends the process."""
    keys = Keys()

    def press(number: int, frame: object) -> None:
        if keys.stops():
            raise KeyboardInterrupt
        keys.press()

    before = signal.signal(signal.SIGINT, press)
    try:
        yield keys
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def no_pauses() -> Iterator[None]:
    """A garbage collection takes longer than a robot waits for a command."""
    gc.collect()
    gc.freeze()
    gc.disable()
    try:
        yield
    finally:
        gc.enable()
        gc.unfreeze()
