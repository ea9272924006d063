"""Fuzzing of the connector: random, repeated and saturated actions in x and y, and in all six outputs.

Residual RL and the demonstrations alone are not constrained: their episodes test only the simulation.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from typing import Any

import numpy as np

from guiderail.diagrams.tasks.bnc_connector import BncWorkcell
from guiderail.models.common.transforms import MM
from guiderail.models.objects.bnc_connector import BncDimensions
from guiderail.tools.evaluation.episode import EnvCallback, Transition
from research.action_fuzzing.campaign import Campaign, Case


def interference(dimensions: BncDimensions, R_JP: np.ndarray, p_JP: np.ndarray) -> tuple[float, float]:
    """Compute the penetration depths of the rigid geometry: of the deeper lug and of the barrel's end [m].

    The slot is unrolled. The gasket's pad is soft and is ignored. Of the barrel, only the end is checked, which is
    sufficient for an almost upright plug.

    Args:
        dimensions: Dimensions of the connector.
        R_JP: Orientation of the plug in the jack's frame, (3, 3).
        p_JP: Center of the plug's mouth in the jack's frame, (3,) [m].

    Returns:
        Both depths, 0 without penetration.
    """
    d = dimensions
    reach = d.slot_radius
    lugs_J = np.array([[reach, 0.0, d.lug_height], [-reach, 0.0, d.lug_height], [0.0, 0.0, d.barrel_height]])
    lug, other_lug, barrel_end = (lugs_J - p_JP) @ R_JP
    return float(max(_lug_inside(d, lug), _lug_inside(d, other_lug))), float(_barrel_inside(d, barrel_end))


def _lug_inside(d: BncDimensions, p_P: np.ndarray) -> float:
    """Return the penetration depth [m] of a lug with center `p_P` (3,) [m]; 0 before the mouth's face and in a slot."""
    beyond_face = p_P[2] + d.lug_radius
    if beyond_face <= 0.0:
        return 0.0
    # The slots are equal. A lug whose angle is nearer to the other slot's entry than to this slot's end belongs there.
    angle = np.arctan2(p_P[1], p_P[0]) % np.pi
    if angle > 0.5 * (np.pi + d.detent_angle):
        angle -= np.pi
    from_slot = _distance(slot_path(d), np.array([angle * d.slot_radius, p_P[2]])) - d.slot_clearance
    return max(0.0, min(beyond_face, from_slot))


def _barrel_inside(d: BncDimensions, p_P: np.ndarray) -> float:
    """Return the penetration depth [m] of the barrel's end at `p_P` (3,) [m]; 0 outside of the ring's material."""
    off_axis = float(np.hypot(p_P[0], p_P[1]))
    in_bore = d.bore_radius - d.barrel_radius + max(0.0, d.mouth_chamfer - p_P[2])
    outside_plug = d.ring_radius + d.barrel_radius
    return max(0.0, min(p_P[2], off_axis - in_bore, outside_plug - off_axis))


def slot_path(dimensions: BncDimensions) -> np.ndarray:
    """Return the corners (k, 2) of the lug's unrolled path, from outside: arc length and depth from the mouth [m]."""
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
    """Return the distance [m] of a point (2,) [m] to the nearest segment between corners (k, 2) [m]."""
    starts, sides = corners[:-1], np.diff(corners, axis=0)
    along = np.clip(((point - starts) * sides).sum(1) / (sides**2).sum(1), 0.0, 1.0)
    return float(np.linalg.norm(starts + along[:, None] * sides - point, axis=1).min())


ACTION_DIMS = {"x, y": (0, 1), "all six": (0, 1, 2, 3, 4, 5)}
STANDING_STEPS = 5  # number of actions for which a penetration has to last to count as standing, not as an impact
_D = BncWorkcell().dimensions
# Compliant surfaces deform in an impact. Beyond these depths, a body could pass through a wall: the center of a lug
# would be inside the wall, or a barrel as deep in the ring as the ring is thick.
LIMITS = {
    "lug_impact_mm": _D.lug_radius / MM,
    "barrel_impact_mm": (_D.ring_radius - _D.bore_radius) / MM,
    "standing_mm": 0.6,
}


class Penetration(EnvCallback):
    """Callback that records the penetration depths of jack and plug [m] at the end of each action."""

    def on_episode_start(self) -> None:
        """Clear the recorded depths."""
        self._context = self.base.simulator.get_context()
        self._plant = self.base.diagram.diagram.GetSubsystemByName("station").plant
        self._depths: list[tuple[float, float]] = []

    def on_step(self, transition: Transition) -> None:
        """Record the depths."""
        plant_context = self._plant.GetMyContextFromRoot(self._context)
        X_JP = self._plant.GetFrameByName("plug").CalcPose(plant_context, self._plant.GetFrameByName("jack"))
        self._depths.append(interference(_D, X_JP.rotation().matrix(), X_JP.translation()))

    def on_episode_end(self, row: Mapping[str, Any]) -> Mapping[str, Any]:
        """Return the largest depths of lug and barrel and the largest that lasted for `STANDING_STEPS` actions [mm]."""
        depths = np.array(self._depths) / MM
        windows = np.lib.stride_tricks.sliding_window_view(depths.max(axis=1), min(STANDING_STEPS, len(depths)))
        return {
            "lug_impact_mm": float(depths[:, 0].max()),
            "barrel_impact_mm": float(depths[:, 1].max()),
            "standing_mm": float(windows.min(axis=1).max()),
        }


def campaign() -> Campaign:
    """Return the campaign of all cases: guidance, fixture offset and action dims. Each episode begins a new run."""
    kinds = itertools.product(("kgrl", "skgrl", "residual", "safe_residual"), ("per_run", "per_episode"), ACTION_DIMS)
    cases = [
        Case(
            name=f"{guidance}, {fixture_offset}, {outputs}",
            environment={
                "guidance": guidance,
                "fixture_offset": fixture_offset,
                "action_dims": ACTION_DIMS[outputs],
                "action_repeat": 1,
            },
            constrained=guidance != "residual",
            options={"new_run": True},
            may_wait=guidance == "safe_residual",
        )
        for guidance, fixture_offset, outputs in kinds
    ]
    cases.append(
        Case("kmp, per_episode", {"guidance": "kmp", "fixture_offset": "per_episode"}, False, {"new_run": True})
    )
    return Campaign("BncConnector", cases, LIMITS, make_callback=Penetration)
