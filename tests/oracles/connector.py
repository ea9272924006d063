"""Motion that locks the connector's plug in tests of contact physics."""

import numpy as np

from guiderail.models.objects.bnc_connector.demonstrations import WAYPOINTS, poses


def insert_and_lock():
    """Return times (N,) [s] and desired poses (N, 6) of an insertion, without the 2 s on the rim of a demonstration."""
    times, z, yaw = WAYPOINTS.T
    return np.where(times > 3.0, times - 2.0, times), poses(z, yaw)
