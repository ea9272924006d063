"""Keys, signals and questions by which an operator stops, pauses and confirms motions."""

import gc
import io
import os
import pty
import signal
import sys
from unittest.mock import Mock

import pytest

from guiderail.models.common.errors import InputError
from guiderail_hardware.drivers.clock import garbage_collection_disabled
from guiderail_hardware.robot.operator import STOP_SIGNALS, OperatorKeys, confirm, operator_keys


@pytest.fixture(autouse=True)
def hangup_ends_the_program():
    """Restore the default of SIGHUP, which a program started with nohup ignores."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)


@pytest.fixture
def terminal(monkeypatch):
    """Replace the standard input by a terminal; yield a function that types bytes there."""
    keyboard, screen = pty.openpty()
    with os.fdopen(screen, "r") as stdin:
        monkeypatch.setattr(sys, "stdin", stdin)
        yield lambda text: os.write(keyboard, text)
    os.close(keyboard)


def test_enter_requests_a_stop_and_p_requests_a_pause(terminal):
    keys = OperatorKeys()
    assert not keys.is_stop_requested()
    terminal(b"p\n")
    assert (keys.is_stop_requested(), keys.is_pause_requested) == (False, True)
    terminal(b"\n")
    assert keys.is_stop_requested()
    assert keys.is_stop_requested()
    keys.clear_stop()
    assert not keys.is_stop_requested()


def test_describe_omits_enter_when_input_is_a_pipe(terminal, monkeypatch):
    assert OperatorKeys().describe() == "Enter or Ctrl-C stops the arm"
    assert "p and Enter pauses" in OperatorKeys().describe(has_pauses=True)
    monkeypatch.setattr(sys, "stdin", io.StringIO("\n"))  # a line from a pipe is no stop
    keys = OperatorKeys()
    assert not keys.is_stop_requested()
    assert keys.describe(has_pauses=True) == "Ctrl-C stops the arm"


@pytest.mark.parametrize("number", STOP_SIGNALS)
def test_signals_request_a_stop_without_interrupting_the_stop(number, monkeypatch):
    handlers = [signal.getsignal(stop_signal) for stop_signal in STOP_SIGNALS]
    with operator_keys() as keys:
        keys.is_moving = True
        signal.raise_signal(number)
        signal.raise_signal(number)
        assert keys.is_stop_requested()
        monkeypatch.setattr("guiderail_hardware.robot.operator.HANGING_TIME", -1.0)
        signal.raise_signal(number)
        assert keys.must_end == (number != signal.SIGINT)
        keys.clear_stop()
        signal.raise_signal(number)
        with pytest.raises(KeyboardInterrupt):  # no control step has handled the first signal
            signal.raise_signal(number)
    assert [signal.getsignal(stop_signal) for stop_signal in STOP_SIGNALS] == handlers


@pytest.mark.parametrize("number", STOP_SIGNALS)
def test_signal_ends_the_program_when_nothing_moves(number):
    with pytest.raises(InputError, match=r"^stopped: nothing moved$"), operator_keys():
        signal.raise_signal(number)


def test_confirm_raises_when_the_standard_input_is_closed(monkeypatch):
    monkeypatch.setattr(sys, "stdin", None)
    assert OperatorKeys().describe() == "Ctrl-C stops the arm"
    assert not OperatorKeys().is_stop_requested()
    with pytest.raises(InputError, match="at a terminal, or by --yes"):
        confirm("Is the workspace clear?")
    with pytest.raises(InputError, match=r"at a terminal$"):
        confirm("Resume?", has_yes=False)


def test_garbage_collection_is_off_within_the_block():
    with garbage_collection_disabled():
        assert not gc.isenabled()
    assert gc.isenabled()


def test_confirm_requires_a_yes_typed_after_the_question(monkeypatch):
    with pytest.raises(InputError, match="--yes"):
        confirm("Is the workspace clear?")
    monkeypatch.setattr("sys.stdin", type("Terminal", (), {"isatty": lambda self: True})())
    flush = Mock()
    monkeypatch.setattr("termios.tcflush", flush)
    monkeypatch.setattr("builtins.input", lambda question: "no")
    with pytest.raises(InputError, match="nothing moves"):
        confirm("Is the workspace clear?")
    monkeypatch.setattr("builtins.input", Mock(side_effect=EOFError))
    with pytest.raises(InputError, match="nothing moves"):
        confirm("Is the workspace clear?")
    flush.reset_mock()
    monkeypatch.setattr("builtins.input", lambda question: "yes" if flush.called else "no")
    confirm("Is the workspace clear?")


def test_confirm_raises_when_interrupted_and_keeps_no_stop(monkeypatch):
    monkeypatch.setattr("sys.stdin", type("Terminal", (), {"isatty": lambda self: True})())
    monkeypatch.setattr("termios.tcflush", Mock())
    monkeypatch.setattr("builtins.input", lambda question: signal.raise_signal(signal.SIGINT))
    with operator_keys() as keys:
        with pytest.raises(InputError, match="nothing moves"):
            confirm("Is the workspace clear?")
        monkeypatch.setattr(sys, "stdin", io.StringIO())
        assert not keys.is_stop_requested()
        keys.is_moving = True
        signal.raise_signal(signal.SIGINT)
        assert keys.is_stop_requested()
