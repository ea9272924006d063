"""BNC bayonet connector at true scale: geometry, and files for Drake.

The jack has two lugs, and the ring of the plug two slots.

Frames. The origin of the jack frame J is the bottom of the barrel's center line; z points along the barrel to its open
end, and x through the lugs. The origin of the plug frame P is the center of the ring's mouth; z points from the mouth
to the cable, and x through the entries of the slots. The plug slides on with X_JP = (0, 0, z), is turned about z by
minus `detent_angle`, and is locked at X_JP = (Rz(-detent_angle), (0, 0, `locked_height`)).

Contact. The ring has open rigid surfaces: the mouth's flat face, and its chamfer with the bore, which collide only with
the barrel, a pair of slots that collide only with the lugs, and the outer wall, for a plug that is moved into the jack
from the side. The first three have a third of the triangles of a closed ring, and their contact is computed five times
faster. A board below the jack keeps a plug from coming under the barrel. The corner between face and chamfer is a lip,
a shallow cone, so that a plug that slides over the rim is not caught. The jack's barrel and lugs are compliant
primitives. A soft pad on the barrel models the gasket, which pushes the lugs into their detents.

`python -m research.generate connector-objects` writes the SDF and OBJ files in this folder.
"""

import itertools
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from guiderail.models.common.transforms import MM
from guiderail.models.objects import sdf
from guiderail.models.objects.sdf import ContactMaterial, TriangleMesh

FOLDER = Path(__file__).parent
JACK_SDF = FOLDER / "bnc_jack.sdf"
PLUG_SDF = FOLDER / "bnc_plug.sdf"
BORE_SIDES = 24  # sides of the polygon that approximates the bore
LIP_WIDTH, LIP_RISE = 0.1 * MM, 0.015 * MM  # size of the lip at the mouth's inner corner [m]


@dataclass(frozen=True)
class BncDimensions:
    """Dimensions in meters and radians; the slot's heights are heights of a lug's center above the mouth."""

    barrel_radius: float = 4.825 * MM
    barrel_height: float = 10.0 * MM
    lug_radius: float = 0.975 * MM
    lug_tip_radius: float = 5.5 * MM  # from the center line to the end of a lug
    lug_root_radius: float = 4.025 * MM  # from the center line to the start of a lug, inside the barrel
    lug_depth: float = 5.5 * MM  # depth of a lug's center below the barrel's open end

    bore_radius: float = 4.925 * MM
    ring_radius: float = 7.0 * MM
    ring_length: float = 9.5 * MM
    mouth_chamfer: float = 0.4 * MM
    slot_clearance: float = 0.125 * MM  # clearance between lug and slot on each side
    slot_depth: float = 0.9 * MM  # radial depth of the slots' walls

    entry_height: float = 3.4 * MM  # upper end of the straight entry
    entry_angle: float = np.deg2rad(6.0)  # angle at which the ramp starts
    apex_height: float = 5.4 * MM
    apex_angle: float = np.deg2rad(78.0)
    detent_height: float = 5.0 * MM
    detent_start_angle: float = np.deg2rad(87.0)
    detent_angle: float = np.deg2rad(90.0)

    pad_radius: float = 3.0 * MM
    pad_height: float = 0.6 * MM  # height of the pad's top above the barrel's open end
    pad_thickness: float = 2.0 * MM
    seat_height: float = 10.7 * MM  # height above the mouth of the plug's face that touches the pad
    seat_width: float = 8.0 * MM
    seat_thickness: float = 2.0 * MM
    shell_radius: float = 5.0 * MM  # radius of the shell, where the tool holds the plug
    shell_length: float = 16.0 * MM

    @property
    def bore_clearance(self) -> float:
        """Clearance between barrel and bore on each side [m]."""
        return round(self.bore_radius - self.barrel_radius, 9)

    def with_bore_clearance(self, clearance: float) -> "BncDimensions":
        """Return the dimensions with the bore's radius changed to another clearance on each side [m]."""
        return self if clearance == self.bore_clearance else replace(self, bore_radius=self.barrel_radius + clearance)

    @property
    def lug_height(self) -> float:
        """Height of the lugs' centers in J [m]."""
        return self.barrel_height - self.lug_depth

    @property
    def locked_height(self) -> float:
        """Height of P in J with the lugs in the detents [m]."""
        return self.lug_height - self.detent_height

    @property
    def slot_radius(self) -> float:
        """Radius at which the slot's outline is unrolled, slightly outside the barrel [m]."""
        return self.barrel_radius + 0.3 * MM

    @property
    def slot_half_width(self) -> float:
        """Radius of the mill that cuts the slot [m]."""
        return self.lug_radius + self.slot_clearance


