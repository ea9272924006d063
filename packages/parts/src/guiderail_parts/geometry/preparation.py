"""Preparation of contact geometry from two drawn parts: unite, decimate, crop, cut into convex pieces or tetrahedra."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from guiderail.models.common.errors import import_extra
from guiderail_parts.geometry.assembly_check import InsertionMotion, make_solids
from guiderail_parts.geometry.convex_decomposition import (
    MAX_FINE_PIECES,
    THINNEST,
    cut_into_convex_pieces,
    cut_into_sectors,
)
from guiderail_parts.geometry.drake_check import Piece, accepted_pieces
from guiderail_parts.geometry.mesh_file import Part
from guiderail_parts.geometry.solids import (
    SurfaceLocator,
    add_interior_points,
    boundary_of,
    join_surfaces,
    measure_deviation,
    measure_distance,
    tetrahedralize,
    to_arrays,
    to_manifold,
)
from guiderail_parts.isolation import IsolatedError, run_isolated

MIN_TOLERANCE, MAX_TOLERANCE = 2e-6, 5e-5  # bounds of the deviation that decimation aims at [m]
NO_CLEARANCE_TOLERANCE = 2e-5  # deviation that decimation aims at if no walls face each other [m]
MARGIN = 4e-3  # distance from the nominal motion within which parts may touch [m]
MIN_YAW = 0.1  # default rotation of the plug about its axis in a search, by which the margin is widened [rad]
CUT_SECONDS, TETRAHEDRA_SECONDS = 15, 25  # limits of CPU time [s]
DECIMATION_FRACTION = 0.2  # fraction of the tolerance that `decimate` may use
_FIRST_FRACTION = 0.7  # fraction of the remaining tolerance at the first attempt; `manifold3d` may exceed its bound

KINDS = ("convex", "sectors", "fine", "tetrahedra")
"""Kinds of pieces of a compliant part: convex pieces, sectors of a screw, more and finer convex pieces, and tetrahedra.

Each kind is tried if the plug does not reach its target with the kinds before it.
"""

Arrays = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True)
class ContactSurface:
    """Surface of a part in the simulation."""

    bodies: tuple[Arrays, ...]  # vertices (V, 3) [m] and triangles (T, 3) of each body, snapping bodies last
    snapping: int  # number of the snapping bodies
    visual: Arrays  # vertices and triangles of the whole part, decimated but not cropped
    deviation: float  # largest measured distance from the drawing in the regions that can touch [m]
    volume: float  # volume of the part [m³]
    sectors: int = 0  # number of sectors about z in which chords replace the arcs of a screw; 0 for other parts

    @property
    def num_triangles(self) -> int:
        """Number of triangles of all bodies."""
        return sum(len(triangles) for _, triangles in self.bodies)


def choose_tolerance(clearance: float) -> float:
    """Return the deviation that decimation aims at [m]: a tenth of the clearance [m], within bounds."""
    if not np.isfinite(clearance):
        return NO_CLEARANCE_TOLERANCE
    return float(np.clip(0.1 * clearance, MIN_TOLERANCE, MAX_TOLERANCE))


def decimate(part: Part, tolerance: float) -> tuple[Part, float]:
    """Return a part with fewer triangles and its deviation [m], at most `DECIMATION_FRACTION` of `tolerance` [m]."""
    simpler = [simplify(solid, 1e3 * DECIMATION_FRACTION * tolerance) for solid in make_solids(part)]
    bodies = tuple(to_arrays(solid) for solid, _ in simpler)
    return Part(part.path, bodies, part.repair), 1e-3 * max(deviation for _, deviation in simpler)


def prepare_surfaces(
    plug: Part,
    socket: Part,
    motion: InsertionMotion,
    tolerance: float,
    moved: float,
    snapping: frozenset[int],
    yaw: float = MIN_YAW,
) -> tuple[ContactSurface, ContactSurface]:
    """Return the contact surfaces of both parts.

    Args:
        plug: Plug at its target, in the target frame, decimated by `decimate`.
        socket: Socket in the target frame, decimated by `decimate`.
        motion: Motion of the plug.
        tolerance: Largest deviation of the result from the drawing [m].
        moved: Deviation of the decimated parts from the drawing [m].
        snapping: Indices of bodies of the plug that deflect; they are not united with the others. If there are any,
            neither part is cropped.
        yaw: Largest rotation of the plug in the socket about its axis in a search [rad].
    """
    plug_solids, socket_solids = make_solids(plug), make_solids(socket)
    rigid = _unite([solid for number, solid in enumerate(plug_solids) if number not in snapping])
    fixed = _unite(socket_solids)
    radius = float(np.hypot(*plug.corners[:, :2].T).max())
    margin = 1e3 * (MARGIN + yaw * radius)
    remaining = 1e3 * (tolerance - moved)  # [mm]
    surfaces = []
    for part, whole, other, extra in (
        (plug, rigid, fixed, [plug_solids[number] for number in sorted(snapping)]),
        (socket, fixed, rigid, []),
    ):
        solid = whole
        if not snapping:  # a deflected body may touch where a rigid one would not
            cropped = crop_to_contact(whole, other, margin, motion.turn, is_plug=part is plug)
            if motion.advance:  # the thread stops a plug at most one turn below its target
                low, high = -motion.pitch, motion.rim + motion.pitch
                plane = ((0.0, 0.0, -1.0), -1e3 * high) if part is plug else ((0.0, 0.0, 1.0), 1e3 * low)
                cropped = cropped.trim_by_plane(*plane)
            # Cropping adds edges, too: the solid with fewer triangles is used.
            solid = min(whole, cropped, key=lambda one: count_simplified(one, _FIRST_FRACTION * remaining))
        bodies = [_reduce(one, remaining) for one in solid.decompose()] + [simplify(one, remaining) for one in extra]
        surfaces.append(
            ContactSurface(
                bodies=tuple(to_arrays(one) for one, _ in bodies),
                snapping=len(extra),
                visual=join_surfaces([to_arrays(one) for one in (whole, *extra)]),
                deviation=moved + 1e-3 * max(deviation for _, deviation in bodies),
                volume=1e-9 * sum(one.volume() for one in (whole, *extra)),
                sectors=_count_sectors(plug, socket, motion, tolerance) if motion.advance else 0,
            )
        )
    return surfaces[0], surfaces[1]


def _count_sectors(plug: Part, socket: Part, motion: InsertionMotion, tolerance: float) -> int:
    """Return the number of sectors whose chords deviate from the thread's circle by at most the tolerance [m]."""
    radii = []
    for part in (plug, socket):
        corners = part.corners[(part.corners[:, 2] >= 0.0) & (part.corners[:, 2] <= motion.rim)]
        radii.append(float(np.hypot(*corners[:, :2].T).max()))
    return math.ceil(math.pi / math.acos(1.0 - min(tolerance / min(radii), 0.5)))


