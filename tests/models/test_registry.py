"""Open lists say no in a sentence, whatever they are asked for."""

import pytest

from guiderail.models.errors import InputError
from guiderail.models.registry import Registry


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