@dataclass(frozen=True)
class SlotColumns:
    """Unrolled slot: the heights (n,) of the walls below and above it [m] at the angles (n,) [rad]."""

    angles: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    num_entry: int  # columns 0 … num_entry are the entry, which is open towards the mouth


def slot_columns(dimensions: BncDimensions) -> SlotColumns:
    """Return the walls that a mill of radius `slot_half_width` leaves along the lug's path."""
    d = dimensions
    radius, half_width = d.slot_radius, d.slot_half_width
    num_entry, num_ramp, num_end = 6, 14, 3  # columns of each part
    knots = np.array(
        [
            [0.0, 0.0],
            [0.0, d.entry_height],
            [d.entry_angle, d.entry_height],
            [d.apex_angle, d.apex_height],
            [d.detent_start_angle, d.detent_height],
            [d.detent_angle, d.detent_height],
        ]
    ) * [radius, 1.0]
    path = np.concatenate(
        [start + np.linspace(0.0, 1.0, 200)[:, None] * (end - start) for start, end in itertools.pairwise(knots)]
    )
    last = knots[-1, 0]
    arcs = np.concatenate(
        [
            -half_width * np.cos(np.linspace(0.0, np.pi, num_entry + 1)),
            np.linspace(half_width, last, num_ramp + 1)[1:],
            last + half_width * np.sin(np.linspace(0.0, np.pi / 2, num_end + 1))[1:],
        ]
    )

    def walls(arc: float) -> tuple[float, float]:
        distance = np.abs(path[:, 0] - np.clip(arc, -half_width + 1e-9, last + half_width - 1e-9))
        near = distance <= half_width
        reach = np.sqrt(half_width**2 - distance[near] ** 2)
        return float(np.min(path[near, 1] - reach)), float(np.max(path[near, 1] + reach))

    lower, upper = np.array([walls(arc) for arc in arcs]).T
    lower[: num_entry + 1] = walls(half_width + 1e-10)[0]  # the entry's right-hand wall ends where the ramp begins
    lower[-1] = upper[-1] = 0.5 * (lower[-1] + upper[-1])  # the round end of the slot
    return SlotColumns(arcs / radius, lower, upper, num_entry)


def _both_halves(quads: np.ndarray) -> np.ndarray:
    return np.concatenate([quads, quads * [-1.0, -1.0, 1.0]])


def _slot_walls(dimensions: BncDimensions, outer_radius: float, chamfer: float) -> np.ndarray:
    """Return the walls along the slot's outline, from the mouth around the detent and back, as quads (Q, 4, 3) [m]."""
    d, columns = dimensions, slot_columns(dimensions)
    entry_left, entry_right = columns.angles[0], columns.angles[columns.num_entry]
    ramp = slice(columns.num_entry, None)
    outline = np.concatenate(
        [
            [[entry_right + chamfer / d.slot_radius, 0.0], [entry_right, chamfer]],
            np.stack([columns.angles[ramp], columns.lower[ramp]], axis=1),
            np.stack([columns.angles, columns.upper], axis=1)[-2::-1],
            [[entry_left, chamfer], [entry_left - chamfer / d.slot_radius, 0.0]],
        ]
    )
    return sdf.strip(
        sdf.cylindrical(d.bore_radius, outline[:, 0], outline[:, 1]),
        sdf.cylindrical(outer_radius, outline[:, 0], outline[:, 1]),
    )


