"""Five demonstrations of searching for a jack, inserting and locking a plug, for when its place is hardly known.

Unlike in `bnc_connector`, the demonstrator really searches: presses lightly and goes round the place where the jack
should be, each of the five times begun a fifth of a turn further, until it comes in and pushes. So at every moment of
the search the five lie evenly on a circle. Their mean is its centre, and their covariance is the same in every
direction and at every moment until the plug drops in: what a policy may do is worth the same all the while.

`python -m research.generate connector-search-demonstrations` records them again.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from guiderail.models.common.units import DEGREE, MM
from guiderail.models.objects.bnc_connector.demonstrations import (
    CLEAR,
    LOCK_COMMAND,
    NUM_DEMONSTRATIONS,
    QUARTER_TURN,
    RIM,
    SEAT_COMMAND,
    correlated,
)
from guiderail.models.primitives import Demonstrations

PATH = Path(__file__).with_name("bnc_search.npz")


RADIUS = 2.5 * MM  # of the circle
TURN = 0.3  # [s] for once around: much quicker than the search is long, so that no moment of it has a side
SEARCH_PUSH = 1.5 * MM  # below the rim, against the impedance: a couple of newtons
SEARCH = (1.2, 3.0)  # [s] from when the plug stands on the rim to when the demonstrator comes in
HOLD_UNTIL, IN_BY = 3.6, 4.1  # [s] when the circle begins to shrink, and when it is gone

# time [s], z [m], Rz [rad]
WAYPOINTS = np.array(
    [
        [0.0, CLEAR, QUARTER_TURN],
        [0.2, CLEAR, QUARTER_TURN],
        [SEARCH[0], RIM - SEARCH_PUSH, QUARTER_TURN],
        [SEARCH[1], RIM - SEARCH_PUSH - 0.3 * MM, QUARTER_TURN],
        [SEARCH[1] + 0.8, SEAT_COMMAND, QUARTER_TURN],
        [4.6, SEAT_COMMAND, QUARTER_TURN],
        [6.8, LOCK_COMMAND, 0.0],
        [7.1, LOCK_COMMAND, 0.0],
        [7.6, 0.0, 0.0],
        [8.0, 0.0, 0.0],
    ]
)
# How much the hand varies besides, as standard deviations: while it searches, when the plug is in, locked.
_TIMES = [0.0, HOLD_UNTIL, IN_BY, 7.0, 8.0]  # [s]
_DEVIATIONS = {
    "x": np.array([0.05, 0.05, 0.15, 0.15, 0.10]) * MM,
    "y": np.array([0.05, 0.05, 0.15, 0.15, 0.10]) * MM,
    "z": np.array([0.9, 0.5, 0.5, 0.5, 0.3]) * MM,
    "Rz": np.array([1.5, 1.0, 1.0, 1.5, 0.7]) * DEGREE,
    "Ry": np.array([0.3, 0.3, 0.3, 0.2, 0.15]) * DEGREE,
    "Rx": np.array([0.3, 0.3, 0.3, 0.2, 0.15]) * DEGREE,
}
_CORRELATION = 0.3  # [s] how quickly the hand wanders


def demonstrator_motions(seed: int, times: np.ndarray) -> np.ndarray:
    """Desired poses (M, N, 6) of a session of M demonstrations at `times` (N,) [s], in the locked frame."""
    rng = np.random.default_rng(seed)
    script_times, z, yaw = WAYPOINTS.T
    shrunk = np.clip((IN_BY - times) / (IN_BY - HOLD_UNTIL), 0.0, 1.0)
    radius = RADIUS * shrunk**2 * (3.0 - 2.0 * shrunk)
    scale = np.stack([np.interp(times, _TIMES, deviation) for deviation in _DEVIATIONS.values()], axis=1)
    wander = np.stack(
        [
            np.stack([correlated(rng, times, _CORRELATION) for _ in _DEVIATIONS], axis=1)
            for _ in range(NUM_DEMONSTRATIONS)
        ]
    )
    motions = scale * (wander - wander.mean(axis=0))
    motions[..., 2] += np.interp(times, script_times, z)
    motions[..., 3] += np.interp(times, script_times, yaw)
    for number, motion in enumerate(motions):
        angle = 2.0 * np.pi * (times / TURN + number / NUM_DEMONSTRATIONS)
        motion[:, 0] += radius * np.cos(angle)
        motion[:, 1] += radius * np.sin(angle)
    return motions


def load() -> Demonstrations:
    """What was commanded, five times 400 poses in the locked frame."""
    return Demonstrations.load(PATH)
