"""Convex solids of the BNC connector; `guiderail.models.objects.bnc_connector` describes its frames."""

import itertools

import numpy as np

from guiderail.diagrams.stations.workcell import Box, Cylinder, Hull, Spring, Surface
from guiderail.models.objects import sdf
from guiderail.models.objects.bnc_connector import BORE_SIDES, FRICTION, PAD, BncDimensions, slot_columns
from guiderail_mujoco.ring import BELOW, SHOULDER, ring_hulls

MAX_ANGLE = np.deg2rad(6.0)  # largest angle of a prism between the slots; its face is then 7 µm inside the circle
# The gasket is a rigid disc on a spring. Up to a compression of 0.6 mm, its force differs from the force of Drake's pad
# by at most 20 %.
PAD_STIFFNESS = 1.5e5  # [N/m]


def jack_surfaces(dimensions: BncDimensions, friction: float = FRICTION) -> list[Surface]:
    """Return the collision geometry of the jack in its frame J."""
    d = dimensions
    shape = Cylinder(d.barrel_radius, d.barrel_height)
    barrel = Surface("barrel", "bore", shape, friction, (0.0, 0.0, d.barrel_height / 2))
    shape, center = Cylinder(d.pad_radius, d.pad_thickness), d.barrel_height + d.pad_height - d.pad_thickness / 2
    spring = Spring((0.0, 0.0, 1.0), PAD_STIFFNESS)
    pad = Surface("pad", "pad", shape, PAD.friction, (0.0, 0.0, center), spring=spring)
    center = 0.5 * (d.lug_tip_radius + d.lug_root_radius)
    shape = Cylinder(d.lug_radius, d.lug_tip_radius - d.lug_root_radius)
    lugs = [
        Surface(f"lug_{number}", "slots", shape, friction, (side * center, 0.0, d.lug_height), pitch=np.pi / 2)
        for number, side in enumerate((1.0, -1.0))
    ]
    return [barrel, pad, *lugs]


def plug_surfaces(dimensions: BncDimensions, friction: float = FRICTION) -> list[Surface]:
    """Return the collision geometry of the plug in its frame P."""
    d = dimensions
    surfaces = [
        Surface(f"{pair}_{number}", pair, Hull(vertices), friction)
        for pair, hulls in (("bore", bore_hulls(d)), ("slots", slot_hulls(d)))
        for number, vertices in enumerate(hulls)
    ]
    seat = (0.0, 0.0, d.seat_height + d.seat_thickness / 2)
    return [*surfaces, Surface("seat", "pad", Box(d.seat_width, d.seat_width, d.seat_thickness), PAD.friction, seat)]


def bore_hulls(dimensions: BncDimensions) -> list[np.ndarray]:
    """Return the vertices (20, 3) [m] of the convex pieces of the ring, whose polygons enclose the bore."""
    d = dimensions
    profile = [
        [d.bore_radius + d.mouth_chamfer, 0.0],
        [d.ring_radius, 0.0],
        [d.ring_radius, d.ring_length],
        [d.bore_radius, d.ring_length],
        [d.bore_radius, d.mouth_chamfer],
    ]
    return ring_hulls(np.array(profile), BORE_SIDES)


def slot_hulls(dimensions: BncDimensions) -> list[np.ndarray]:
    """Return the vertices (V, 3) [m] of the convex pieces of the ring with both slots cut.

    The pieces are prisms over, under and between the slots.
    """
    outlines = [*_over_the_slot(dimensions), *_under_the_ramp(dimensions), *_between_the_slots(dimensions)]
    return [_prism(np.array(outline) + [turn, 0.0], dimensions) for turn in (0.0, np.pi) for outline in outlines]


Outline = list[list[float]]
"""Corners [angle [rad], height [m]] of a prism in any order."""


def _prism(outline: np.ndarray, d: BncDimensions) -> np.ndarray:
    angle, height = outline.T
    return np.concatenate([sdf.cylindrical(radius, angle, height) for radius in (d.bore_radius, d.ring_radius)])


def _over_the_slot(d: BncDimensions) -> list[Outline]:
    columns = slot_columns(d)
    a, wall = columns.angles, columns.upper
    return [
        [[a[i], wall[i]], [a[i + 1], wall[i + 1]], [a[i + 1], d.ring_length], [a[i], d.ring_length]]
        + _shoulders(d, a, wall, i, facing=-1.0)
        for i in range(len(a) - 1)
    ]


def _under_the_ramp(d: BncDimensions) -> list[Outline]:
    columns = slot_columns(d)
    a, wall, first = columns.angles, columns.lower, columns.num_entry
    wide, chamfer = SHOULDER / d.slot_radius, d.mouth_chamfer / d.slot_radius
    outlines = []
    for i in range(first, len(a) - 1):
        outline = [[a[i + 1], 0.0], [a[i + 1], wall[i + 1]], [a[i], wall[i]], [a[i + 1] + wide, BELOW]]
        if i == first:  # chamfer at the entry
            outline += [[a[i], d.mouth_chamfer], [a[i] + chamfer, 0.0]]
        else:
            outline += [[a[i], 0.0], [a[i] - wide, BELOW]]
        outlines.append(outline + _shoulders(d, a, wall, i, facing=1.0, left=i != first))
    return outlines


def _between_the_slots(d: BncDimensions) -> list[Outline]:
    """Return prisms from the end of one slot to the chamfered entry of the other slot."""
    angles, top = slot_columns(d).angles, d.ring_length
    wide, chamfer = SHOULDER / d.slot_radius, d.mouth_chamfer / d.slot_radius
    begin, end = angles[-1], np.pi + angles[0]
    edges = np.linspace(begin, end, 2 + int((end - begin) / MAX_ANGLE))
    outlines = []
    for left, right in itertools.pairwise(edges):
        outline = [[left, 0.0], [right, top], [left, top]]
        if left != begin:
            outline += [[left - wide, BELOW]]
        if right == end:
            outline += [[right - chamfer, 0.0], [right, d.mouth_chamfer]]
        else:
            outline += [[right, 0.0], [right + wide, BELOW]]
        outlines.append(outline)
    return outlines


def _shoulders(d: BncDimensions, a: np.ndarray, wall: np.ndarray, i: int, facing: float, left: bool = True) -> Outline:
    """Return the shoulders of the edge from column i to i + 1 of a wall; `facing` is 1 for up and −1 for down."""
    wide, h = SHOULDER / d.slot_radius, facing * wall
    slope = (h[i + 1] - h[i]) / (a[i + 1] - a[i])
    # A shoulder is below the line of the edge and below the wall; the right one is also below the edge's right end.
    right_surface = min(np.interp(a[i + 1] + wide, a, h), h[i + 1])
    points = [[a[i + 1] + wide, facing * (min(h[i + 1] + slope * wide, right_surface) - BELOW)]]
    if left:
        left_surface = np.interp(a[i] - wide, a, h)
        points.append([a[i] - wide, facing * (min(h[i] - slope * wide, left_surface) - BELOW)])
    return points