def _faces_between_entries(
    dimensions: BncDimensions, radii: tuple[float, float], margin: float, height: float, num_sides: int
) -> np.ndarray:
    """Return the half of the mouth's flat face between the entries of the two slots, as quads (Q, 4, 3) [m]."""
    columns = slot_columns(dimensions)
    angles = np.linspace(columns.angles[columns.num_entry] + margin, np.pi + columns.angles[0] - margin, num_sides + 1)
    return sdf.strip(sdf.cylindrical(radii[1], angles, height), sdf.cylindrical(radii[0], angles, height))


def slot_mesh(dimensions: BncDimensions) -> TriangleMesh:
    """Return the mesh that collides with the lugs: walls of the slots, and the mouth's face with chamfered entries."""
    d = dimensions
    outer_radius = d.bore_radius + d.slot_depth
    walls = _slot_walls(d, outer_radius, d.mouth_chamfer)
    face = _faces_between_entries(
        d, (d.bore_radius + d.mouth_chamfer, outer_radius), d.mouth_chamfer / d.slot_radius, 0.0, num_sides=17
    )
    return TriangleMesh.from_quads(_both_halves(np.concatenate([walls, face])))


def face_mesh(dimensions: BncDimensions) -> TriangleMesh:
    """Return the mouth's flat face, from the outer edge of the ring to the lip."""
    return _lathe([(dimensions.ring_radius, 0.0), _lip_edge(dimensions)])


def bore_mesh(dimensions: BncDimensions) -> TriangleMesh:
    """Return the lip at the mouth's face, the chamfer and the wall of the bore."""
    d = dimensions
    corner = (d.bore_radius + d.mouth_chamfer - LIP_RISE, LIP_RISE)
    return _lathe([_lip_edge(d), corner, (d.bore_radius, d.mouth_chamfer), (d.bore_radius, d.ring_length)])


def side_mesh(dimensions: BncDimensions) -> TriangleMesh:
    """Return the outer wall of the ring, above the distance at which its face touches the barrel."""
    return _lathe([(dimensions.ring_radius, dimensions.ring_length), (dimensions.ring_radius, 2.0 * MARGIN)])


def _lip_edge(d: BncDimensions) -> tuple[float, float]:
    return d.bore_radius + d.mouth_chamfer + LIP_WIDTH, 0.0


def _lathe(profile: list[tuple[float, float]]) -> TriangleMesh:
    """Return a surface of revolution whose polygons have the areas of the circles."""
    scale = sdf.equal_area_radius(1.0, BORE_SIDES)
    return sdf.lathe([(radius * scale, height) for radius, height in profile], BORE_SIDES)


def ring_mesh(dimensions: BncDimensions) -> TriangleMesh:
    """Return the visual mesh of the ring, with slots cut through so that the lugs are visible."""
    d, columns = dimensions, slot_columns(dimensions)
    ramp = slice(columns.num_entry, None)
    plain_angles = np.linspace(columns.angles[-1], np.pi + columns.angles[0], 9)

    def shell(angles: np.ndarray, low: np.ndarray | float, high: np.ndarray | float) -> list[np.ndarray]:
        low_in, high_in = (sdf.cylindrical(d.bore_radius, angles, height) for height in (low, high))
        low_out, high_out = (sdf.cylindrical(d.ring_radius, angles, height) for height in (low, high))
        return [sdf.strip(low_in, high_in), sdf.strip(high_out, low_out)]

    radii = (d.bore_radius, d.ring_radius)
    all_angles = np.concatenate([columns.angles, plain_angles[1:]])
    quads = (
        shell(columns.angles, columns.upper, d.ring_length)
        + shell(columns.angles[ramp], 0.0, columns.lower[ramp])
        + shell(plain_angles, 0.0, d.ring_length)
        + [_slot_walls(d, d.ring_radius, chamfer=0.0)]
        + [_faces_between_entries(d, radii, 0.0, 0.0, num_sides=24)]
        + [
            sdf.strip(
                sdf.cylindrical(radii[0], all_angles, d.ring_length),
                sdf.cylindrical(radii[1], all_angles, d.ring_length),
            )
        ]
    )
    return TriangleMesh.from_quads(_both_halves(np.concatenate(quads)))


