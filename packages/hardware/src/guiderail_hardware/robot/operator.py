"""Input of the operator at the robot: keys that stop and pause the arm, and confirmation of a question."""

from __future__ import annotations

import select
import signal
import sys
import termios
import time
from collections.abc import Iterator
from contextlib import contextmanager

from guiderail.models.common.errors import InputError

PAUSE_KEY = "p"
STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
HANGING_TIME = 5.0  # a signal raises KeyboardInterrupt if no control step read a stop request for this long [s]


def is_terminal() -> bool:
    """Return True if standard input is a terminal, and not a pipe or closed."""
    return sys.stdin is not None and sys.stdin.isatty()


class OperatorKeys:
    """Non-blocking keys: Enter or Ctrl-C stops the arm, p and Enter pauses it at the end of an episode.

    Attributes:
        is_pause_requested: True if a pause was requested; the caller resets it when it pauses.
        is_moving: True as soon as the arm may move; until then, a signal ends the program at once.
        must_end: True after SIGTERM or SIGHUP: the arm must not resume after the stop.
    """

    def __init__(self) -> None:
        self.is_pause_requested = self.is_moving = self.must_end = False
        self._is_stop_requested = self._is_noticed = False
        self._requested_at = 0.0

    def is_stop_requested(self) -> bool:
        """Return True if a stop has been requested since the last `clear_stop`."""
        if not self._is_stop_requested and is_terminal() and select.select([sys.stdin], [], [], 0.0)[0]:
            if sys.stdin.readline().strip().lower() == PAUSE_KEY:
                self.is_pause_requested = True
            else:
                self._is_stop_requested = True
        self._is_noticed = self._is_stop_requested
        return self._is_stop_requested

    def describe(self, *, has_pauses: bool = False) -> str:
        """Return a description of the keys, with the pause key if `has_pauses`.

        Without a terminal, only Ctrl-C works.
        """
        if not is_terminal():
            return "Ctrl-C stops the arm"
        return "Enter or Ctrl-C stops the arm" + has_pauses * ", p and Enter pauses it at the end of an episode"

    def request_stop(self) -> None:
        """Request a stop, as Enter does."""
        if not self._is_stop_requested:
            self._is_stop_requested, self._requested_at = True, time.monotonic()

    def clear_stop(self) -> None:
        """Clear a pending stop request."""
        self._is_stop_requested = self._is_noticed = False

    def handle_signal(self, number: int, frame: object = None) -> None:
        """Request a stop because of Ctrl-C, SIGTERM or SIGHUP.

        A second signal does not interrupt the orderly stop.

        Raises:
            InputError: If the arm does not move yet.
            KeyboardInterrupt: If no control step has read an earlier request for `HANGING_TIME`.
        """
        if not self.is_moving:
            raise InputError("stopped: nothing moved")
        self.must_end |= number != signal.SIGINT
        is_waiting = self._is_stop_requested and not self._is_noticed
        if is_waiting and time.monotonic() - self._requested_at > HANGING_TIME:
            raise KeyboardInterrupt
        self.request_stop()


@contextmanager
def operator_keys() -> Iterator[OperatorKeys]:
    """Yield the operator's keys; Ctrl-C, SIGTERM and SIGHUP request a stop."""
    keys = OperatorKeys()
    # A program started by nohup keeps ignoring SIGHUP.
    numbers = [each for each in STOP_SIGNALS if each == signal.SIGINT or signal.getsignal(each) != signal.SIG_IGN]
    before = {number: signal.signal(number, keys.handle_signal) for number in numbers}
    try:
        yield keys
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def confirm(question: str, *, has_yes: bool = True) -> None:
    """Ask the operator at the terminal to confirm; input typed before the question is discarded.

    Args:
        question: The question.
        has_yes: True if the option --yes answers this question.

    Raises:
        InputError: If the answer is not yes, Ctrl-C is pressed, a signal arrives, or there is no terminal.
    """
    if not is_terminal():
        by_option = ", or by --yes after it was checked" * has_yes
        raise InputError(f"this has to be confirmed at a terminal{by_option}")
    # The arm does not move, so a signal only ends the question.
    before = {number: signal.signal(number, signal.default_int_handler) for number in STOP_SIGNALS}
    try:
        termios.tcflush(sys.stdin, termios.TCIFLUSH)
        answer = input(f"{question} Type yes: ")
    except (EOFError, KeyboardInterrupt, OSError, termios.error):  # SIGHUP closes the terminal
        answer = ""
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    if answer.strip().lower() != "yes":
        raise InputError("not confirmed: nothing moves")
