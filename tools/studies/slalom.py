"""The hard narrow passage by hand: around each obstacle on the side where it doesn't stand."""

from __future__ import annotations

import numpy as np

# Phases, from -1 to 1, while the demonstrations are beside the first and the second obstacle.
BESIDE = ((-0.8, -0.25), (0.1, 0.7))
AWAY = 1.0  # of a full action
# Where [phase, first obstacle, second obstacle] lie in an observation: x and y each, x as a side from -1 to 1.
PHASE, SIDES = 0, (1, 3)


def slalom(observation: np.ndarray) -> np.ndarray:
    """Away from the obstacle that is being passed, along x, (2,)."""
    for (first, last), side in zip(BESIDE, SIDES, strict=True):
        if first < observation[PHASE] < last:
            return np.array([-AWAY * observation[side], 0.0])
    return np.zeros(2)