BRASS, NICKEL, RUBBER = "0.85 0.65 0.25 1", "0.62 0.64 0.68 1", "0.75 0.20 0.20 1"

FRICTION = 0.2  # friction coefficient of metal on metal
# Distance at which contact with the mouth's face and the slots begins [m]. Without a margin the plug moves into the
# jack for a whole time step, and the next step ejects it. A discrete plant extrapolates the pressure along the normal
# of each contact polygon, so a surface within its margin holds back a plug that would slide past it: a chamfer does,
# with a force that depends on the time step. Chamfer and bore therefore touch a barrel without a margin, and the
# mouth's face, whose normal is the axis, another one.
MARGIN = 0.1 * MM
# With 100 s/m, no part leaves a contact faster than 10 mm/s. With less, a plug that slips off the rim and meets the
# bore within one time step, without a margin, is ejected: at half the friction with 94 N (docs/experiments.md,
# "Converged contact of the connector").
DISSIPATION = 100.0
# The stiffness with which drag on the rim is the friction at time steps of 2.5 to 10 ms. The end has that of brass: a
# softer one distributes the load along the rim, and the torque on a misaligned plug is larger than with metal parts
# (docs/experiments.md, "Center of pressure on the rim").
BARREL = ContactMaterial(friction=FRICTION, modulus=3e10, resolution=1.5 * MM, dissipation=DISSIPATION)
BARREL_END = replace(BARREL, modulus=1e11, margin=MARGIN)
LUG = ContactMaterial(friction=FRICTION, modulus=5e9, resolution=0.8 * MM, dissipation=DISSIPATION, margin=MARGIN)
PAD = ContactMaterial(friction=0.05, modulus=1e7, resolution=6.0 * MM)  # models the gasket as a soft spring
RING = ContactMaterial(friction=FRICTION)
SEAT = ContactMaterial(friction=0.05)
BOARD = ContactMaterial(friction=FRICTION, modulus=3e8, resolution=40.0 * MM, dissipation=DISSIPATION, margin=MARGIN)
BOARD_SIZE, BOARD_DEPTH = (80.0 * MM, 80.0 * MM, 10.0 * MM), 2.0 * MM  # size, and distance below the jack [m]

PLUG_MASS = 0.03  # [kg]

# Without the side, the face entered the barrel from outside at any depth, and its contact, which only lifts, threw the
# plug out: the face's normal is perpendicular to the gradient of the barrel's pressure, which Drake accepts.
TOUCHING: dict[str, tuple[str, ...]] = {
    "barrel": ("bore",), "barrel_end": ("face",), "lug_0": ("slots", "side"), "lug_1": ("slots", "side"),
    "pad": ("seat",), "barrel_side": ("side",), "board": ("face",),
}  # fmt: skip
"""Surfaces of the plug that each surface of the jack can touch."""


def barrel_sides(dimensions: BncDimensions) -> int:
    """Return the number of sides of Drake's polygon of the barrel; no side is longer than the resolution hint."""
    assert BARREL.resolution is not None
    return int(np.ceil(2.0 * np.pi * dimensions.barrel_radius / BARREL.resolution))