def _unite(solids: Sequence[Any]) -> Any:
    manifold3d = import_extra("manifold3d")
    return solids[0] if len(solids) == 1 else manifold3d.Manifold.batch_boolean(list(solids), manifold3d.OpType.Add)


def _reduce(solid: Any, tolerance: float) -> tuple[Any, float]:
    """Return a solid with few triangles, or its hull if the hull deviates little, and the deviation [mm]."""
    simpler, moved = simplify(solid, tolerance, _FIRST_FRACTION)
    hull, filled = as_hull_if_near(simpler, tolerance - moved)
    return hull, moved + filled


def make_compliant(
    kind: str, surfaces: dict[str, ContactSurface], tolerance: float, log: Callable[[str], None]
) -> Iterator[tuple[str, list[Piece], float]]:
    """Yield the compliant geometries to try, the part with fewer triangles first.

    A geometry is the name of the part, its pieces, and the pieces' largest measured distance from its surface [m].

    Args:
        kind: One of `KINDS`.
        surfaces: Surfaces of the parts that may be compliant, by the part's name.
        tolerance: Largest deviation [m].
        log: Function called with a sentence on each part that does not decompose or that Drake refuses.
    """
    order = sorted(surfaces, key=lambda name: surfaces[name].num_triangles)
    if kind == "sectors":
        order = [name for name in order if surfaces[name].sectors]
    failure = {
        "convex": "too intricate for convex pieces",
        "sectors": "its sectors are not convex",
        "fine": f"too intricate for {MAX_FINE_PIECES} fine convex pieces",
        "tetrahedra": "no tetrahedra",
    }[kind]
    make: Callable[..., Any] = partial(cut_bodies, kind=kind)
    seconds = CUT_SECONDS
    if kind == "tetrahedra":
        make, seconds = _mesh_bodies, TETRAHEDRA_SECONDS
    for name in order:
        try:
            result = run_isolated(make, surfaces[name], tolerance, cpu_seconds=seconds)
        except IsolatedError as error:
            log(f"{name}: {failure} ({error})")
            continue
        accepted = None if result is None else accepted_pieces(result[0])
        if result is None or accepted is None:
            log(f"{name}: {failure if result is None else 'Drake refuses a piece'}")
            continue
        yield name, accepted, result[1]


