"""Tries to make the connector fail: random, held and saturated actions, of all six outputs as well as of x and y.

Residual learning is among it for the physics: nothing keeps it within the constraints.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from typing import Any

import numpy as np

from guiderail.diagrams.stations.bnc_workcell import BncWorkcell
from guiderail.models.objects.bnc_interference import interference
from guiderail.models.units import MM
from guiderail.tools.rollouts.rollout import Decision, EnvObserver
from guiderail.tools.stress.campaign import Campaign, Case

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


class Penetration(EnvObserver):
    """How deep jack and plug are within each other at the end of each control step [mm]."""

    def begin(self) -> None:
        """Nothing was measured yet."""
        self._context = self.base.simulator.get_context()
        self._plant = self.base.task.diagram.GetSubsystemByName("station").plant
        self._depths: list[tuple[float, float]] = []

    def see(self, decision: Decision) -> None:
        """Measures."""
        plant_context = self._plant.GetMyContextFromRoot(self._context)
        X_JP = self._plant.GetFrameByName("plug").CalcPose(plant_context, self._plant.GetFrameByName("jack"))
        self._depths.append(interference(_D, X_JP.rotation().matrix(), X_JP.translation()))

    def end(self, row: Mapping[str, Any]) -> Mapping[str, Any]:
        """How deep lugs and barrel were in the plug, and what either didn't come out of for `STANDING` steps."""
        depths = np.array(self._depths) / MM
        windows = np.lib.stride_tricks.sliding_window_view(depths.max(axis=1), min(STANDING, len(depths)))
        return {
            "lug_impact_mm": float(depths[:, 0].max()),
            "barrel_impact_mm": float(depths[:, 1].max()),
            "standing_mm": float(windows.min(axis=1).max()),
        }


def campaign() -> Campaign:
    """Guidance, uncertainty and explored outputs, everything with everything; each episode is a run of its own."""
    kinds = itertools.product(("kgrl", "skgrl", "residual", "safe_residual"), ("calibration", "disc"), EXPLORED)
    cases = [
        Case(
            name=f"{guidance}, {uncertainty}, {outputs}",
            environment={
                "guidance": guidance,
                "uncertainty": uncertainty,
                "explored": EXPLORED[outputs],
                "hold": 1,
            },
            constrained=guidance != "residual",
            options={"new_run": True},
            waits=guidance == "safe_residual",
        )
        for guidance, uncertainty, outputs in kinds
    ]
    cases.append(Case("kmp, disc", {"guidance": "kmp", "uncertainty": "disc"}, False, {"new_run": True}))
    return Campaign("BncConnector", cases, LIMITS, witness=Penetration)
