"""Run of a command in the process of a test."""

import pytest

from guiderail.tools.cli.main import main


def call(capsys, *arguments):
    """Run a command; return its exit code, standard output and standard error."""
    with pytest.raises(SystemExit) as end:
        main([str(argument) for argument in arguments])
    out, err = capsys.readouterr()
    return end.value.code, out, err
