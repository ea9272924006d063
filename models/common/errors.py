"""What a person is told when what they gave makes no sense."""

import reprlib
from typing import Any


class InputError(ValueError):
    """Something from outside is wrong: data, a file, an argument, a name.

    Its message is one sentence that names the thing and the remedy; the command prints it and exits with code 2.
    Everything that is raised because of what a user gave is of this type, so that nothing else is ever mistaken for it.
    """


class RunsFailedError(RuntimeError):
    """Some runs of a study failed, and the others are finished.

    Attributes:
        sentences: one for each that failed; the command prints them and exits with code 1.
        rows: what the others came to, a data frame.
    """

    def __init__(self, sentences: list[str], rows: Any):
        super().__init__("; ".join(sentences))
        self.sentences, self.rows = sentences, rows


_SHORT = reprlib.Repr()
_SHORT.maxstring = _SHORT.maxother = _SHORT.maxlong = 60
_SHORT.maxlevel = 3


def brief(value: Any) -> str:
    """A value as a sentence can quote it: its repr, on one line, short however large the value is."""
    return " ".join(_SHORT.repr(value).split())
