"""Grid clamp with five pegs and the part of a table with the holes: geometry, and files for Drake.

Frames. The table's frame G lies in its surface at the center of the middle hole, z up. The clamp's frame C lies at the
tip of the middle peg, z up along the peg. The clamp has snapped in at X_GC = (0, 0, −`peg_length`), with its shoulder
on the table.

Contact. Every hole is an open rigid surface that collides only with its own peg. It consists of the face around the
hole, a chamfer and a short wall; a wall of the hole's full depth would take half of the simulation time. Pegs are
compliant convex solids with as many sides as their holes, so that the clearance is exact with few triangles. The middle
hole has a lip and the middle peg a soft bead, which must pass the lip: the resistance rises, falls, and then retains
the clamp. The body is a soft pad, thick enough for impacts, that collides only with the table's slab.

`python -m research.generate clamp-objects` writes the SDF and OBJ files in this folder.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from guiderail.models.common.transforms import MM
from guiderail.models.objects import sdf
from guiderail.models.objects.sdf import ContactMaterial, TriangleMesh

FOLDER = Path(__file__).parent
CLAMP_SDF = FOLDER / "grid_clamp.sdf"
TABLE_SDF = FOLDER / "grid_table.sdf"
NUM_SIDES = 6  # sides of a polygon in collision geometry
NUM_VISUAL_SIDES = 12  # sides of a polygon in visual geometry


@dataclass(frozen=True)
class GridClampDimensions:
    """Dimensions in meters. Radii are of the circles inside the polygons; depths are measured from the table's face."""

    peg_radius: float = 4.0 * MM
    peg_length: float = 12.0 * MM  # from the shoulder to the tip
    peg_chamfer: float = 0.6 * MM
    spacing: float = 20.0 * MM  # distance of the outer pegs from the middle one along x and along y

    hole_radius: float = 4.15 * MM
    hole_chamfer: float = 0.5 * MM
    hole_land: float = 3.0 * MM  # depth to which the collision geometry of the wall reaches
    hole_depth: float = 13.0 * MM
    face_radius: float = 14.0 * MM  # radius of the face around a hole, for a misaligned peg

    lip_radius: float = 4.15 * MM
    lip_depth: float = 0.6 * MM  # depth of the upper end of the narrow part
    lip_land: float = 0.4 * MM  # height of the narrow part
    lip_flank: float = 0.4 * MM  # size of the flanks, at 45 degrees
    bead_radius: float = 4.35 * MM
    bead_depth: float = 1.5 * MM  # depth of the bead's crest with the shoulder on the table
    bead_entry: float = 1.2 * MM  # length of the flank that touches the lip first
    bead_exit: float = 0.6 * MM

    shoulder_width: float = 56.0 * MM
    body_height: float = 8.0 * MM
    table_width: float = 96.0 * MM
    table_thickness: float = 14.0 * MM

    @property
    def clearance(self) -> float:
        """Clearance between a peg and its hole on each side [m]."""
        return round(self.hole_radius - self.peg_radius, 9)

    def with_clearance(self, clearance: float) -> "GridClampDimensions":
        """Return the dimensions with the holes' radius changed to another clearance [m]; the lip does not change."""
        return self if clearance == self.clearance else replace(self, hole_radius=self.peg_radius + clearance)

    @property
    def peg_positions(self) -> np.ndarray:
        """Centers (5, 2) [m] of the pegs in C and of the holes in G: the middle one, then the corners."""
        corners = np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])
        return np.concatenate([np.zeros((1, 2)), self.spacing * corners])


def _lathe(profile: list[tuple[float, float]]) -> TriangleMesh:
    """Return the mesh of a profile of (radius, height) [m], with circumscribed polygons for circles."""
    return sdf.lathe([(radius / np.cos(np.pi / NUM_SIDES), height) for radius, height in profile], NUM_SIDES)


def hole_mesh(dimensions: GridClampDimensions) -> TriangleMesh:
    """Return the collision mesh of a hole: wall, chamfer and face; the origin is the hole's center in the face."""
    d = dimensions
    return _lathe(
        [
            (d.hole_radius, -d.hole_land),
            (d.hole_radius, -d.hole_chamfer),
            (d.hole_radius + d.hole_chamfer, 0.0),
            (d.face_radius, 0.0),
        ]
    )


