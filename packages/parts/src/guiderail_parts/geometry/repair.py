"""Repair of meshes exported from CAD programs to closed solids: slivers, open seams, doubled faces, cavities.

Open edges are first closed without moving a vertex: loose triangles are removed, and flat faces are triangulated again.
If that fails, fTetWild computes a new surface, which differs from the old surface by at most `MAX_MOVED`.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any

import numpy as np

from guiderail.models.common.errors import InputError, import_extra
from guiderail.models.objects.sdf import area_vectors
from guiderail_parts.geometry.solids import boundary_of, measure_distance, tetrahedralize, to_arrays, to_manifold
from guiderail_parts.isolation import IsolatedError, run_isolated

MAX_MOVED = 1e-4  # largest motion of a surface by a repair; a larger motion may close an intended hole [m]
_ENVELOPE = 2e-5  # largest deviation that fTetWild is allowed [m]
_CPU_SECONDS = 60
_ATTEMPTS = 3  # fTetWild is not deterministic, and may leave tetrahedra outside the part: the best attempt is used
_NEGLIGIBLE = 1e-9  # fraction of the largest body's volume below which a body is a rounding error


@dataclass(frozen=True)
class Repair:
    """Changes of a mesh that made it a solid."""

    # Number of open edges of the mesh (`find_open_edges`), at least 1 if the surface was changed.
    closed_edges: int = 0
    moved: float = 0.0  # largest distance of a point of the new surface from the old surface [m]
    left_out: float = 0.0  # largest distance from the new surface to an old face that bounds no volume [m]
    cavities: int = 0  # number of filled closed cavities
    inverted: int = 0  # number of bodies whose faces pointed inwards

    def __str__(self) -> str:
        changes = []
        if self.closed_edges:
            changes.append(f"closed {self.closed_edges} edges")
        if self.cavities:
            changes.append(f"filled {self.cavities} closed {'cavity' if self.cavities == 1 else 'cavities'}")
        if self.inverted:
            changes.append(f"turned {self.inverted} {'body' if self.inverted == 1 else 'bodies'} right side out")
        if self.closed_edges:
            changes.append(f"surface moved by at most {1e3 * self.moved:.4f} mm")
            if self.left_out > MAX_MOVED:
                changes.append(f"left out faces without volume up to {1e3 * self.left_out:.2f} mm from it")
        return "; ".join(changes)


def close_surface(
    name: str, vertices: np.ndarray, triangles: np.ndarray
) -> tuple[list[tuple[np.ndarray, np.ndarray]], Repair]:
    """Return the bodies of a mesh as closed surfaces with outward faces, and the repair.

    Do not remove triangles of zero area beforehand: they close T-junctions.

    Args:
        name: Name of the file, for error messages.
        vertices: Vertices (V, 3) [m], no two of them equal.
        triangles: Triangles (T, 3).

    Raises:
        InputError: If the mesh encloses no volume, cannot be closed without moving its surface by more than
            `MAX_MOVED`, or needs an extra that is not installed.
    """
    edges = find_open_edges(triangles)
    open_edges, where = len(edges), vertices[edges].reshape(-1, 3).mean(axis=0) if len(edges) else np.zeros(3)
    solid = to_manifold(vertices, triangles)
    closed = _is_solid(solid)
    if not closed:
        solid = _without_doubled_faces(vertices, triangles)
    if not _is_solid(solid):
        solid = to_manifold(vertices, close_edges(vertices, triangles))
    if not _is_solid(solid):
        gaps = f"{name} is not watertight ({open_edges} open edges around {np.round(where, 4).tolist()})"
        solid = _wrap(gaps, vertices, triangles)
    moved = left_out = 0.0
    if open_edges or not closed:
        moved = measure_distance(to_arrays(solid), (vertices, triangles))
        if moved > MAX_MOVED:
            raise InputError(
                f"{name} has a hole around {np.round(where, 4).tolist()} ({open_edges} open edges), which a repair "
                f"would close by moving the surface by {1e3 * moved:.2g} mm: close it in the CAD model, and export it "
                "again"
            )
        left_out = measure_distance((vertices, triangles), to_arrays(solid))
    bodies, cavities, inverted = _outward_bodies(solid)
    if not bodies:
        raise InputError(f"{name} encloses no volume: export the part as a solid")
    changed = open_edges if open_edges or closed else 1
    return bodies, Repair(changed, moved, left_out, cavities, inverted)


def _is_solid(solid: Any) -> bool:
    """Return True if a `manifold3d` solid is valid and not empty."""
    return bool(solid.status() == import_extra("manifold3d").Error.NoError and not solid.is_empty())


def _without_doubled_faces(vertices: np.ndarray, triangles: np.ndarray) -> Any:
    """Return the solid of a mesh without doubled faces and with consistent normals; it may be empty."""
    trimesh = import_extra("trimesh")
    mesh = trimesh.Trimesh(vertices, triangles, process=False)
    mesh.merge_vertices(digits_vertex=8)
    mesh.update_faces(mesh.unique_faces())
    if not mesh.is_winding_consistent:
        trimesh.repair.fix_winding(mesh)
    return to_manifold(np.asarray(mesh.vertices), np.asarray(mesh.faces))


def _wrap(gaps: str, vertices: np.ndarray, triangles: np.ndarray) -> Any:
    """Return the solid of triangles that may cross or leave gaps: the boundary of their tetrahedral mesh.

    `gaps` describes the gaps, and is the beginning of the error messages.

    Raises:
        InputError: If the software for the repair is not installed, or no attempt results in a solid.
    """
    if find_spec("pytetwild") is None or find_spec("pyvista") is None:
        raise InputError(
            f"{gaps}: close it in the CAD model, and export it again, or pip install 'guiderail[repair]', which closes "
            "small gaps"
        )
    best, nearest, reason = None, np.inf, "its result still has open edges"
    for _ in range(_ATTEMPTS):
        try:
            points, tetrahedra = run_isolated(
                tetrahedralize, vertices, triangles, _ENVELOPE, 0.15, False, cpu_seconds=_CPU_SECONDS
            )
            solid = to_manifold(*boundary_of(points, tetrahedra))
        except (IsolatedError, ValueError) as error:
            reason = str(error)
            break  # the next attempt would probably take as long
        if _is_solid(solid) and (moved := measure_distance(to_arrays(solid), (vertices, triangles))) < nearest:
            best, nearest = solid, moved
        if nearest <= MAX_MOVED:
            break
    if best is None:
        raise InputError(f"{gaps}, and the repair failed ({reason}): close it in the CAD model, and export it again")
    return best


def _outward_bodies(solid: Any) -> tuple[list[tuple[np.ndarray, np.ndarray]], int, int]:
    """Return the bodies of a solid with outward faces, and the numbers of cavities and of inverted bodies."""
    parts = solid.decompose()
    largest = max(abs(part.volume()) for part in parts)
    parts = [part for part in parts if abs(part.volume()) > _NEGLIGIBLE * largest]
    outer = [np.array(part.bounding_box()) for part in parts if part.volume() > 0.0]
    bodies, cavities, inverted = [], 0, 0
    for part in parts:
        vertices, triangles = to_arrays(part)
        if part.volume() < 0.0:
            box = np.array(part.bounding_box())
            if any((one[:3] < box[:3]).all() and (box[3:] < one[3:]).all() for one in outer):
                cavities += 1
                continue
            triangles, inverted = triangles[:, ::-1], inverted + 1
        bodies.append((vertices, triangles))
    return bodies, cavities, inverted


_FLAT = 1e-6  # largest distance of a flat face's vertices from its plane, due to rounding in text files [m]
_MAX_PLANES = 100  # largest number of planes that are tried
_AREA = 1e-6  # largest relative difference of areas due to rounding


def find_open_edges(triangles: np.ndarray) -> np.ndarray:
    """Return the edges (E, 2) of triangles (T, 3) that are not balanced by opposite edges of other triangles."""
    edges, balance, _, _ = _count_edges(triangles)
    return edges[balance != 0]


def close_edges(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Return the triangles of a mesh (V, 3), (T, 3) after the repair of its open edges; some edges may remain open.

    The triangles in one plane are removed. If no triangle is missing elsewhere, the open edges of the remaining
    triangles enclose the face in this plane. The face is replaced only if fewer edges are open afterwards.
    """
    triangles = _without_loose_triangles(triangles)
    open_edges = find_open_edges(triangles)
    for normal, distance in _planes(vertices, triangles, open_edges):
        if not len(open_edges):
            break
        inside = (np.abs(vertices @ normal - distance) < _FLAT)[triangles].all(axis=1)
        along = area_vectors(vertices, triangles) @ normal > 0.0
        # Triangles of the plane with the opposite normal belong to another face, or to this face but are inverted.
        for chosen in (inside, inside & along):
            face = _fill(vertices, triangles[~chosen], normal, distance)
            if face is None:
                continue
            changed = np.concatenate([triangles[~chosen], face])
            still_open = find_open_edges(changed)
            if len(still_open) < len(open_edges):
                triangles, open_edges = changed, still_open
                break
    return triangles


