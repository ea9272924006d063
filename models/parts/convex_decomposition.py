"""A solid cut into convex pieces that together are exactly the solid.

Contact of a compliant mesh needs tetrahedra, of which a convex piece has few; a solid that is no more than tolerably
like its pieces would lose clearances of a tenth of a millimetre. So it is cut along its own faces where it is concave,
as a sculptor's saw would, and no surface moves.
"""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np

from guiderail.models.parts.mesh_file import need

MOST_PIECES = 150
_SLIVER = 1e-6  # of the whole volume: less is rounding
_CONVEX = 1e-4  # of its volume: what lacks no more than that is convex
_FLAT = 1e-2  # [rad] an edge that is less concave than this is none
_TRIED = 6  # planes at each cut
_SMALLEST_FACE = 2e-4  # [mm²] Drake makes a plane of each face, and fails at one of 5e-5
_DIGITS = 9  # of an OBJ file's metres: what is flat before it is rounded may not be so after
_SCALE = 1e3  # manifold3d's tolerances are made for millimetres


def as_solid(vertices: np.ndarray, triangles: np.ndarray) -> Any:
    """A `manifold3d.Manifold` in millimetres of vertices (V, 3) [m] and triangles (T, 3)."""
    manifold3d = need("manifold3d")
    mesh = manifold3d.Mesh64(np.ascontiguousarray(vertices * _SCALE), np.ascontiguousarray(triangles, dtype=np.uint64))
    mesh.merge()
    return manifold3d.Manifold(mesh)


def as_arrays(solid: Any) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) [m] and triangles (T, 3) of a solid."""
    mesh = solid.to_mesh64()
    return np.asarray(mesh.vert_properties)[:, :3] / _SCALE, np.asarray(mesh.tri_verts).astype(int)


def convex_pieces(solid: Any, most: int = MOST_PIECES) -> list[Any] | None:
    """Cuts a solid into convex ones; None if it takes more than `most`, or what no cut finds would be filled.

    Each cut is along the plane of a face beside a concave edge, whichever leaves least to be cut.
    """
    total, filled, todo, pieces = solid.volume(), 0.0, [solid], []
    while todo:
        for part in todo.pop().decompose():
            if part.volume() < _SLIVER * total:
                continue
            hollow = _hollow(part)
            cut = None if hollow < _CONVEX * part.volume() + _SLIVER * total else _best_cut(part, total)
            if cut is None:
                pieces.append(_with_large_faces(part.hull()))
                filled += hollow
            else:
                todo += cut
        # Edges that are too flat to be seen one by one may be a bore.
        if len(pieces) + len(todo) > most or filled > 2.0 * _CONVEX * total:
            return None
    return pieces


def _with_large_faces(convex: Any) -> Any:
    """A convex solid less the vertices that make faces too small for Drake: those on a line, or next to another."""
    from pydrake.geometry import Convex  # half a second that whoever reads a folder need not wait for

    manifold3d = need("manifold3d")
    points = as_arrays(convex)[0]
    while len(points) > 4:
        points = np.round(points, _DIGITS)
        hull = Convex(np.ascontiguousarray(points.T), "piece").GetConvexHull()
        points = np.array([hull.vertex(i) for i in range(hull.num_vertices())])
        smallest, corner = _smallest_face(points, list(hull.face_data()))
        if smallest <= _SMALLEST_FACE:
            points = np.delete(points, corner, axis=0)
            continue
        # What Drake takes for one face may be several triangles in the file, one of them next to nothing.
        written = manifold3d.Manifold.hull_points(np.ascontiguousarray(points * _SCALE))
        vertices, triangles = as_arrays(written)
        smallest, corner = _smallest_face(vertices, np.insert(triangles, 0, 3, axis=1).ravel().tolist())
        if smallest > _SMALLEST_FACE:
            return written
        points = np.delete(vertices, corner, axis=0)
    return manifold3d.Manifold.hull_points(np.ascontiguousarray(points * _SCALE))


def _smallest_face(points: np.ndarray, faces: list[int]) -> tuple[float, int]:
    """The smallest triangle's area [mm²] where each polygon is a fan, as Drake makes it, and which corner is on a line.

    `faces` has for each polygon how many corners, and which.
    """
    smallest, corner, start = np.inf, 0, 0
    while start < len(faces):
        fan = faces[start + 1 : start + 1 + faces[start]]
        start += 1 + len(fan)
        for second, third in itertools.pairwise(fan[1:]):
            triangle = np.array([fan[0], second, third])
            a, b, c = points[triangle] * _SCALE
            area = 0.5 * float(np.linalg.norm(np.cross(b - a, c - a)))
            if area < smallest:
                # The corner opposite the longest side is nearest to the line of the other two.
                opposite = np.argmax([np.linalg.norm(c - b), np.linalg.norm(c - a), np.linalg.norm(b - a)])
                smallest, corner = area, int(triangle[opposite])
    return smallest, corner


def _hollow(solid: Any) -> float:
    """The volume that a solid lacks to be convex [mm³]."""
    return float(solid.hull().volume() - solid.volume())


def _best_cut(solid: Any, total: float) -> list[Any] | None:
    best, found = None, np.inf
    # A plane in which faces lie cuts through rounding errors: beside it, it may not.
    beside = 1e-5 * total ** (1 / 3)
    for normal, distance in _planes(solid):
        for shift in (0.0, beside, -beside):
            halves = solid.split_by_plane(normal, distance + shift)
            parts = [part for half in halves for part in half.decompose() if part.volume() > _SLIVER * total]
            if len(parts) > 1 and (left := sum(map(_hollow, parts))) < found - _SLIVER * total:
                best, found = parts, left
    return best


def _planes(solid: Any) -> list[tuple[np.ndarray, float]]:
    """Planes of faces beside concave edges, those with the longest edges first."""
    trimesh = need("trimesh")
    vertices, triangles = as_arrays(solid)
    mesh = trimesh.Trimesh(vertices * _SCALE, triangles, process=False)
    concave = ~mesh.face_adjacency_convex & (mesh.face_adjacency_angles > _FLAT)
    faces = np.unique(mesh.face_adjacency[concave])
    faces = faces[mesh.area_faces[faces] > 1e-9 * mesh.scale**2]
    if not len(faces):
        return []
    normals = mesh.face_normals[faces]
    distances = np.einsum("ij,ij->i", normals, mesh.triangles_center[faces])
    rounded = np.round(np.column_stack([normals, distances / mesh.scale]), 4)
    rounded *= np.where(rounded[:, :3].sum(axis=1) < 0, -1, 1)[:, None]  # both sides of a plane are one
    _, first = np.unique(rounded, axis=0, return_index=True)
    ends = mesh.vertices[mesh.face_adjacency_edges[concave]]
    lengths = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    inside = [(np.abs(ends @ normals[i] - distances[i]) < 1e-4 * mesh.scale).all(axis=1) for i in first]
    order = np.argsort([-(lengths * one).sum() for one in inside], kind="stable")
    return [(normals[first[i]], float(distances[first[i]])) for i in order[:_TRIED]]
