"""Repeated options, files that exist, and names that the commands accept."""

import io
import sys

import pytest
from typer.main import get_command

from guiderail.models.common.errors import InputError
from guiderail.tools.cli.app import print_result
from guiderail.tools.cli.main import load_commands, main
from oracles.commands import call


def options_of(kind):
    """Return (command, option, value, other value) of all commands."""
    group = get_command(load_commands())
    for name, command in group.commands.items():
        for parameter in getattr(command, "params", ()):
            if parameter.param_type_name == "option" and kind(parameter):
                yield pytest.param(command, parameter, id=f"{name} {parameter.opts[0]}")


@pytest.mark.parametrize("joined", [False, True])
@pytest.mark.parametrize(
    ("command", "parameter"), options_of(lambda parameter: not parameter.is_flag and not parameter.multiple)
)
def test_option_with_two_values_is_refused(command, parameter, joined):
    option = parameter.opts[0]
    words = [f"{option}=1", f"{option}=2"] if joined else [option, "1", option, "2"]
    with pytest.raises(InputError, match="is given as 1 and as 2: give it once"):
        command.make_context("command", words)


@pytest.mark.parametrize(("command", "parameter"), options_of(lambda parameter: bool(parameter.secondary_opts)))
def test_switch_on_and_off_is_refused(command, parameter):
    with pytest.raises(InputError, match="contradict each other"):
        command.make_context("command", [parameter.opts[0], parameter.secondary_opts[0]])


def test_command_without_arguments_prints_its_help(capsys):
    code, out, err = call(capsys)
    assert (code, err) == (0, "")
    assert out == call(capsys, "--help")[1]


@pytest.mark.parametrize("name", ["tqc", "tqc_fast", "skgrl", "arm", "iiwa14", "matern52"])
def test_list_describes_every_name_that_it_lists(name, capsys):
    code, out, err = call(capsys, "list", name)
    assert (code, err) == (0, "")
    assert out


@pytest.mark.parametrize("option", ["--html", "--image", "--video"])
def test_visualize_keeps_an_existing_file(option, capsys, tmp_path):
    file = tmp_path / {"--html": "page.html", "--image": "picture.png", "--video": "video.webp"}[option]
    file.write_text("mine")
    code, out, err = call(capsys, "visualize", "pretrained:passage", option, file)
    assert (code, out) == (2, "")
    assert "exists already: name another file, or give --overwrite" in err
    assert file.read_text() == "mine"


def test_rounding_of_a_violation_is_printed_as_none(capsys):
    print_result({"max_commanded_violation": 8.7e-19, "mean_return": 8.7e-19}, as_json=False)
    violation, mean = capsys.readouterr().out.splitlines()
    assert violation.endswith("none")
    assert mean.endswith("8.7e-19")


def test_output_is_written_to_a_latin_1_terminal(monkeypatch):
    streams = {name: io.TextIOWrapper(io.BytesIO(), encoding="latin-1") for name in ("stdout", "stderr")}
    for name, stream in streams.items():
        monkeypatch.setattr(sys, name, stream)
    with pytest.raises(SystemExit) as end:
        main(["list", "NarrowPassage"])
    assert end.value.code == 0
    streams["stdout"].flush()
    assert b"?" in streams["stdout"].buffer.getvalue()
