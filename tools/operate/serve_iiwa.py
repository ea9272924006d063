"""A simulated iiwa at the other end of LCM, in a process of its own: `python -m guiderail.tools.operate.serve_iiwa`."""

from __future__ import annotations

import argparse
import sys

import numpy as np
from pydrake.lcm import DrakeLcm

from guiderail.diagrams.stations.bnc_workcell import BncWorkcell
from guiderail.diagrams.stations.hardware import SimulatedIiwa, serve

START = np.array([0.0, 0.0, 0.02, np.pi / 2, 0.0, 0.0])  # the plug above the jack


def main(arguments: list[str] | None = None) -> int:
    """Serves the arm in front of a BNC jack; returns 0 if commands kept coming until the end."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--url", default="", help="LCM URL; LCM's own default unless given")
    parser.add_argument("--seconds", type=float, default=3600.0, help="of simulated time")
    parser.add_argument("--patience", type=float, default=5.0, help="how long to wait for a command [s]")
    options = parser.parse_args(arguments)
    lcm = DrakeLcm(options.url)
    ended = serve(SimulatedIiwa(BncWorkcell(), lcm), lcm, START, options.seconds, options.patience)
    return 0 if ended >= options.seconds else 1


if __name__ == "__main__":
    sys.exit(main())
