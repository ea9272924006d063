"""Convex solids of the grid clamp; `guiderail.models.objects.grid_clamp` describes its frames."""

import numpy as np

from guiderail.diagrams.stations.workcell import Box, Hull, Spring, Surface
from guiderail.models.common.transforms import MM
from guiderail.models.objects.grid_clamp import BEAD, FRICTION, LIP, NUM_SIDES, GridClampDimensions, peg_mesh
from guiderail_mujoco.ring import ring_hulls

# Each side of the bead has its own spring, as stiff as one side of Drake's compliant bead in the lip.
BEAD_STIFFNESS = 7e3  # [N/m]
BEAD_CORE = 2.0 * MM  # inner radius of the bead's sides
BEAD_GAP = 0.4 * MM  # gap between a side and its corners: a side must touch only the side of the lip that it faces
# Extra radius in the middle of a side's crest. A straight crest would touch along a line, with an arbitrary normal.
BEAD_CROWN = 0.01 * MM
LIP_BACK = 2.0 * MM  # radial thickness of the lip


def clamp_surfaces(dimensions: GridClampDimensions, friction: float = FRICTION) -> list[Surface]:
    """Return the collision geometry of the clamp in its frame C."""
    d, peg = dimensions, Hull(peg_mesh(dimensions).vertices)
    pegs = [
        Surface(f"peg_{number}", f"hole_{number}", peg, friction, (x, y, 0.0))
        for number, (x, y) in enumerate(d.peg_positions)
    ]
    crest = (0.0, 0.0, d.peg_length - d.bead_depth)
    bead = [
        Surface(f"bead_{number}", "lip", Hull(hull), BEAD.friction, crest, spring=Spring(axis, BEAD_STIFFNESS))
        for number, (hull, axis) in enumerate(bead_hulls(d))
    ]
    body = Box(d.shoulder_width, d.shoulder_width, d.body_height)
    return [*pegs, *bead, Surface("pad", "slab", body, friction, (0.0, 0.0, d.peg_length + d.body_height / 2))]


def table_surfaces(dimensions: GridClampDimensions, friction: float = FRICTION) -> list[Surface]:
    """Return the collision geometry of the table in its frame G."""
    d = dimensions
    holes = [
        Surface(f"hole_{number}_{side}", f"hole_{number}", Hull(hull), friction, (x, y, 0.0))
        for number, (x, y) in enumerate(d.peg_positions)
        for side, hull in enumerate(hole_hulls(d))
    ]
    lip = [Surface(f"lip_{side}", "lip", Hull(hull), LIP.friction) for side, hull in enumerate(lip_hulls(d))]
    slab = Box(d.table_width, d.table_width, d.table_thickness)
    return [*holes, *lip, Surface("slab", "slab", slab, friction, (0.0, 0.0, -d.table_thickness / 2))]


def hole_hulls(dimensions: GridClampDimensions) -> list[np.ndarray]:
    """Return the vertices (V, 3) [m] of the convex pieces of a hole's wall, chamfer and face.

    The pieces have the polygonal surface of `hole_mesh`.
    """
    d = dimensions
    profile = [
        [d.hole_radius + d.hole_chamfer, 0.0],
        [d.face_radius, 0.0],
        [d.face_radius, -d.hole_land],
        [d.hole_radius, -d.hole_land],
        [d.hole_radius, -d.hole_chamfer],
    ]
    return ring_hulls(np.array(profile), NUM_SIDES)


def lip_hulls(dimensions: GridClampDimensions) -> list[np.ndarray]:
    """Return the vertices (V, 3) [m] of the convex pieces of the lip, with the polygonal surface of `lip_mesh`."""
    d = dimensions
    top, bottom = -d.lip_depth, -d.lip_depth - d.lip_land
    profile = [
        [d.lip_radius + d.lip_flank, top + d.lip_flank],
        [d.lip_radius + d.lip_flank + LIP_BACK, top + d.lip_flank],
        [d.lip_radius + d.lip_flank + LIP_BACK, bottom - d.lip_flank],
        [d.lip_radius + d.lip_flank, bottom - d.lip_flank],
        [d.lip_radius, bottom],
        [d.lip_radius, top],
    ]
    return ring_hulls(np.array(profile), NUM_SIDES)


def bead_hulls(dimensions: GridClampDimensions) -> list[tuple[np.ndarray, tuple[float, float, float]]]:
    """Return the vertices (V, 3) [m] of each side of the bead and its outward direction (3,).

    Heights are relative to the crest. The sides have the polygonal surface of `bead_mesh`, with gaps at its corners and
    a crown on its crest.
    """
    d = dimensions
    radius, height = np.array(
        [
            [BEAD_CORE, d.bead_exit],
            [d.peg_radius, d.bead_exit],
            [d.bead_radius, 0.0],
            [d.peg_radius, -d.bead_entry],
            [BEAD_CORE, -d.bead_entry],
        ]
    ).T
    half_width = radius * np.tan(np.pi / NUM_SIDES) - BEAD_GAP
    sides = []
    for middle in 2.0 * np.pi * (np.arange(NUM_SIDES) + 1) / NUM_SIDES:
        outward, along = np.array([[np.cos(middle), np.sin(middle)], [-np.sin(middle), np.cos(middle)]])
        ends = [np.outer(radius, outward) + sign * np.outer(half_width, along) for sign in (-1.0, 1.0)]
        crown = np.append((d.bead_radius + BEAD_CROWN) * outward, 0.0)
        vertices = np.concatenate([*(np.column_stack([end, height]) for end in ends), crown[None]])
        sides.append((vertices, (float(outward[0]), float(outward[1]), 0.0)))
    return sides