def cut_bodies(surface: ContactSurface, tolerance: float, kind: str = "convex") -> tuple[list[Piece], float] | None:
    """Return convex pieces of all bodies, and the largest measured distance of added material from the surface [m].

    The result is None if there are too many pieces, or if they deviate by more than about twice the tolerance [m].
    `kind` is one of `KINDS`, but not "tetrahedra".
    """
    cutters: dict[str, Callable[[Any], list[Any] | None]] = {
        "convex": cut_into_convex_pieces,
        "sectors": partial(cut_into_sectors, number=surface.sectors),
        "fine": partial(cut_into_convex_pieces, max_pieces=MAX_FINE_PIECES, depth=1e3 * tolerance),
    }
    pieces: list[Piece] = []
    deviation = 0.0
    for number, arrays in enumerate(surface.bodies):
        solid = to_manifold(*arrays)
        cut = cutters[kind](solid)
        if cut is None:
            return None
        added = _added(cut, solid)
        if added and float(SurfaceLocator(*arrays).find_nearest(added[0])[1].max()) > 2.0 * tolerance:
            return None
        thick = [piece for piece in cut if 2.0 * piece.volume() > THINNEST * piece.surface_area()]
        if len(thick) < len(cut):
            added = _added(thick, solid)
        if added:
            deviation = max(deviation, measure_distance(added, arrays))
        pieces += [Piece(number, ".obj", *to_arrays(piece)) for piece in thick]
    return pieces, deviation


def _added(pieces: Sequence[Any], solid: Any) -> Arrays | None:
    """Return the surface of the material that pieces add to a solid; None if they add none."""
    manifold3d = import_extra("manifold3d")
    # The opposite difference would contain the seams between pieces.
    added = to_arrays(manifold3d.Manifold.batch_boolean(list(pieces), manifold3d.OpType.Add) - solid)
    return added if len(added[0]) else None


def _mesh_bodies(surface: ContactSurface, tolerance: float) -> tuple[list[Piece], float]:
    """Return tetrahedra of each body, and the measured deviation of their boundaries [m]."""
    pieces, deviation = [], 0.0
    for number, arrays in enumerate(surface.bodies):
        points, cells = tetrahedralize(*arrays, 2.0 * tolerance)
        deviation = max(deviation, measure_deviation(boundary_of(points, cells), arrays))
        if deviation > 4.0 * tolerance:
            raise ValueError("their boundary deviates from the part")
        pieces.append(Piece(number, ".vtk", *add_interior_points(points, cells)))
    return pieces, deviation


_SLABS = 8  # slabs along z in which a part is cropped
_HULL = 0.5  # fraction of the tolerance by which a part may differ from its hull
_SLIVER = 1e-4  # volume below which a cropped piece is a rounding error [mm³]


def simplify(solid: Any, tolerance: float, start: float = 1.0) -> tuple[Any, float]:
    """Return a solid with fewer triangles, and its measured deviation [mm].

    `manifold3d` may exceed its bound for thin parts. The deviation is therefore measured, and if it exceeds the
    tolerance [mm], a smaller bound is tried. The first bound is the fraction `start` of the tolerance. If all bounds
    fail, the solid is returned unchanged.
    """
    original = to_arrays(solid)
    for fraction in (start, 0.3 * start, 0.1 * start):
        simpler = solid.as_original().simplify(fraction * tolerance)
        if simpler.is_empty():
            continue
        deviation = 1e3 * measure_deviation(original, to_arrays(simpler))
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
    """Return the region of a part that can come within `margin` of the other part while the plug moves down along z.

    A slab of the plug above z0 can touch only the region of the socket above z0, and a slab of the socket below z1 only
    the region of the plug below z1. Each slab is cropped to the projection of that region along z, widened by the
    margin.

    Args:
        part: Solid to crop.
        other: The other solid at the target.
        margin: Largest distance from the nominal motion [mm].
        turn: Turn of the plug about z at the target [rad].
        is_plug: True if `part` is the plug.
    """
    manifold3d = import_extra("manifold3d")
    low, high = part.bounding_box()[2], part.bounding_box()[5]
    cuts, regions = np.linspace(low, high, _SLABS + 1), []
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
        regions.append(manifold3d.Manifold.extrude(shadow, end - start + 2e-3).translate((0, 0, start - 1e-3)))
    if not regions:
        return part
    cropped = part ^ manifold3d.Manifold.batch_boolean(regions, manifold3d.OpType.Add)
    pieces = [piece for piece in cropped.decompose() if piece.volume() > _SLIVER]
    return manifold3d.Manifold.compose(pieces) if pieces else part
