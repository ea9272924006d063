"""Bodies of the BNC jack and plug: SDF and OBJ files for Drake, convex solids for other physics engines."""

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np

from guiderail.models.common.transforms import MM
from guiderail.models.objects.bnc_connector.geometry import (
    BORE_SIDES,
    FOLDER,
    BncDimensions,
    bore_mesh,
    face_mesh,
    ring_mesh,
    slot_columns,
    slot_mesh,
)
from guiderail.models.objects.sdf import (
    ContactMaterial,
    at,
    box,
    collision,
    cylinder,
    cylindrical,
    equal_area_radius,
    generate_assets,
    mesh,
    model,
    visual,
)
from guiderail.models.objects.surfaces import BELOW, SHOULDER, Box, Cylinder, Hull, Spring, Surface, ring_hulls

BRASS, NICKEL, RUBBER = "0.85 0.65 0.25 1", "0.62 0.64 0.68 1", "0.75 0.20 0.20 1"

FRICTION = 0.2  # friction coefficient of metal on metal
# Distance at which contact with the mouth's face and the slots begins [m]. Without a margin the plug moves into the
# jack for a whole time step, and the next step ejects it. A discrete plant extrapolates the pressure along the normal
# of each contact polygon, so a surface within its margin holds back a plug that would slide past it: a chamfer does,
# with a force that depends on the time step. Chamfer and bore therefore touch a barrel without a margin, and the
# mouth's face, whose normal is the axis, another one.
MARGIN = 0.1 * MM
# Stiffness of brass. A softer barrel distributes the load along the rim, and the torque on a misaligned plug is larger
# than with metal parts (docs/experiments.md, "Center of pressure on the rim").
BARREL = ContactMaterial(friction=FRICTION, modulus=1e11, resolution=1.5 * MM)
LUG = ContactMaterial(friction=FRICTION, modulus=5e9, resolution=0.8 * MM, margin=MARGIN)
PAD = ContactMaterial(friction=0.05, modulus=1e7, resolution=6.0 * MM)  # models the gasket as a soft spring
RING = ContactMaterial(friction=FRICTION)
SEAT = ContactMaterial(friction=0.05)

PLUG_MASS = 0.03  # [kg]

TOUCHING: dict[str, str] = {
    "barrel": "bore", "barrel_end": "face", "lug_0": "slots", "lug_1": "slots", "pad": "seat",
}  # fmt: skip
"""Surface of the plug that each surface of the jack can touch."""


def barrel_sides(dimensions: BncDimensions) -> int:
    """Return the number of sides of Drake's polygon of the barrel; no side is longer than the resolution hint."""
    assert BARREL.resolution is not None
    return int(np.ceil(2.0 * np.pi * dimensions.barrel_radius / BARREL.resolution))


def jack_sdf(dimensions: BncDimensions, friction: float = FRICTION) -> str:
    """Return the jack's model: link `jack` is frame J, with the surfaces of `TOUCHING`.

    `friction` applies to barrel and lugs. The collision geometry of the barrel is a polygon with the area of its
    circle.
    """
    d = dimensions
    barrel_material, lug_material = (replace(metal, friction=friction) for metal in (BARREL, LUG))
    center = at(z=d.barrel_height / 2)
    barrel = cylinder(equal_area_radius(d.barrel_radius, barrel_sides(d)), d.barrel_height)
    pad = (at(z=d.barrel_height + d.pad_height - d.pad_thickness / 2), cylinder(d.pad_radius, d.pad_thickness))
    lug_length = d.lug_tip_radius - d.lug_root_radius
    lug_center = 0.5 * (d.lug_tip_radius + d.lug_root_radius)
    contents = collision("barrel", center, barrel, barrel_material)
    contents += collision("barrel_end", center, barrel, replace(barrel_material, margin=MARGIN))
    contents += visual("barrel_visual", center, cylinder(d.barrel_radius, d.barrel_height), NICKEL)
    contents += collision("pad", *pad, PAD) + visual("pad_visual", *pad, RUBBER)
    for number, side in enumerate((1.0, -1.0)):
        lug = (at(x=side * lug_center, z=d.lug_height, pitch=np.pi / 2), cylinder(d.lug_radius, lug_length))
        contents += collision(f"lug_{number}", *lug, lug_material) + visual(f"lug_{number}_visual", *lug, BRASS)
    return model("jack", 0.05, (0.0, 0.0, d.barrel_height / 2), 5.0 * MM, contents)


def plug_sdf(dimensions: BncDimensions, friction: float = FRICTION) -> str:
    """Return the plug's model: link `plug` is frame P, with the surfaces of `TOUCHING`.

    `friction` applies to all of them but the seat.
    """
    d, ring = dimensions, replace(RING, friction=friction)
    seat = (at(z=d.seat_height + d.seat_thickness / 2), box(d.seat_width, d.seat_width, d.seat_thickness))
    shell = (at(z=d.ring_length + d.shell_length / 2), cylinder(d.shell_radius, d.shell_length))
    contents = "".join(collision(name, at(), mesh(f"bnc_{name}.obj"), ring) for name in ("face", "bore", "slots"))
    contents += collision("seat", *seat, SEAT)
    contents += visual("ring_visual", at(), mesh("bnc_ring.obj"), NICKEL)
    contents += visual("shell_visual", *shell, BRASS)
    return model("plug", PLUG_MASS, (0.0, 0.0, d.ring_length), 8.0 * MM, contents)


def files(dimensions: BncDimensions, friction: float = FRICTION) -> dict[str, str]:
    """Return the content of each file by name; `friction` applies to the metal."""
    return {
        "bnc_face.obj": face_mesh(dimensions).to_obj(),
        "bnc_bore.obj": bore_mesh(dimensions).to_obj(),
        "bnc_slots.obj": slot_mesh(dimensions).to_obj(),
        "bnc_ring.obj": ring_mesh(dimensions).to_obj(),
        "bnc_jack.sdf": jack_sdf(dimensions, friction),
        "bnc_plug.sdf": plug_sdf(dimensions, friction),
    }


def folder_of(dimensions: BncDimensions, friction: float = FRICTION) -> Path:
    """Return the folder with a connector's files: a temporary folder, or this module's for the default arguments."""
    if (dimensions, friction) == (BncDimensions(), FRICTION):
        return FOLDER
    return generate_assets(files, dimensions, friction)


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
    return np.concatenate([cylindrical(radius, angle, height) for radius in (d.bore_radius, d.ring_radius)])


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
