import gc
import io
import os
import pty
import signal
import sys
from unittest.mock import Mock

import pytest

from guiderail.diagrams.hardware.clock import garbage_collection_disabled
from guiderail.models.common.errors import InputError
from guiderail.tools.hardware.operator import STOP_SIGNALS, OperatorKeys, confirm, operator_keys


@pytest.fixture(autouse=True)
def hangup_ends_the_program():
    """Restore the default of SIGHUP, which a program started with nohup ignores."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)


@pytest.fixture
def terminal(monkeypatch):
    """Yield a function that types at a terminal."""
    keyboard, screen = pty.openpty()
    with os.fdopen(screen, "r") as stdin:
        monkeypatch.setattr(sys, "stdin", stdin)
        yield lambda text: os.write(keyboard, text)
    os.close(keyboard)


def test_keys_stop_by_enter_and_pause_by_p(terminal):
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
    monkeypatch.setattr(sys, "stdin", io.StringIO("\n"))  # the input of a pipe stops nothing
    keys = OperatorKeys()
    assert not keys.is_stop_requested()
    assert keys.describe(has_pauses=True) == "Ctrl-C stops the arm"


@pytest.mark.parametrize("number", STOP_SIGNALS)
def test_signal_stops_the_arm_and_a_second_one_does_not_interrupt_the_stop(number, monkeypatch):
    before = [signal.getsignal(one) for one in STOP_SIGNALS]
    with operator_keys() as keys:
        keys.is_moving = True
        signal.raise_signal(number)
        signal.raise_signal(number)
        assert keys.is_stop_requested()
        monkeypatch.setattr("guiderail.tools.hardware.operator.HANGING_TIME", -1.0)
        signal.raise_signal(number)
        assert keys.must_end == (number != signal.SIGINT)
        keys.clear_stop()
        signal.raise_signal(number)
        with pytest.raises(KeyboardInterrupt):  # no control step has noticed the first one
            signal.raise_signal(number)
    assert [signal.getsignal(one) for one in STOP_SIGNALS] == before


@pytest.mark.parametrize("number", STOP_SIGNALS)
def test_signal_ends_the_program_while_nothing_moves(number):
    with pytest.raises(InputError, match=r"^stopped: nothing moved$"), operator_keys():
        signal.raise_signal(number)


def test_closed_input_is_no_terminal(monkeypatch):
    monkeypatch.setattr(sys, "stdin", None)
    assert OperatorKeys().describe() == "Ctrl-C stops the arm"
    assert not OperatorKeys().is_stop_requested()
    with pytest.raises(InputError, match="at a terminal, or by --yes"):
        confirm("So?")
    with pytest.raises(InputError, match=r"at a terminal$"):
        confirm("Resume?", has_yes=False)


def test_garbage_collection_is_off_within_the_block():
    with garbage_collection_disabled():
        assert not gc.isenabled()
    assert gc.isenabled()


def test_confirm_raises_without_a_yes_at_a_terminal(monkeypatch):
    with pytest.raises(InputError, match="--yes"):
        confirm("So?")
    monkeypatch.setattr("sys.stdin", type("Terminal", (), {"isatty": lambda self: True})())
    flushed = Mock()
    monkeypatch.setattr("termios.tcflush", flushed)
    monkeypatch.setattr("builtins.input", lambda question: "no")
    with pytest.raises(InputError, match="nothing moves"):
        confirm("So?")
    monkeypatch.setattr("builtins.input", Mock(side_effect=EOFError))
    with pytest.raises(InputError, match="nothing moves"):
        confirm("So?")
    flushed.reset_mock()
    monkeypatch.setattr("builtins.input", lambda question: "yes" if flushed.called else "no")
    confirm("So?")


def test_ctrl_c_at_a_question_is_no_confirmation(monkeypatch):
    monkeypatch.setattr("sys.stdin", type("Terminal", (), {"isatty": lambda self: True})())
    monkeypatch.setattr("termios.tcflush", Mock())
    monkeypatch.setattr("builtins.input", lambda question: signal.raise_signal(signal.SIGINT))
    with operator_keys() as keys:
        with pytest.raises(InputError, match="nothing moves"):
            confirm("So?")
        monkeypatch.setattr(sys, "stdin", io.StringIO())
        assert not keys.is_stop_requested()
        keys.is_moving = True
        signal.raise_signal(signal.SIGINT)
        assert keys.is_stop_requested()
