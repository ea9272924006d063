"""Geometry of a BNC bayonet connector at true scale: a jack with two lugs and a plug whose ring has two slots.

Frames. The origin of the jack frame J is the bottom of the barrel's center line; z points along the barrel to its open
end, and x through the lugs. The origin of the plug frame P is the center of the ring's mouth; z points from the mouth
to the cable, and x through the entries of the slots. The plug slides on with X_JP = (0, 0, z), is turned about z by
minus `detent_angle`, and is locked at X_JP = (Rz(-detent_angle), (0, 0, `locked_height`)).

Contact. The ring has three open rigid surfaces: the mouth's flat face, and its chamfer with the bore, which collide
only with the barrel, and a pair of slots that collide only with the lugs. These surfaces have a third of the triangles
of a closed ring, and their contact is computed five times faster. The corner between face and chamfer is a lip, a
shallow cone, so that a plug that slides over the rim is not caught. The jack's barrel and lugs are compliant
primitives. A soft pad on the barrel models the gasket, which pushes the lugs into their detents.

`python -m research.generate connector-objects` writes the SDF and OBJ files in this folder.
"""

import itertools
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from guiderail.models.common.transforms import MM
from guiderail.models.objects.sdf import TriangleMesh, cylindrical, equal_area_radius, lathe, strip

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
    return strip(
        cylindrical(d.bore_radius, outline[:, 0], outline[:, 1]),
        cylindrical(outer_radius, outline[:, 0], outline[:, 1]),
    )


def _faces_between_entries(
    dimensions: BncDimensions, radii: tuple[float, float], margin: float, height: float, num_sides: int
) -> np.ndarray:
    """Return the half of the mouth's flat face between the entries of the two slots, as quads (Q, 4, 3) [m]."""
    columns = slot_columns(dimensions)
    angles = np.linspace(columns.angles[columns.num_entry] + margin, np.pi + columns.angles[0] - margin, num_sides + 1)
    return strip(cylindrical(radii[1], angles, height), cylindrical(radii[0], angles, height))


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


def _lip_edge(d: BncDimensions) -> tuple[float, float]:
    return d.bore_radius + d.mouth_chamfer + LIP_WIDTH, 0.0


def _lathe(profile: list[tuple[float, float]]) -> TriangleMesh:
    """Return a surface of revolution whose polygons have the areas of the circles."""
    scale = equal_area_radius(1.0, BORE_SIDES)
    return lathe([(radius * scale, height) for radius, height in profile], BORE_SIDES)


def ring_mesh(dimensions: BncDimensions) -> TriangleMesh:
    """Return the visual mesh of the ring, with slots cut through so that the lugs are visible."""
    d, columns = dimensions, slot_columns(dimensions)
    ramp = slice(columns.num_entry, None)
    plain_angles = np.linspace(columns.angles[-1], np.pi + columns.angles[0], 9)

    def shell(angles: np.ndarray, low: np.ndarray | float, high: np.ndarray | float) -> list[np.ndarray]:
        low_in, high_in = (cylindrical(d.bore_radius, angles, height) for height in (low, high))
        low_out, high_out = (cylindrical(d.ring_radius, angles, height) for height in (low, high))
        return [strip(low_in, high_in), strip(high_out, low_out)]

    radii = (d.bore_radius, d.ring_radius)
    all_angles = np.concatenate([columns.angles, plain_angles[1:]])
    quads = (
        shell(columns.angles, columns.upper, d.ring_length)
        + shell(columns.angles[ramp], 0.0, columns.lower[ramp])
        + shell(plain_angles, 0.0, d.ring_length)
        + [_slot_walls(d, d.ring_radius, chamfer=0.0)]
        + [_faces_between_entries(d, radii, 0.0, 0.0, num_sides=24)]
        + [strip(cylindrical(radii[0], all_angles, d.ring_length), cylindrical(radii[1], all_angles, d.ring_length))]
    )
    return TriangleMesh.from_quads(_both_halves(np.concatenate(quads)))
