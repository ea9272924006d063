import numpy as np
import pytest

from guiderail.models.common.arrays import as_number, as_numbers, as_whole
from guiderail.models.common.errors import InputError

ROUNDED = [[2**53], [2**63], [2**64], [0.5, 2**70], np.array([1, 2**60], dtype=object), [0.5, -(2**53)]]
ROUNDED += [[[2**53 + 1], [0.5]], [np.int64(2**53), np.inf], [np.array([2**53]), np.array([0.5])]]
DIGITS = [["1.5", "2"], np.array(["1.5", 2.0], dtype=object), np.array([b"3", 1], dtype=object)]


@pytest.mark.parametrize(
    ("values", "message"),
    [
        *((values, " holds whole numbers") for values in ROUNDED),
        *((values, " is not an array of numbers") for values in DIGITS),
        *((values, " is not an array of numbers: it holds None") for values in (None, [None, 1.0])),
    ],
)
def test_as_numbers_refuses_rounded_integers_text_and_none(values, message):
    with pytest.raises(InputError, match=f"the lengths{message}"):
        as_numbers(values, "the lengths")


def test_as_numbers_accepts_large_doubles_with_small_integers():
    np.testing.assert_array_equal(as_numbers([1e300, 3, -np.inf], "the lengths"), [1e300, 3.0, -np.inf])


@pytest.mark.parametrize("value", ["3", None, [3.0], np.ones((1, 1))])
def test_as_number_refuses_text_and_arrays(value):
    with pytest.raises(InputError, match="the length must be a number, not"):
        as_number(value, "the length")
    assert [as_number(number, "the length") for number in (3, np.float32(0.5), np.array(2.0))] == [3.0, 0.5, 2.0]


def test_as_numbers_converts_objects_to_doubles():
    numbers = as_numbers(np.array([1, np.float32(2.5), True, 2**53 - 1], dtype=object), "the lengths")
    np.testing.assert_array_equal(numbers, [1.0, 2.5, 1.0, 2.0**53 - 1.0])
    assert numbers.dtype == float


@pytest.mark.parametrize(
    ("value", "is_accepted"),
    [
        *((value, True) for value in (1, 2.0, np.int64(3), 10**400)),
        *((value, False) for value in (0, True, 1.5, np.nan, np.inf, "1", None)),
    ],
)
def test_as_whole_accepts_integers_of_any_numeric_type(value, is_accepted):
    if is_accepted:
        assert as_whole(value, "the count", 1) == value
    else:
        with pytest.raises(InputError, match="the count must be a whole number of at least 1, not"):
            as_whole(value, "the count", 1)


def test_as_whole_refuses_numbers_outside_of_a_range():
    with pytest.raises(InputError, match="the count must be a whole number from 1 to 3, not 4"):
        as_whole(4, "the count", 1, 3)
    assert as_whole(3, "the count", 1, 3) == 3
