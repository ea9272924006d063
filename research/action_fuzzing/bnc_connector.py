"""Tries to make the connector fail: random, held and saturated actions, of all six outputs as well as of x and y.

Residual learning is among it for the physics: nothing keeps it within the constraints.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from typing import Any

import numpy as np

from guiderail.diagrams.tasks.bnc_connector.workcell import BncWorkcell
from guiderail.models.common.units import MM
from guiderail.models.objects.bnc_connector.geometry import BncDimensions
from guiderail.tools.evaluation.rollout import EnvCallback, Transition
from research.action_fuzzing.campaign import Campaign, Case


def interference(dimensions: BncDimensions, R_JP: np.ndarray, p_JP: np.ndarray) -> tuple[float, float]:
    """How deep [m] the deeper lug, and the barrel's end, are inside of the plug's walls; 0 where they are not.

    As on the drawing: rigid, the slot unrolled. The gasket's pad is soft and not counted. Of the barrel, its end is
    looked at, so that a plug is taken to be roughly upright.

    Args:
        dimensions: the drawing.
        R_JP: the plug's orientation in the jack's frame, (3, 3).
        p_JP: its mouth's centre there, (3,) [m].
    """
    d = dimensions
    reach = d.slot_radius
    lugs_J = np.array([[reach, 0.0, d.lug_height], [-reach, 0.0, d.lug_height], [0.0, 0.0, d.barrel_height]])
    lug, other_lug, barrel_end = (lugs_J - p_JP) @ R_JP
    return float(max(_lug_inside(d, lug), _lug_inside(d, other_lug))), float(_barrel_inside(d, barrel_end))


def _lug_inside(d: BncDimensions, p_P: np.ndarray) -> float:
    """A lug may be before the mouth's face, or where the mill went that cut one of the two slots."""
    beyond_face = p_P[2] + d.lug_radius
    if beyond_face <= 0.0:
        return 0.0
    # Both slots are alike. An angle that is nearer to the other slot's entry than to this one's end counts there.
    angle = np.arctan2(p_P[1], p_P[0]) % np.pi
    if angle > 0.5 * (np.pi + d.detent_angle):
        angle -= np.pi
    beside_slot = _distance(slot_path(d), np.array([angle * d.slot_radius, p_P[2]])) - d.slot_clearance
    return max(0.0, min(beyond_face, beside_slot))


def _barrel_inside(d: BncDimensions, p_P: np.ndarray) -> float:
    """The barrel's end may be before the mouth's face, in the bore or its chamfer, or beside the plug."""
    off_axis = float(np.hypot(p_P[0], p_P[1]))
    in_bore = d.bore_radius - d.barrel_radius + max(0.0, d.mouth_chamfer - p_P[2])
    beside_plug = d.ring_radius + d.barrel_radius
    return max(0.0, min(p_P[2], off_axis - in_bore, beside_plug - off_axis))


def slot_path(dimensions: BncDimensions) -> np.ndarray:
    """Corners (k, 2) of the lug's path, unrolled: arc and depth from the mouth [m]. It begins well outside."""
    d = dimensions
    corners = [
        [0.0, -d.ring_length],
        [0.0, d.entry_height],
        [d.entry_angle, d.entry_height],
        [d.apex_angle, d.apex_height],
        [d.detent_start_angle, d.detent_height],
        [d.detent_angle, d.detent_height],
    ]
    return np.array(corners) * [d.slot_radius, 1.0]


def _distance(corners: np.ndarray, point: np.ndarray) -> float:
    """From a point (2,) to the nearest of the lines between corners (k, 2)."""
    starts, sides = corners[:-1], np.diff(corners, axis=0)
    along = np.clip(((point - starts) * sides).sum(1) / (sides**2).sum(1), 0.0, 1.0)
    return float(np.linalg.norm(starts + along[:, None] * sides - point, axis=1).min())


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


class Penetration(EnvCallback):
    """How deep jack and plug are within each other at the end of each control step [mm]."""

    def on_episode_start(self) -> None:
        """Nothing was measured yet."""
        self._context = self.base.simulator.get_context()
        self._plant = self.base.task.diagram.GetSubsystemByName("station").plant
        self._depths: list[tuple[float, float]] = []

    def on_step(self, decision: Transition) -> None:
        """Measures."""
        plant_context = self._plant.GetMyContextFromRoot(self._context)
        X_JP = self._plant.GetFrameByName("plug").CalcPose(plant_context, self._plant.GetFrameByName("jack"))
        self._depths.append(interference(_D, X_JP.rotation().matrix(), X_JP.translation()))

    def on_episode_end(self, row: Mapping[str, Any]) -> Mapping[str, Any]:
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
    kinds = itertools.product(("kgrl", "skgrl", "residual", "safe_residual"), ("per_run", "per_episode"), EXPLORED)
    cases = [
        Case(
            name=f"{guidance}, {fixture_offset}, {outputs}",
            environment={
                "guidance": guidance,
                "fixture_offset": fixture_offset,
                "action_dims": EXPLORED[outputs],
                "action_repeat": 1,
            },
            constrained=guidance != "residual",
            options={"new_run": True},
            waits=guidance == "safe_residual",
        )
        for guidance, fixture_offset, outputs in kinds
    ]
    cases.append(Case("kmp, disc", {"guidance": "kmp", "fixture_offset": "per_episode"}, False, {"new_run": True}))
    return Campaign("BncConnector", cases, LIMITS, witness=Penetration)
