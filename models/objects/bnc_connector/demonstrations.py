"""Demonstrations of inserting and locking a BNC plug, five in each of three sets.

The scripted demonstrator replaces the human hand of the thesis (section 4.4.2). It moves the *desired* pose of a
station with impedance control. The files contain the commanded and the measured poses. A primitive is fitted to the
commanded poses, because the push is the difference between commanded and measured poses.

- Insertion, for a jack at a known position: the motions differ randomly. The demonstrator approaches the jack
  imprecisely, wanders over the rim with a light push until the plug drops in, is precise where the connector guides the
  motion, and varies its speed.
- Search, for a jack at an uncertain position: the demonstrator circles around the expected position with a light push,
  and then inserts the plug. The five circles begin a fifth of a turn apart. During the search the five positions are
  always evenly spaced on a circle. Until the plug drops in, their mean is the center of the circle, and their
  covariance is the same in every direction. An action of a policy therefore has the same effect in every direction
  during the whole search.
- Firm search, recorded on an arm: the push is four times as large. The torque from the rim shows on which side of the
  rim the plug stands. With the firm push this torque is as large as the errors of an arm's joint torques. With the
  light push it is a quarter of these errors.

`research/generate/bnc_connector.py` has the scripted demonstrator, and records them again.
"""

from pathlib import Path

import numpy as np

from guiderail.models.common.transforms import MM

# Files of the sets: five demonstrations of 400 poses in the locked frame each.
PATH, SEARCH_PATH, FIRM_SEARCH_PATH = (
    Path(__file__).with_name(f"{name}.npz") for name in ("bnc_connector", "bnc_search", "bnc_firm_search")
)
NUM_DEMONSTRATIONS = 5
NUM_STEPS = 400

QUARTER_TURN = np.pi / 2
# Heights of the plug in the locked frame [m].
CLEAR = 15.5 * MM  # above the jack
RIM = 10.5 * MM  # on the barrel's rim
# A command lies below the surface that stops the plug: under impedance control, the distance between command and
# surface determines the push.
SEARCH_PUSH = 2.5 * MM
SEAT_COMMAND = -6.0 * MM
LOCK_COMMAND = -8.0 * MM

SEARCH = (1.2, 3.0)  # begin and end of a search [s]
HOLD_UNTIL = 3.6  # time when the circle of a search begins to shrink [s]

# Waypoints of the plug: time [s], z [m], Rz [rad].
WAYPOINTS = np.array(
    [
        [0.0, CLEAR, QUARTER_TURN],
        [0.2, CLEAR, QUARTER_TURN],
        [1.4, RIM - SEARCH_PUSH, QUARTER_TURN],
        [3.6, RIM - SEARCH_PUSH - 0.5 * MM, QUARTER_TURN],
        [4.4, SEAT_COMMAND, QUARTER_TURN],
        [4.7, SEAT_COMMAND, QUARTER_TURN],
        [6.8, LOCK_COMMAND, 0.0],
        [7.1, LOCK_COMMAND, 0.0],
        [7.6, 0.0, 0.0],
        [8.0, 0.0, 0.0],
    ]
)


def poses(z: np.ndarray | float, yaw: np.ndarray | float) -> np.ndarray:
    """Return upright poses (N, 6), [x y z Rz Ry Rx], on the center line, for heights [m] and yaw angles [rad], (N,)."""
    z, yaw = np.broadcast_arrays(np.atleast_1d(z), yaw)
    zero = np.zeros_like(z, dtype=float)
    return np.stack([zero, zero, z, yaw, zero, zero], axis=1)


def insert_and_lock() -> tuple[np.ndarray, np.ndarray]:
    """Return times (N,) [s] and desired poses (N, 6) of the N waypoints of an insertion at a known position."""
    times, z, yaw = WAYPOINTS.T
    return times, poses(z, yaw)
