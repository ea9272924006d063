"""What training draws, and what it never draws: two streams of random numbers."""

import numpy as np

# No seed of a training run leads to this stream.
_HELD_OUT_STREAM = 0x8E1D


def episode_stream(rng: np.random.Generator, held_out: bool) -> np.random.Generator:
    """The generator that an episode's conditions are drawn from: training's, or one that only evaluation has.

    It takes one number from `rng` whichever it is, so that a seed means the same at the first reset and later.
    """
    return np.random.default_rng([int(rng.integers(2**62)), _HELD_OUT_STREAM if held_out else 0])