def _count_edges(triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return edges (E, 2), lower vertex first, their balance, their number of uses, and the uses (T, 3).

    Each triangle uses three edges; the uses are indices into `edges`. The balance of an edge is the number of uses from
    its lower to its higher vertex, minus the number of uses in the opposite direction.
    """
    uses = np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=2).reshape(-1, 2).astype(np.int64)
    size = int(triangles.max(initial=0)) + 1
    keys, inverse = np.unique(uses.min(axis=1) * size + uses.max(axis=1), return_inverse=True)
    balance = np.bincount(inverse, weights=np.sign(uses[:, 1] - uses[:, 0]), minlength=len(keys)).astype(int)
    number = np.bincount(inverse, weights=uses[:, 0] != uses[:, 1], minlength=len(keys)).astype(int)
    return np.column_stack([keys // size, keys % size]), balance, number, inverse.reshape(-1, 3)


def _without_loose_triangles(triangles: np.ndarray) -> np.ndarray:
    """Return triangles (T, 3) without the loose ones.

    A triangle is loose if its three edges are open and removing the triangle closes them.
    """
    while True:
        _, balance, number, used = _count_edges(triangles)
        signs = np.sign(np.roll(triangles, -1, axis=1) - triangles)
        loose = np.flatnonzero(((number[used] % 2 == 1) & (balance[used] == signs)).all(axis=1))
        taken, removed = set[int](), []
        for triangle in loose.tolist():  # if two loose triangles at one edge were removed, the edge would be open again
            edges = set(used[triangle].tolist())
            if not edges & taken:
                taken |= edges
                removed.append(triangle)
        if not removed:
            return triangles
        triangles = np.delete(triangles, removed, axis=0)


def _planes(vertices: np.ndarray, triangles: np.ndarray, edges: np.ndarray) -> list[tuple[np.ndarray, float]]:
    """Return the planes of triangles at `edges`, largest triangle first: normal (3,), distance from the origin [m]."""
    at_edge = np.isin(triangles, edges).sum(axis=1) >= 2
    near = triangles[at_edge]
    normals = area_vectors(vertices, near)
    sizes = np.linalg.norm(normals, axis=1)
    longest = np.linalg.norm(vertices[near] - vertices[np.roll(near, 1, axis=1)], axis=2).max(axis=1)
    found: list[tuple[np.ndarray, float]] = []
    for number in np.argsort(-sizes, kind="stable"):
        if sizes[number] < 10.0 * _FLAT * longest[number] or len(found) == _MAX_PLANES:
            continue
        normal = normals[number] / sizes[number]
        corners = vertices[near[number]]
        if not any(n @ normal > 0.0 and (np.abs(corners @ n - d) < _FLAT).all() for n, d in found):
            found.append((normal, float((corners @ normal).mean())))
    return found


def _fill(vertices: np.ndarray, rest: np.ndarray, normal: np.ndarray, distance: float) -> np.ndarray | None:
    """Return triangles (T, 3) with a given normal that close the open edges of `rest` in a plane, or None."""
    edges, balance, _, _ = _count_edges(rest)
    in_plane = (np.abs(vertices @ normal - distance) < _FLAT)[edges].all(axis=1)
    edges, balance = edges[in_plane & (balance != 0)], balance[in_plane & (balance != 0)]
    loops = _loops(np.where(balance[:, None] > 0, edges[:, ::-1], edges)) if (np.abs(balance) == 1).all() else None
    if not loops:
        return None
    first = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    first /= np.linalg.norm(first)
    axes = np.column_stack([first, np.cross(normal, first)])
    order = np.concatenate(loops)
    flat = 1e3 * (vertices[order] - vertices[order[0]]) @ axes
    polygons = np.split(flat, np.cumsum([len(loop) for loop in loops])[:-1])
    manifold3d = import_extra("manifold3d")
    face = np.asarray(manifold3d.triangulate([np.ascontiguousarray(one) for one in polygons])).reshape(-1, 3)
    enclosed = float(sum(map(_areas, polygons)))
    if not enclosed > 0.0 or abs(np.abs(_areas(flat[face])).sum() - enclosed) > _AREA * enclosed:
        return None
    return order[face]


def _areas(polygons: np.ndarray) -> np.ndarray:
    """Return the areas (...) of counterclockwise polygons (..., V, 2)."""
    following = np.roll(polygons, -1, axis=-2)
    return 0.5 * (polygons[..., 0] * following[..., 1] - polygons[..., 1] * following[..., 0]).sum(axis=-1)


def _loops(edges: np.ndarray) -> list[list[int]] | None:
    """Join directed edges (E, 2) into closed loops of distinct vertices; return None if a path remains open."""
    following = defaultdict(list)
    for start, end in edges.tolist():
        following[start].append(end)
    loops = []
    for start in list(following):
        path = [start] if following[start] else []
        position = {start: 0}
        while path:
            if not following[path[-1]]:
                if len(path) > 1:
                    return None
                break
            vertex = following[path[-1]].pop()
            if vertex in position:
                loops.append(path[position[vertex] :])
                for one in path[position[vertex] + 1 :]:
                    del position[one]
                del path[position[vertex] + 1 :]
            else:
                position[vertex] = len(path)
                path.append(vertex)
    return loops
