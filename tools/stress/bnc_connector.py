"""Tries to make the connector fail: random, held and saturated actions, of all six outputs as well as of x and y.

    python -m guiderail.tools.stress.bnc_connector --episodes 1000 --out stress_bnc.csv

Every control step is a decision. Exits with 1 if the simulation failed, anything was not finite, a prediction failed,
KGRL or sKGRL commanded a violation, or the plug went through the jack. Residual learning is among it for the physics:
nothing keeps it within the constraints.
"""

from __future__ import annotations

import itertools
import sys
from collections.abc import Sequence
from functools import partial

import numpy as np

from guiderail.diagrams.env import GuidedEnv
from guiderail.diagrams.stations.bnc_workcell import BncWorkcell
from guiderail.diagrams.stations.station import Station
from guiderail.diagrams.tasks.bnc_connector import MM, make_env
from guiderail.models.objects.bnc_interference import interference
from guiderail.tools.stress.campaign import Case, Witness, run

EXPLORED = {"x, y": (0, 1), "all six": (0, 1, 2, 3, 4, 5)}
STANDING = 5  # control steps that make the difference between an impact and a plug that stands within the jack
_D = BncWorkcell().dimensions
# Compliant surfaces give way. In an impact they may, but a lug whose middle is behind a wall may come out behind it,
# and so may a barrel that is as deep in the ring as the ring is thick. (A plug that drops into its bore bounces.)
LIMITS = {
    "lug_impact_mm": _D.lug_radius / MM,
    "barrel_impact_mm": (_D.ring_radius - _D.bore_radius) / MM,
    "standing_mm": 0.6,
}


class Penetration(Witness):
    """How deep jack and plug are within each other at the end of each control step [mm]."""

    def __init__(self, env: GuidedEnv):
        """
        Args:
            env: just reset.
        """
        self._context = env.simulator.get_context()
        station = env.task.diagram.GetSubsystemByName("station")
        assert isinstance(station, Station)
        self._plant, self._dimensions = station.plant, BncWorkcell().dimensions
        self._depths: list[tuple[float, float]] = []

    def look(self) -> None:
        """Measures."""
        plant_context = self._plant.GetMyContextFromRoot(self._context)
        X_JP = self._plant.GetFrameByName("plug").CalcPose(plant_context, self._plant.GetFrameByName("jack"))
        self._depths.append(interference(self._dimensions, X_JP.rotation().matrix(), X_JP.translation()))

    def report(self) -> dict[str, float]:
        """How deep lugs and barrel were in the plug, and what either didn't come out of for `STANDING` steps."""
        depths = np.array(self._depths) / MM
        windows = np.lib.stride_tricks.sliding_window_view(depths.max(axis=1), min(STANDING, len(depths)))
        return {
            "lug_impact_mm": float(depths[:, 0].max()),
            "barrel_impact_mm": float(depths[:, 1].max()),
            "standing_mm": float(windows.min(axis=1).max()),
        }


def cases(station: str = "rails") -> list[Case]:
    """Guidance, uncertainty and explored outputs, everything with everything; each episode is a run of its own."""
    kinds = itertools.product(("kgrl", "skgrl", "residual"), ("calibration", "disc"), EXPLORED)
    return [
        Case(
            name=f"{guidance}, {uncertainty}, {outputs}",
            make=partial(
                make_env,
                guidance=guidance,
                uncertainty=uncertainty,
                explored=EXPLORED[outputs],
                hold=1,
                station=station,
            ),
            constrained=guidance != "residual",
            options={"new_run": True},
            witness=Penetration,
        )
        for guidance, uncertainty, outputs in kinds
    ]


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line."""
    return run(str(__doc__).splitlines()[0], cases(), arguments, LIMITS)


if __name__ == "__main__":
    sys.exit(main())