def lip_mesh(dimensions: GridClampDimensions) -> TriangleMesh:
    """Return the collision mesh of the lip, a ring that narrows and widens, in the frame of the middle hole's mesh."""
    d = dimensions
    top, bottom = -d.lip_depth, -d.lip_depth - d.lip_land
    return _lathe(
        [
            (d.lip_radius + d.lip_flank, bottom - d.lip_flank),
            (d.lip_radius, bottom),
            (d.lip_radius, top),
            (d.lip_radius + d.lip_flank, top + d.lip_flank),
        ]
    )


def peg_mesh(dimensions: GridClampDimensions) -> TriangleMesh:
    """Return a peg as a convex solid; the origin is its tip."""
    d = dimensions
    return _lathe(
        [
            (0.0, d.peg_length),
            (d.peg_radius, d.peg_length),
            (d.peg_radius, d.peg_chamfer),
            (d.peg_radius - d.peg_chamfer, 0.0),
            (0.0, 0.0),
        ]
    )


def bead_mesh(dimensions: GridClampDimensions) -> TriangleMesh:
    """Return the bead as a convex solid around the middle peg; the origin is its crest."""
    d = dimensions
    return _lathe(
        [
            (0.0, d.bead_exit),
            (d.peg_radius, d.bead_exit),
            (d.bead_radius, 0.0),
            (d.peg_radius, -d.bead_entry),
            (0.0, -d.bead_entry),
        ]
    )


def slab_mesh(dimensions: GridClampDimensions) -> TriangleMesh:
    """Return the visual mesh of the table: face, holes and sides."""
    d = dimensions
    angles = 2.0 * np.pi * (np.arange(NUM_VISUAL_SIDES + 1) + 0.5) / NUM_VISUAL_SIDES
    half_cell, half_table = d.spacing / 2, d.table_width / 2
    on_cell = half_cell / np.maximum(np.abs(np.cos(angles)), np.abs(np.sin(angles)))
    bottom, wall, mouth = (
        sdf.cylindrical(radius, angles, height)
        for radius, height in (
            (d.hole_radius, -d.hole_depth),
            (d.hole_radius, -d.hole_chamfer),
            (d.hole_radius + d.hole_chamfer, 0.0),
        )
    )
    hole = np.concatenate(
        [sdf.strip(bottom, wall), sdf.strip(wall, mouth), sdf.strip(mouth, sdf.cylindrical(on_cell, angles, 0.0))]
    )
    quads = [hole + np.array([x, y, 0.0]) for x, y in d.peg_positions]
    # The cells without a hole, and the frame around the three by three cells.
    corners = np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
    sides = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    quads.append(half_cell * corners + d.spacing * sides[:, None])
    outer, inner = half_table * corners, 3 * half_cell * corners
    below = outer - [0.0, 0.0, d.table_thickness]
    quads.append(np.stack([outer, np.roll(outer, -1, axis=0), np.roll(inner, -1, axis=0), inner], axis=1))
    quads.append(np.stack([below, np.roll(below, -1, axis=0), np.roll(outer, -1, axis=0), outer], axis=1))
    return TriangleMesh.from_quads(np.concatenate(quads))


STEEL, ALUMINIUM, ANODIZED = "0.62 0.64 0.68 1", "0.80 0.81 0.82 1", "0.20 0.35 0.60 1"
GLASS = "0.20 0.35 0.60 0.3"  # transparent body, so that pegs and holes are visible

FRICTION = 0.2  # friction coefficient of pegs, holes and the table's face
PEG = ContactMaterial(friction=FRICTION, modulus=5e8)
BEAD = ContactMaterial(friction=0.1, modulus=2e7)
PAD = ContactMaterial(friction=FRICTION, modulus=1e6)
HOLE = ContactMaterial(friction=FRICTION)
LIP = ContactMaterial(friction=0.1)
SLAB = ContactMaterial(friction=FRICTION)

CLAMP_MASS = 0.15  # [kg]
STEM_RADIUS, STEM_LENGTH = 6.0 * MM, 6.0 * MM  # stem, where the tool holds the clamp [m]


