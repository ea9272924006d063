import gc
import io
import os
import pty
import signal
import sys

import pytest

from guiderail.tools.teleop.teleoperator import Keys, listening, no_pauses


@pytest.fixture
def terminal(monkeypatch):
    """What a person types."""
    keyboard, screen = pty.openpty()
    with os.fdopen(screen, "r") as stdin:
        monkeypatch.setattr(sys, "stdin", stdin)
        yield lambda words: os.write(keyboard, words)
    os.close(keyboard)


def test_enter_stops_and_p_pauses(terminal):
    keys = Keys()
    assert not keys.stops()
    terminal(b"p\n")
    assert (keys.stops(), keys.wants_pause) == (False, True)
    terminal(b"\n")
    assert keys.stops()
    assert keys.stops()
    keys.take_back()
    assert not keys.stops()


def test_a_person_is_told_of_the_keys_that_there_are(terminal, monkeypatch):
    assert Keys().words() == "Enter or Ctrl-C stops the arm"
    assert "p and Enter pauses" in Keys().words(pauses=True)
    monkeypatch.setattr(sys, "stdin", io.StringIO("\n"))  # a pipe: what comes through it stops nothing
    keys = Keys()
    assert not keys.stops()
    assert keys.words(pauses=True) == "Ctrl-C stops the arm"


def test_control_c_stops_the_arm_and_again_the_process():
    before = signal.getsignal(signal.SIGINT)
    with listening() as keys:
        signal.raise_signal(signal.SIGINT)
        assert keys.stops()
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is before


def test_nothing_is_collected_while_a_robot_waits():
    with no_pauses():
        assert not gc.isenabled()
    assert gc.isenabled()
