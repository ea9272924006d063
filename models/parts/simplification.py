"""Fewer triangles: decimation with measured deviation, and removal of regions that cannot touch the other part.

Solids are those of `manifold3d`; all lengths are in millimeters.
"""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np

from guiderail.models.common.errors import import_extra
from guiderail.models.parts.solids import measure_deviation, to_arrays

_SLABS = 8  # slabs along z in which a part is cropped
_HULL = 0.5  # fraction of the tolerance by which a part may differ from its hull
_SLIVER = 1e-4  # volume below which a cropped piece is a rounding error [mm³]


def simplify(solid: Any, tolerance: float, start: float = 1.0) -> tuple[Any, float]:
    """Return a solid with fewer triangles, and its measured deviation [mm].

    `manifold3d` may exceed its bound for thin parts. The deviation is therefore measured, and a smaller bound than the
    tolerance [mm] is tried if it is too large. The first bound is the fraction `start` of the tolerance.
    """
    drawn = to_arrays(solid)
    for fraction in (start, 0.3 * start, 0.1 * start):
        simpler = solid.as_original().simplify(fraction * tolerance)
        if simpler.is_empty():
            continue
        deviation = 1e3 * measure_deviation(drawn, to_arrays(simpler))
        if deviation <= tolerance:
            return simpler, deviation
    return solid, 0.0


def count_simplified(solid: Any, tolerance: float) -> int:
    """Return the number of triangles of a solid simplified with `tolerance` [mm]."""
    return int(solid.as_original().simplify(tolerance).num_tri())


def as_hull_if_near(solid: Any, tolerance: float) -> tuple[Any, float]:
    """Return a solid, or its convex hull if within half the `tolerance` [mm], and the deviation from the solid [mm]."""
    hull = solid.hull()
    if hull.volume() - solid.volume() > tolerance * solid.surface_area():
        return solid, 0.0
    deviation = 1e3 * measure_deviation(to_arrays(solid), to_arrays(hull), 2000)
    return (hull, deviation) if deviation < _HULL * tolerance else (solid, 0.0)


def crop_to_contact(part: Any, other: Any, margin: float, turn: float, *, is_plug: bool) -> Any:
    """Return the region of a part that can come within `margin` of the other while the plug moves down along z.

    A slab of the plug above z0 meets only the region of the socket above z0. A slab of the socket below z1 meets only
    the region of the plug below z1. Each slab keeps the projection of that region along z, widened by the margin.

    Args:
        part: Solid to crop.
        other: The other solid at the target.
        margin: Largest distance from the nominal motion [mm].
        turn: Turn of the plug about z at the target [rad].
        is_plug: True if `part` is the plug.
    """
    manifold3d = import_extra("manifold3d")
    low, high = part.bounding_box()[2], part.bounding_box()[5]
    cuts, kept = np.linspace(low, high, _SLABS + 1), []
    turns = np.rad2deg(np.linspace(0.0, turn, 9)) if turn else (0.0,)
    for start, end in itertools.pairwise(cuts):
        plane = ((0, 0, 1), start - margin) if is_plug else ((0, 0, -1), -(end + margin))
        half = other.trim_by_plane(*plane)
        if half.is_empty():
            continue
        outline = half.project().simplify(0.05)
        # The plug is turned by -turn above the target; seen from the plug, the socket turns the other way.
        sign = 1.0 if is_plug else -1.0
        shadow = manifold3d.CrossSection.batch_boolean(
            [outline.rotate(sign * float(angle)) for angle in turns], manifold3d.OpType.Add
        )
        shadow = shadow.offset(margin, manifold3d.JoinType.Round, circular_segments=16).simplify(0.3)
        kept.append(manifold3d.Manifold.extrude(shadow, end - start + 2e-3).translate((0, 0, start - 1e-3)))
    if not kept:
        return part
    cropped = part ^ manifold3d.Manifold.batch_boolean(kept, manifold3d.OpType.Add)
    solid = [one for one in cropped.decompose() if one.volume() > _SLIVER]
    return manifold3d.Manifold.compose(solid) if solid else part
