"""Decomposition of a solid into convex pieces.

Contact of a compliant mesh needs tetrahedra; few are enough for a convex piece. An approximate decomposition would lose
clearances of a tenth of a millimeter. The solid is therefore cut along its own faces at concave edges, which moves no
surface. Only the fine decomposition and the sectors of a screw fill concavities.
"""

import itertools
from typing import Any

import numpy as np

from guiderail.models.common.errors import import_extra
from guiderail_parts.geometry.solids import SCALE, SurfaceLocator, hull_of, measure_distance, to_arrays

MAX_PIECES = 300  # largest number of pieces; a base with two gears, the socket of a third gear, has 282
MAX_FINE_PIECES = 800  # largest number of pieces of a fine decomposition; few of them are in contact at a time
_FINE_SLIVER = 1e-8  # fraction of the whole volume below which a piece of a fine decomposition is a rounding error
_SLIVER = 1e-6  # fraction of the whole volume below which a piece is a rounding error
_CONVEX = 1e-4  # fraction of its volume by which a convex piece may differ from its hull
_FLAT = 1e-2  # angle below which an edge does not count as concave [rad]
_DEPTH_SAMPLES = 500  # points sampled on the surface of a part and its hull
THINNEST = 1e-3  # thickness below which a piece is a rounding error [mm]
_MAX_PLANES = 6  # planes tried at each cut
_ALMOST_FLAT = 1e-3  # angle below which no cut starts at an edge [rad]
_NUM_RADII = 40  # radii at which a sector may be cut
_SMALLEST_FACE = 2e-4  # smallest area of a face [mm²]; Drake cannot compute the plane of a face of 5e-5
_DIGITS = 9  # decimal places [m] in an OBJ file; rounding may bend a flat face


def cut_into_convex_pieces(solid: Any, max_pieces: int = MAX_PIECES, depth: float | None = None) -> list[Any] | None:
    """Cut a solid into convex pieces.

    Each cut is along the plane of a face at a concave edge; the plane that leaves the smallest concave volume is used.

    Args:
        solid: Solid of `manifold3d`.
        max_pieces: Largest number of pieces.
        depth: Depth below which a concavity is filled [mm]; None: concavities of negligible volume are filled instead.
            With a depth, only much smaller parts are left out, and a part that no plane of a face cuts is cut by
            planes that halve the angles between faces. A part that no plane cuts is replaced by its hull.

    Returns:
        The pieces; None if more than `max_pieces` are necessary, or, without a depth, if hulls fill a concavity that no
        cut removes.
    """
    total, filled, uncut, pieces = solid.volume(), 0.0, [solid], []
    sliver = (_SLIVER if depth is None else _FINE_SLIVER) * total
    while uncut:
        for part in uncut.pop().decompose():
            # A thin part is left out: if it is bent, its hull would not be thin.
            if part.volume() < sliver or (depth and 2.0 * part.volume() < THINNEST * part.surface_area()):
                continue
            hollow = _hollow(part)
            is_convex = hollow < _CONVEX * part.volume() + sliver if depth is None else _depth(part) < depth
            cut = None if is_convex else _best_cut(part, total, sliver, fine=depth is not None)
            if cut is None:
                pieces.append(_with_large_faces(part.hull()))
                filled += hollow
            else:
                uncut += cut
        # Edges that are each too flat to count as concave may together form a bore, which the hulls would fill.
        if len(pieces) + len(uncut) > max_pieces or (depth is None and filled > 2.0 * _CONVEX * total):
            return None
    return pieces


def cut_into_sectors(solid: Any, number: int, max_pieces: int = MAX_PIECES) -> list[Any] | None:
    """Cut a solid by planes through the z axis into `number` sectors, at least 3, and each sector in two.

    The second cut is across the sector, at the radius with the smallest concave volume, which is the root of a thread.
    Cuts along the curved faces of a thread would make too many pieces. The pieces are convex hulls, which fill
    concavities.

    Returns:
        The pieces; None if more than `max_pieces` are necessary.
    """
    pieces: list[Any] = []
    for angle in 2.0 * np.pi / number * np.arange(number):
        middle, end = angle + np.pi / number, angle + 2.0 * np.pi / number
        half = solid.trim_by_plane((-np.sin(angle), np.cos(angle), 0.0), 0.0)
        for part in half.trim_by_plane((np.sin(end), -np.cos(end), 0.0), 0.0).decompose():
            outward = np.array([np.cos(middle), np.sin(middle), 0.0])
            distances = to_arrays(part)[0] @ outward * SCALE
            cuts = [
                [one for half in part.split_by_plane(outward, distance) for one in half.decompose()]
                for distance in np.linspace(distances.min(), distances.max(), _NUM_RADII + 2)[1:-1]
            ]
            best = min(cuts, key=lambda cut: sum(map(_hollow, cut)))
            pieces += [_with_large_faces(one.hull()) for one in best if one.volume() > _SLIVER * part.volume()]
            if len(pieces) > max_pieces:
                return None
    return pieces


