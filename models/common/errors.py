"""Exceptions with messages for users."""

import reprlib
from typing import Any


class InputError(ValueError):
    """Error in user input: data, a file, an argument or a name.

    Its message is one sentence that names the problem and the remedy; the command prints it and exits with code 2. All
    errors in user input have this type, which tells them from errors in the program.
    """


class RunsFailedError(RuntimeError):
    """Failure of some runs of a study after all others have finished.

    Attributes:
        sentences: One sentence for each failed run; the command prints them and exits with code 1.
        rows: Results of the other runs, a data frame.
    """

    def __init__(self, sentences: list[str], rows: Any):
        super().__init__("; ".join(sentences))
        self.sentences, self.rows = sentences, rows


_SHORT = reprlib.Repr()
_SHORT.maxstring = _SHORT.maxother = _SHORT.maxlong = 60
_SHORT.maxlevel = 3


def brief(value: Any) -> str:
    """Return the repr of a value on one line, shortened for a message."""
    return " ".join(_SHORT.repr(value).split())
