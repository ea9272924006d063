"""Open lists say no in a sentence, whatever they are asked for."""

from dataclasses import dataclass

import pytest

from guiderail.models.common.errors import InputError
from guiderail.models.common.registry import Registry


@pytest.mark.parametrize("name", [{}, [], None, 3, ["sphere"]])
def test_a_name_is_a_word(name):
    shapes = Registry("shape")
    shapes.register("sphere", object())
    with pytest.raises(InputError, match=r"a shape is named by a word, not .*: choose one of sphere"):
        shapes.get(name)


def test_an_unknown_name_gets_the_nearest_one():
    shapes = Registry("shape")
    shapes.register("sphere", object())
    with pytest.raises(InputError, match="there is no shape 'spere': did you mean sphere"):
        shapes.get("spere")


@dataclass(frozen=True)
class _Kind:
    build: object


def _from(file):
    """A function that a file of that path defines."""
    module = {"__file__": str(file)}
    exec("def build():\n    pass", module)
    return module["build"]


def test_what_is_imported_again_is_the_same_and_of_another_file_it_is_not(tmp_path):
    shapes = Registry("shape")
    shapes.register("sphere", _Kind(_from(tmp_path / "one.py")))
    again = _Kind(_from(tmp_path / "one.py"))
    shapes.register("sphere", again)
    assert shapes.get("sphere") is again
    with pytest.raises(InputError, match=r"there is a shape 'sphere' already, from \S*one\.py: choose another name"):
        shapes.register("sphere", _Kind(_from(tmp_path / "two.py")))
    assert shapes.get("sphere") is again
