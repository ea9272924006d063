"""Five demonstrations of searching for a jack at an uncertain position, inserting and locking the plug.

The demonstrator circles around the expected position of the jack with a light push, and then inserts the plug. The five
circles begin a fifth of a turn apart. During the search the five positions are always evenly spaced on a circle. Until
the plug drops in, their mean is the center of the circle, and their covariance is the same in every direction. An
action of a policy therefore has the same effect in every direction during the whole search.

There are two sets. The push of "search" is light. That of "firm_search", recorded on an arm, is four times as large.
The torque from the rim shows on which side of the rim the plug stands. With the firm push this torque is as large as
the errors of an arm's joint torques, with the light push it is a quarter of these errors.

`python -m research.generate connector-search-demonstrations` and `connector-firm-search-demonstrations` record them
again.
"""

from pathlib import Path

import numpy as np

from guiderail.models.common.transforms import DEGREE, MM
from guiderail.models.objects.bnc_connector.demonstrations import (
    CLEAR,
    LOCK_COMMAND,
    NUM_DEMONSTRATIONS,
    QUARTER_TURN,
    RIM,
    SEAT_COMMAND,
    random_curves,
)
from guiderail.models.primitives import Demonstrations

PATH = Path(__file__).with_name("bnc_search.npz")
FIRM_PATH = Path(__file__).with_name("bnc_firm_search.npz")


RADIUS = 2.5 * MM  # radius of the circle
TURN = 0.3  # period of the circle [s], much shorter than the search
SEARCH_PUSH = 1.5 * MM  # distance of the command below the rim, which causes a force of about two newtons
FIRM_PUSH = 6.0 * MM  # distance of the command below the rim, which causes a force of about nine newtons
SEARCH = (1.2, 3.0)  # begin and end of the search [s]
HOLD_UNTIL, IN_BY = 3.6, 4.1  # times when the circle begins to shrink and when it has vanished [s]

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
# Standard deviations of the hand in addition to the circle: at the start, where the circle begins to shrink, inserted,
# turned and locked.
_TIMES = [0.0, HOLD_UNTIL, IN_BY, 7.0, 8.0]  # [s]
_DEVIATIONS = {
    "x": np.array([0.05, 0.05, 0.15, 0.15, 0.10]) * MM,
    "y": np.array([0.05, 0.05, 0.15, 0.15, 0.10]) * MM,
    "z": np.array([0.9, 0.5, 0.5, 0.5, 0.3]) * MM,
    "Rz": np.array([1.5, 1.0, 1.0, 1.5, 0.7]) * DEGREE,
    "Ry": np.array([0.3, 0.3, 0.3, 0.2, 0.15]) * DEGREE,
    "Rx": np.array([0.3, 0.3, 0.3, 0.2, 0.15]) * DEGREE,
}
_CORRELATION = 0.3  # correlation time [s]


def demonstrator_motions(seed: int, times: np.ndarray, push: float = SEARCH_PUSH) -> np.ndarray:
    """Return the desired poses (M, N, 6) of M demonstrations at `times` (N,) [s], in the locked frame.

    `push` is the distance of the command below the rim at the beginning of the search [m].
    """
    rng = np.random.default_rng(seed)
    script_times, z, yaw = WAYPOINTS.T
    searches = (script_times >= SEARCH[0]) & (script_times <= SEARCH[1])
    z = np.where(searches, z + SEARCH_PUSH - push, z)
    remaining = np.clip((IN_BY - times) / (IN_BY - HOLD_UNTIL), 0.0, 1.0)
    radius = RADIUS * remaining**2 * (3.0 - 2.0 * remaining)
    scale = np.stack([np.interp(times, _TIMES, deviation) for deviation in _DEVIATIONS.values()], axis=1)
    wander = random_curves(rng, times, [_CORRELATION] * len(_DEVIATIONS), NUM_DEMONSTRATIONS)
    motions = scale * (wander - wander.mean(axis=0))
    motions[..., 2] += np.interp(times, script_times, z)
    motions[..., 3] += np.interp(times, script_times, yaw)
    for number, motion in enumerate(motions):
        angle = 2.0 * np.pi * (times / TURN + number / NUM_DEMONSTRATIONS)
        motion[:, 0] += radius * np.cos(angle)
        motion[:, 1] += radius * np.sin(angle)
    return motions


def firm_motions(seed: int, times: np.ndarray) -> np.ndarray:
    """Return `demonstrator_motions` with the firm push."""
    return demonstrator_motions(seed, times, FIRM_PUSH)


def load() -> Demonstrations:
    """Load the commanded poses: five demonstrations of 400 poses in the locked frame."""
    return Demonstrations.load(PATH)


def load_firm() -> Demonstrations:
    """Load the commanded poses with the firm push: five demonstrations of 400 poses in the locked frame."""
    return Demonstrations.load(FIRM_PATH)
