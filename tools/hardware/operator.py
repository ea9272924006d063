"""Input of the operator at the robot: keys that stop and pause the arm, and confirmation of a question."""

from __future__ import annotations

import select
import signal
import sys
import termios
from collections.abc import Iterator
from contextlib import contextmanager

from guiderail.models.common.errors import InputError

PAUSE_KEY = "p"


class OperatorKeys:
    """Non-blocking keys: Enter or Ctrl-C stops the arm, p and Enter pauses it at the end of an episode.

    Attributes:
        is_pause_requested: True if a pause was requested; reset by the program that pauses.
    """

    def __init__(self) -> None:
        self.is_pause_requested = False
        self._is_stop_requested = False

    def is_stop_requested(self) -> bool:
        """Return True if a stop has been requested since the last `clear_stop`."""
        if not self._is_stop_requested and sys.stdin.isatty() and select.select([sys.stdin], [], [], 0.0)[0]:
            if sys.stdin.readline().strip().lower() == PAUSE_KEY:
                self.is_pause_requested = True
            else:
                self._is_stop_requested = True
        return self._is_stop_requested

    def describe(self, *, has_pauses: bool = False) -> str:
        """Return a description of the keys, with the pause key if `has_pauses`.

        Without a terminal, only Ctrl-C works.
        """
        if not sys.stdin.isatty():
            return "Ctrl-C stops the arm"
        return "Enter or Ctrl-C stops the arm" + has_pauses * ", p and Enter pauses it at the end of an episode"

    def request_stop(self) -> None:
        """Request a stop, as Enter does."""
        self._is_stop_requested = True

    def clear_stop(self) -> None:
        """Clear a pending stop request."""
        self._is_stop_requested = False


@contextmanager
def operator_keys() -> Iterator[OperatorKeys]:
    """Yield the operator's keys; Ctrl-C requests a stop, or raises KeyboardInterrupt if one is already requested."""
    keys = OperatorKeys()

    def handle(number: int, frame: object) -> None:
        if keys.is_stop_requested():
            raise KeyboardInterrupt
        keys.request_stop()

    before = signal.signal(signal.SIGINT, handle)
    try:
        yield keys
    finally:
        signal.signal(signal.SIGINT, before)


def confirm(question: str) -> None:
    """Ask the operator at the terminal to confirm; input typed before the question is discarded.

    Raises:
        InputError: If the answer is not yes, Ctrl-C is pressed, or there is no terminal.
    """
    if not sys.stdin.isatty():
        raise InputError("this has to be confirmed at a terminal, or by --yes of a caller who has checked it")
    termios.tcflush(sys.stdin, termios.TCIFLUSH)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # nothing moves, so Ctrl-C only ends the question
    try:
        answer = input(f"{question} Type yes: ")
    except (EOFError, KeyboardInterrupt):
        answer = ""
    finally:
        signal.signal(signal.SIGINT, before)
    if answer.strip().lower() != "yes":
        raise InputError("not confirmed: nothing moves")