def jack_sdf(dimensions: BncDimensions, friction: float = FRICTION) -> str:
    """Return the jack's model: link `jack` is frame J, with the surfaces of `TOUCHING`.

    `friction` applies to barrel, lugs and board. The collision geometry of the barrel is a polygon with the area of its
    circle.
    """
    d = dimensions
    side, end, lug_material, board = (
        replace(material, friction=friction) for material in (BARREL, BARREL_END, LUG, BOARD)
    )
    center = sdf.at(z=d.barrel_height / 2)
    barrel = sdf.cylinder(sdf.equal_area_radius(d.barrel_radius, barrel_sides(d)), d.barrel_height)
    pad = (sdf.at(z=d.barrel_height + d.pad_height - d.pad_thickness / 2), sdf.cylinder(d.pad_radius, d.pad_thickness))
    lug_length = d.lug_tip_radius - d.lug_root_radius
    lug_center = 0.5 * (d.lug_tip_radius + d.lug_root_radius)
    contents = sdf.collision("barrel", center, barrel, side)
    contents += sdf.collision("barrel_end", center, barrel, end)
    contents += sdf.visual("barrel_visual", center, sdf.cylinder(d.barrel_radius, d.barrel_height), NICKEL)
    contents += sdf.collision("pad", *pad, PAD) + sdf.visual("pad_visual", *pad, RUBBER)
    for number, sign in enumerate((1.0, -1.0)):
        lug = (sdf.at(x=sign * lug_center, z=d.lug_height, pitch=np.pi / 2), sdf.cylinder(d.lug_radius, lug_length))
        contents += sdf.collision(f"lug_{number}", *lug, lug_material) + sdf.visual(f"lug_{number}_visual", *lug, BRASS)
    contents += sdf.collision("barrel_side", center, barrel, replace(side, margin=MARGIN))
    contents += sdf.collision("board", sdf.at(z=-BOARD_DEPTH - BOARD_SIZE[2] / 2), sdf.box(*BOARD_SIZE), board)
    return sdf.model("jack", 0.05, (0.0, 0.0, d.barrel_height / 2), 5.0 * MM, contents)


def plug_sdf(dimensions: BncDimensions, friction: float = FRICTION) -> str:
    """Return the plug's model: link `plug` is frame P, with the surfaces of `TOUCHING`.

    `friction` applies to all of them but the seat.
    """
    d, ring = dimensions, replace(RING, friction=friction)
    seat = (sdf.at(z=d.seat_height + d.seat_thickness / 2), sdf.box(d.seat_width, d.seat_width, d.seat_thickness))
    shell = (sdf.at(z=d.ring_length + d.shell_length / 2), sdf.cylinder(d.shell_radius, d.shell_length))
    contents = "".join(
        sdf.collision(name, sdf.at(), sdf.mesh(f"bnc_{name}.obj"), ring) for name in ("face", "bore", "slots")
    )
    contents += sdf.collision("seat", *seat, SEAT)
    contents += sdf.collision("side", sdf.at(), sdf.mesh("bnc_side.obj"), ring)
    contents += sdf.visual("ring_visual", sdf.at(), sdf.mesh("bnc_ring.obj"), NICKEL)
    contents += sdf.visual("shell_visual", *shell, BRASS)
    return sdf.model("plug", PLUG_MASS, (0.0, 0.0, d.ring_length), 8.0 * MM, contents)


def files(dimensions: BncDimensions, friction: float = FRICTION) -> dict[str, str]:
    """Return the content of each file by name; `friction` applies to the metal."""
    return {
        "bnc_face.obj": face_mesh(dimensions).to_obj(),
        "bnc_bore.obj": bore_mesh(dimensions).to_obj(),
        "bnc_slots.obj": slot_mesh(dimensions).to_obj(),
        "bnc_side.obj": side_mesh(dimensions).to_obj(),
        "bnc_ring.obj": ring_mesh(dimensions).to_obj(),
        "bnc_jack.sdf": jack_sdf(dimensions, friction),
        "bnc_plug.sdf": plug_sdf(dimensions, friction),
    }


def folder_of(dimensions: BncDimensions, friction: float = FRICTION) -> Path:
    """Return the folder with a connector's files: a temporary folder, or this module's for the default arguments."""
    if (dimensions, friction) == (BncDimensions(), FRICTION):
        return FOLDER
    return sdf.generate_assets(files, dimensions, friction)
