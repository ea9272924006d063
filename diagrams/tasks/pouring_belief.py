"""Where the template believes the mug to be: an error that a reset draws."""

from __future__ import annotations

import numpy as np

from guiderail.diagrams.tasks.offsets import in_ring
from guiderail.diagrams.tasks.pouring_options import MAX_MUG_ERROR, PouringOptions, PouringReset
from guiderail.models.errors import InputError


def draw_error(episode: np.random.Generator, options: PouringOptions, reset: PouringReset) -> np.ndarray:
    """(x, y) [m] from the mug to where it is believed to be; drawn whether or not a reset's option replaces it.

    Raises:
        InputError: if the reset's option is farther than an aimed Pour leads.
    """
    error = in_ring(episode, options.mug_error_least, options.mug_error_most)
    if reset.mug_error is None:
        return error
    if np.linalg.norm(reset.mug_error) > MAX_MUG_ERROR:
        raise InputError(f"the reset option 'mug_error' is at most {MAX_MUG_ERROR:g} m long, not {reset.mug_error}")
    return np.array(reset.mug_error)
