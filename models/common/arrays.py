"""Conversion to numbers and arrays of numbers, and small functions of vectors and sequences."""

import math
from collections.abc import Iterable
from numbers import Integral, Real
from typing import SupportsFloat, SupportsInt, cast

import numpy as np
from numpy.typing import ArrayLike

from guiderail.models.common.errors import InputError, brief


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Compute a × b of two vectors (3,), many times faster than `numpy.cross`, which is made for arrays of vectors."""
    (a0, a1, a2), (b0, b1, b2) = a.tolist(), b.tolist()
    return np.array([a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0])


def norm(vector: np.ndarray) -> float:
    """Return the Euclidean norm of a short vector (n,), bit-identical to `np.linalg.norm` and three times as fast."""
    return math.sqrt(vector.dot(vector))


def is_finite(values: np.ndarray) -> bool:
    """Return True if a short vector (n,) is finite; several times faster than `np.isfinite(values).all()`."""
    return all(map(math.isfinite, values.tolist()))


def as_whole(value: object, what: str, least: int | None = None, most: int | None = None) -> int:
    """Convert a whole number of Python or NumPy, such as 3 or 3.0, to an int from `least` to `most`.

    Bools and other types are refused; `what` is the number's name for the message.

    Raises:
        InputError: If the value is anything else: 1.5, "3" and True are refused.
    """
    is_real = isinstance(value, Real) and not isinstance(value, bool)
    is_whole = is_real and (isinstance(value, Integral) or float(cast(SupportsFloat, value)).is_integer())
    number = int(cast(SupportsInt, value)) if is_whole else None
    if number is None or (least is not None and number < least) or (most is not None and number > most):
        bounds = "" if least is None else f" of at least {least}" if most is None else f" from {least} to {most}"
        raise InputError(f"{what} must be a whole number{bounds}, not {brief(value)}")
    return number


def as_number(value: object, what: str) -> float:
    """Convert a real number of Python or NumPy to a float; `what` is its name for the message.

    NaN and infinity are accepted.

    Raises:
        InputError: If the value is not a single real number, or exceeds the range of a double: "3", None and
            [1.0, 2.0] are refused.
    """
    scalar = value[()] if isinstance(value, np.ndarray) and value.ndim == 0 else value
    try:
        if isinstance(scalar, Real):
            return float(scalar)
    except OverflowError:
        pass
    raise InputError(f"{what} must be a number, not {brief(value)}")


def as_doubles(values: ArrayLike, what: str) -> np.ndarray:
    """Return an array of doubles unchanged; convert other values with `as_numbers`, which may raise an InputError."""
    if type(values) is np.ndarray and values.dtype == np.float64:
        return values
    return as_numbers(values, what)


def parse_number(text: str) -> float:
    """Convert a text to a number.

    Texts that Python's `float` accepts, but other programs do not, are refused: digits of other scripts, and 1_000.

    Raises:
        ValueError: If the text is not a number.
    """
    if not text.isascii() or "_" in text:
        raise ValueError(f"could not convert string to float: {text!r}")
    return float(text)


_EXACT = 2**53  # a double represents smaller whole numbers exactly


def as_numbers(values: ArrayLike, what: str) -> np.ndarray:
    """Convert numbers, nested in any way that NumPy accepts, to a new array of doubles.

    `what` is the name of the values for messages. Bools become 0 and 1.

    Raises:
        InputError: If the values are ragged, or include text, None, dates, complex numbers, objects that `float` does
            not convert, or integers of 2^53 and more, which a double rounds.
    """
    try:
        raw = np.asarray(values)
        if raw.dtype.kind not in "fiubO":
            raise InputError(f"{what} is not an array of numbers: it holds {raw.dtype}")
        if any(isinstance(value, str | bytes) for value in _objects(raw)):
            raise InputError(f"{what} is not an array of numbers: it holds text")
        if any(value is None for value in _objects(raw)):
            raise InputError(f"{what} is not an array of numbers: it holds None")
        array = np.array(raw, dtype=float)
    except InputError:
        raise
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{what} is not an array of numbers: {error}") from error
    holds_integers = raw.dtype.kind in "iu" and raw.dtype.itemsize == 8
    is_list = raw.dtype == float and raw is not values
    is_large = (holds_integers or is_list) and bool((np.abs(array) >= _EXACT).any())
    is_rounded = holds_integers and is_large
    if is_list and is_large:
        raw = np.asarray(values, dtype=object)  # exact whole numbers: NumPy rounded those that a list mixes with floats
    # NumPy stores whole numbers of 2^64 and more as objects.
    if is_rounded or any(isinstance(value, int | np.integer) and abs(int(value)) >= _EXACT for value in _objects(raw)):
        raise InputError(f"{what} holds whole numbers of 2^53 and more, which a double rounds: subtract an offset")
    return array


def find_asymmetric(matrices: np.ndarray) -> int | None:
    """Return the index of the least symmetric of matrices (N, n, n), or None if all are symmetric up to rounding.

    A difference of at most 1e-9 of a matrix's largest entry counts as rounding.
    """
    asymmetry = np.abs(matrices - matrices.transpose(0, 2, 1)).max(axis=(1, 2))
    excess = asymmetry - 1e-9 * np.abs(matrices).max(axis=(1, 2))
    worst = int(np.argmax(excess))
    return worst if excess[worst] > 0.0 else None


def _objects(array: np.ndarray) -> Iterable[object]:
    """Return the elements of an array of objects, or no elements for an array of numbers."""
    return array.flat if array.dtype.kind == "O" else ()


def find_streak(successes: Iterable[bool], length: int) -> int | None:
    """Return the index at which the first streak of `length` successes begins, or None if there is none."""
    streak = 0
    for index, success in enumerate(successes):
        streak = streak + 1 if success else 0
        if streak == length:
            return index + 1 - length
    return None


_GRID = 2.0**-40  # unit of rounded periods [s], about a picosecond


def round_period(seconds: float) -> float:
    """Round a period by at most a picosecond, so that its multiples are exact in double precision.

    Drake triggers two events together only if their times are equal. The floating-point numbers 10 k · 0.002,
    0.02 + k · 0.02 and k · 0.02 often differ in the last bit. The plant would then step once more or once less between
    two control steps, or a history would be updated one step late. Round the plant's period, and use an integer
    multiple of the rounded period as the control period.

    Args:
        seconds: Period [s], positive.

    Raises:
        InputError: If `seconds` is not finite, or not above 2^-40 s, about a picosecond.
    """
    if not (np.isfinite(seconds) and seconds > _GRID):
        raise InputError(f"a period must be finite and above a picosecond, not {seconds} s")
    return round(seconds / _GRID) * _GRID
