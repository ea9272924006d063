"""Escape sequences in names, files and exceptions do not reach the terminal."""

import io
import sys

import pytest
from rich.progress import Progress
from rich.table import Table

from guiderail.tools.cli.main import main
from guiderail.tools.progress import PrintableConsole
from guiderail.tools.terminal import PrintableStream, printable, protect_terminal

ATTACKS = {
    "title": "\x1b]0;owned\x07",
    "color": "\x1b[31mred\x1b[0m",
    "cursor": "\x1b[2J\x1b[1;1H",
    "one-byte sequence": "\x9b31m",
    "carriage return": "ok\rfailed",
    "backspace": "no\x08\x08yes",
    "direction": "\u202eabc",
    "line separator": "a\u2028b",
    "delete": "\x7f",
}


def is_clean(text):
    """Return True if a text has no control characters except tab and newline, nor marks of direction."""
    return all(c.isprintable() or c in "\t\n" for c in text)


@pytest.mark.parametrize("attack", ATTACKS.values(), ids=ATTACKS)
def test_printable_escapes_control_characters(attack):
    assert is_clean(printable(f"before {attack}\tafter\n"))
    assert printable("λ = 0.5 µm, 你好\t|\n") == "λ = 0.5 µm, 你好\t|\n"


@pytest.mark.parametrize("attack", ATTACKS.values(), ids=ATTACKS)
def test_stream_writes_printable_text(attack):
    inner = io.StringIO()
    stream = PrintableStream(inner)
    print("name", attack, file=stream)
    stream.writelines([attack, "\n"])
    assert is_clean(inner.getvalue())
    assert not stream.isatty()


@pytest.mark.parametrize("attack", ["title", "cursor", "one-byte sequence"])
def test_console_prints_texts_of_tables_and_bars_printably(attack):
    attack, file = ATTACKS[attack], io.StringIO()
    console = PrintableConsole(file=PrintableStream(file), force_terminal=True, width=200)
    table = Table("column")
    table.add_row(attack)
    console.print(table, style="red")
    console.print(attack, highlight=False, markup=False)
    with Progress(console=console) as bar:
        bar.update(bar.add_task(attack, total=2), advance=1, refresh=True)
    text = file.getvalue()
    assert attack not in text
    assert printable(attack.rstrip("\x07")) in text  # rich removes the bell
    assert "\x1b[31m" in text  # the console's own color


@pytest.mark.parametrize("command", ["evaluate", "visualize", "certify", "no-such-command"])
def test_command_prints_names_of_folders_printably(command, monkeypatch):
    written = {name: io.StringIO() for name in ("stdout", "stderr")}
    for name, stream in written.items():
        monkeypatch.setattr(sys, name, stream)
    with pytest.raises(SystemExit, match="2"):
        main([command, f"runs/{ATTACKS['title']}{ATTACKS['color']}"])
    assert written["stderr"].getvalue().startswith("guiderail: ")
    assert is_clean(written["stderr"].getvalue() + written["stdout"].getvalue())


def test_terminal_is_protected_once(monkeypatch):
    monkeypatch.setattr(sys, "stdout", io.StringIO())
    monkeypatch.setattr(sys, "stderr", io.StringIO())
    protect_terminal()
    stream = sys.stdout
    protect_terminal()
    assert sys.stdout is stream
    sys.excepthook(ValueError, ValueError(ATTACKS["title"]), None)  # an exception of a policy
    assert is_clean(sys.stderr.inner.getvalue())