def clamp_sdf(dimensions: GridClampDimensions, friction: float = FRICTION) -> str:
    """Return the clamp's model: link `clamp` is frame C, with geometry `peg_0` (middle) to `peg_4`, `bead`, `pad`."""
    d, peg_material, pad = dimensions, *(replace(surface, friction=friction) for surface in (PEG, PAD))
    contents = ""
    for number, (x, y) in enumerate(d.peg_positions):
        contents += sdf.collision(f"peg_{number}", sdf.at(x, y), sdf.convex_mesh("grid_clamp_peg.obj"), peg_material)
        shaft = (sdf.at(x, y, d.peg_length / 2), sdf.cylinder(d.peg_radius, d.peg_length))
        contents += sdf.visual(f"peg_{number}_visual", *shaft, STEEL)
    crest = sdf.at(z=d.peg_length - d.bead_depth)
    contents += sdf.collision("bead", crest, sdf.convex_mesh("grid_clamp_bead.obj"), BEAD)
    contents += sdf.visual("bead_visual", crest, sdf.mesh("grid_clamp_bead.obj"), ANODIZED)
    top = d.peg_length + d.body_height
    body = (sdf.at(z=d.peg_length + d.body_height / 2), sdf.box(d.shoulder_width, d.shoulder_width, d.body_height))
    contents += sdf.collision("pad", *body, pad)
    contents += sdf.visual("body_visual", *body, GLASS)
    contents += sdf.visual(
        "stem_visual", sdf.at(z=top + STEM_LENGTH / 2), sdf.cylinder(STEM_RADIUS, STEM_LENGTH), STEEL
    )
    return sdf.model("clamp", CLAMP_MASS, (0.0, 0.0, d.peg_length), 20.0 * MM, contents)


def table_sdf(dimensions: GridClampDimensions, friction: float = FRICTION) -> str:
    """Return the table's model: link `table` is frame G, with geometry `hole_0` (middle) to `hole_4`, `lip`, `slab`."""
    d, hole, face = dimensions, *(replace(surface, friction=friction) for surface in (HOLE, SLAB))
    contents = ""
    for number, (x, y) in enumerate(d.peg_positions):
        contents += sdf.collision(f"hole_{number}", sdf.at(x, y), sdf.mesh("grid_clamp_hole.obj"), hole)
    contents += sdf.collision("lip", sdf.at(), sdf.mesh("grid_clamp_lip.obj"), LIP)
    contents += sdf.visual("lip_visual", sdf.at(), sdf.mesh("grid_clamp_lip.obj"), STEEL)
    slab = sdf.at(z=-d.table_thickness / 2)
    contents += sdf.collision("slab", slab, sdf.box(d.table_width, d.table_width, d.table_thickness), face)
    contents += sdf.visual("slab_visual", sdf.at(), sdf.mesh("grid_clamp_slab.obj"), ALUMINIUM)
    return sdf.model("table", 1.0, (0.0, 0.0, -d.table_thickness / 2), 30.0 * MM, contents)


def files(dimensions: GridClampDimensions, friction: float = FRICTION) -> dict[str, str]:
    """Return the content of each file by name."""
    return {
        "grid_clamp_peg.obj": peg_mesh(dimensions).to_obj(),
        "grid_clamp_bead.obj": bead_mesh(dimensions).to_obj(),
        "grid_clamp_hole.obj": hole_mesh(dimensions).to_obj(),
        "grid_clamp_lip.obj": lip_mesh(dimensions).to_obj(),
        "grid_clamp_slab.obj": slab_mesh(dimensions).to_obj(),
        CLAMP_SDF.name: clamp_sdf(dimensions, friction),
        TABLE_SDF.name: table_sdf(dimensions, friction),
    }


def folder_of(dimensions: GridClampDimensions, friction: float = FRICTION) -> Path:
    """Return the folder with the files of clamp and table: a temporary one, or this module's for default arguments."""
    if (dimensions, friction) == (GridClampDimensions(), FRICTION):
        return FOLDER
    return sdf.generate_assets(files, dimensions, friction)
