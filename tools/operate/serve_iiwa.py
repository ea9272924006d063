"""`guiderail serve-iiwa`: a simulated iiwa at the other end of LCM, in a process of its own."""

import numpy as np
from pydrake.lcm import DrakeLcm

from guiderail.diagrams.stations.bnc_workcell import BncWorkcell
from guiderail.diagrams.stations.hardware import SimulatedIiwa, serve

START = np.array([0.0, 0.0, 0.02, np.pi / 2, 0.0, 0.0])  # the plug above the jack


def serve_iiwa(url: str, seconds: float, patience: float) -> bool:
    """Serves the arm in front of a BNC jack; whether commands kept coming until the end.

    Args:
        url: LCM's; its own default where it is empty.
        seconds: of simulated time.
        patience: how long to wait for a command [s].
    """
    lcm = DrakeLcm(url)
    return serve(SimulatedIiwa(BncWorkcell(), lcm), lcm, START, seconds, patience) >= seconds
