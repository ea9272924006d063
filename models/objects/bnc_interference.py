"""How far a jack and a plug stand within each other: what a simulation must keep small, whatever pushes them."""

from __future__ import annotations

import numpy as np

from guiderail.models.objects.bnc_connector import BncDimensions


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
