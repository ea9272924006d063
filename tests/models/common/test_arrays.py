import numpy as np
import pytest

from guiderail.models.common.arrays import as_number, as_numbers, is_whole
from guiderail.models.common.errors import InputError


@pytest.mark.parametrize(
    "values",
    [[2**53], [2**63], [2**64], [0.5, 2**70], np.array([1, 2**60], dtype=object), [0.5, -(2**53)]]
    + [[[2**53 + 1], [0.5]], [np.int64(2**53), np.inf], [np.array([2**53]), np.array([0.5])]],
)
def test_whole_numbers_that_a_double_rounds_are_refused(values):
    with pytest.raises(InputError, match="the lengths holds whole numbers"):
        as_numbers(values, "the lengths")


@pytest.mark.parametrize(
    "values", [["1.5", "2"], np.array(["1.5", 2.0], dtype=object), np.array([b"3", 1], dtype=object)]
)
def test_text_is_refused_even_if_it_is_a_number(values):
    with pytest.raises(InputError, match="the lengths is not an array of numbers"):
        as_numbers(values, "the lengths")


@pytest.mark.parametrize("values", [None, [None, 1.0]])
def test_none_is_no_number(values):
    with pytest.raises(InputError, match="the lengths is not an array of numbers: it holds None"):
        as_numbers(values, "the lengths")


def test_large_doubles_are_accepted_with_small_whole_numbers():
    np.testing.assert_array_equal(as_numbers([1e300, 3, -np.inf], "the lengths"), [1e300, 3.0, -np.inf])


@pytest.mark.parametrize("value", ["3", None, [3.0], np.ones((1, 1))])
def test_a_text_and_a_list_are_not_one_number(value):
    with pytest.raises(InputError, match="the length must be a number, not"):
        as_number(value, "the length")
    assert [as_number(number, "the length") for number in (3, np.float32(0.5), np.array(2.0))] == [3.0, 0.5, 2.0]


def test_objects_that_are_numbers_are_converted_to_doubles():
    numbers = as_numbers(np.array([1, np.float32(2.5), True, 2**53 - 1], dtype=object), "the lengths")
    np.testing.assert_array_equal(numbers, [1.0, 2.5, 1.0, 2.0**53 - 1.0])
    assert numbers.dtype == float


@pytest.mark.parametrize(
    ("value", "is_accepted"),
    [
        (1, True),
        (2.0, True),
        (np.int64(3), True),
        (10**400, True),
        (0, False),
        (True, False),
        (1.5, False),
        (np.nan, False),
    ]
    + [(np.inf, False), ("1", False), (None, False)],
)
def test_whole_number_is_no_bool(value, is_accepted):
    assert is_whole(value, 1) is is_accepted
