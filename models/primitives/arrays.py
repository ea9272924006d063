"""Arrays of numbers, as callers and files give them."""

import numpy as np
from numpy.typing import ArrayLike

from guiderail.models.errors import InputError

_EXACT = 2**53  # from there on a double skips whole numbers


def numbers(values: ArrayLike, what: str) -> np.ndarray:
    """A new array of doubles that holds exactly the numbers given; `what` names them in messages.

    Raises:
        InputError: if they are ragged, or no real numbers: texts, dates, complex numbers and objects are none.
    """
    try:
        given = np.asarray(values)
        if given.dtype.kind not in "fiubO":
            raise InputError(f"{what} is not an array of numbers: it holds {given.dtype}")
        array = np.array(given, dtype=float)
    except InputError:
        raise
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{what} is not an array of numbers: {error}") from error
    if given.dtype.kind in "iu" and given.dtype.itemsize == 8 and (np.abs(array) >= _EXACT).any():
        raise InputError(f"{what} holds whole numbers of 2^53 and more, which a double rounds: subtract an offset")
    return array
