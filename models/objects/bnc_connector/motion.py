"""How a BNC plug is pushed on and locked, as desired poses of the plug in the locked frame."""

from __future__ import annotations

import numpy as np

from guiderail.models.objects.bnc_connector.geometry import MM

QUARTER_TURN = np.pi / 2
# Plug heights in the locked frame, from the drawing's deep entry.
CLEAR = 15.5 * MM  # the mouth well above the jack
RIM = 10.5 * MM  # the mouth on the barrel's rim
# Commands lie below the surface that stops them: under impedance control, the difference is the push.
SEARCH_PUSH = 2.5 * MM
SEAT_COMMAND = -6.0 * MM
LOCK_COMMAND = -8.0 * MM

# time [s], z [m], Rz [rad]
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
    """Upright poses [x y z Rz Ry Rx] on the centre line, (N, 6)."""
    z, yaw = np.broadcast_arrays(np.atleast_1d(z), yaw)
    zero = np.zeros_like(z, dtype=float)
    return np.stack([zero, zero, z, yaw, zero, zero], axis=1)


def insert_and_lock() -> tuple[np.ndarray, np.ndarray]:
    """Times (N,) and desired poses (N, 6) of the whole motion for a jack whose place is known."""
    times, z, yaw = WAYPOINTS.T
    return times, poses(z, yaw)