def _with_large_faces(convex: Any) -> Any:
    """Remove vertices of a convex solid until no face is too small for Drake; return the new solid."""
    from pydrake.geometry import Convex  # imported here because it takes half a second

    points = to_arrays(convex)[0]
    while len(points) > 4:
        points = np.round(points, _DIGITS)
        hull = Convex(np.ascontiguousarray(points.T), "piece").GetConvexHull()
        points = np.array([hull.vertex(i) for i in range(hull.num_vertices())])
        smallest, corner = _smallest_face(points, list(hull.face_data()))
        if smallest <= _SMALLEST_FACE:
            points = np.delete(points, corner, axis=0)
            continue
        # A face of Drake's hull may be several triangles in the file, one of them almost without area.
        written = hull_of(points)
        vertices, triangles = to_arrays(written)
        smallest, corner = _smallest_face(vertices, np.insert(triangles, 0, 3, axis=1).ravel().tolist())
        if smallest > _SMALLEST_FACE:
            return written
        points = np.delete(vertices, corner, axis=0)
    return hull_of(points)


def _smallest_face(points: np.ndarray, faces: list[int]) -> tuple[float, int]:
    """Cut faces into fans of triangles, as Drake does; return the smallest triangle's area [mm²] and flattest corner.

    `faces` lists, for each polygon, the number of its corners and the corners.
    """
    smallest, corner, start = np.inf, 0, 0
    while start < len(faces):
        fan = faces[start + 1 : start + 1 + faces[start]]
        start += 1 + len(fan)
        for second, third in itertools.pairwise(fan[1:]):
            triangle = np.array([fan[0], second, third])
            a, b, c = points[triangle] * SCALE
            area = 0.5 * float(np.linalg.norm(np.cross(b - a, c - a)))
            if area < smallest:
                # The corner opposite the longest side is nearest to the line through the other two corners.
                opposite = np.argmax([np.linalg.norm(c - b), np.linalg.norm(c - a), np.linalg.norm(b - a)])
                smallest, corner = area, int(triangle[opposite])
    return smallest, corner


def _hollow(solid: Any) -> float:
    """Return the volume between a solid and its convex hull [mm³]."""
    return float(solid.hull().volume() - solid.volume())


def _depth(solid: Any) -> float:
    """Return the sampled Hausdorff distance of a solid and its convex hull [mm], from vertices and samples."""
    surface, hull = to_arrays(solid), to_arrays(solid.hull())
    inside = float(SurfaceLocator(*hull).find_nearest(surface[0])[1].max())
    return SCALE * max(inside, measure_distance(hull, surface, _DEPTH_SAMPLES))


def _best_cut(solid: Any, total: float, sliver: float, *, fine: bool) -> list[Any] | None:
    """Return the parts of more volume than `sliver` [mm³] after the best cut; None if no cut is possible."""
    best, smallest = None, np.inf
    # A cut exactly in the plane of faces suffers from rounding errors, which a slightly shifted cut may avoid.
    shift_size = 1e-5 * total ** (1 / 3)
    trimesh = import_extra("trimesh")
    vertices, triangles = to_arrays(solid)
    mesh = trimesh.Trimesh(vertices * SCALE, triangles, process=False)
    for find in (_planes, _bisectors) if fine else (_planes,):
        for normal, distance in find(mesh):
            for shift in (0.0, shift_size, -shift_size):
                halves = solid.split_by_plane(normal, distance + shift)
                parts = [part for half in halves for part in half.decompose() if part.volume() > sliver]
                if len(parts) > 1 and (left := sum(map(_hollow, parts))) < smallest - sliver:
                    best, smallest = parts, left
        if best is not None:
            break
    return best


def _planes(mesh: Any) -> list[tuple[np.ndarray, float]]:
    """Return planes of faces at concave edges, those with the longest edges first."""
    concave = ~mesh.face_adjacency_convex & (mesh.face_adjacency_angles > _FLAT)
    faces = np.unique(mesh.face_adjacency[concave])
    faces = faces[mesh.area_faces[faces] > 1e-9 * mesh.scale**2]
    if not len(faces):
        return []
    normals = mesh.face_normals[faces]
    distances = np.einsum("ij,ij->i", normals, mesh.triangles_center[faces])
    rounded = np.round(np.column_stack([normals, distances / mesh.scale]), 4)
    rounded *= np.where(rounded[:, :3].sum(axis=1) < 0, -1, 1)[:, None]  # opposite normals describe the same plane
    _, first = np.unique(rounded, axis=0, return_index=True)
    ends = mesh.vertices[mesh.face_adjacency_edges[concave]]
    lengths = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    inside = [(np.abs(ends @ normals[i] - distances[i]) < 1e-4 * mesh.scale).all(axis=1) for i in first]
    order = np.argsort([-(lengths * one).sum() for one in inside], kind="stable")
    return [(normals[first[i]], float(distances[first[i]])) for i in order[:_MAX_PLANES]]


def _bisectors(mesh: Any) -> list[tuple[np.ndarray, float]]:
    """Return planes that halve the angle at concave edges, those with the largest angles and lengths first.

    The plane of a face may only touch the part, but these planes cut it in two.
    """
    concave = ~mesh.face_adjacency_convex & (mesh.face_adjacency_angles > _ALMOST_FLAT)
    starts, ends = mesh.vertices[mesh.face_adjacency_edges[concave]].transpose(1, 0, 2)
    normals = np.cross(ends - starts, mesh.face_normals[mesh.face_adjacency[concave]].sum(axis=1))
    lengths = np.linalg.norm(normals, axis=1)
    order = np.argsort(-lengths * mesh.face_adjacency_angles[concave], kind="stable")
    order = order[lengths[order] > 1e-9 * mesh.scale][:_MAX_PLANES]
    return [(normals[i] / lengths[i], float(starts[i] @ normals[i] / lengths[i])) for i in order]
