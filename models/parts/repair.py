"""Repair of meshes exported from CAD programs to closed solids: slivers, open seams, doubled faces, cavities."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any

import numpy as np

from guiderail.models.common.errors import InputError, import_extra
from guiderail.models.common.isolation import IsolatedError, run_isolated
from guiderail.models.parts.open_edges import close_edges, find_open_edges
from guiderail.models.parts.solids import measure_distance, to_arrays, to_manifold
from guiderail.models.parts.tetrahedra import boundary_of, tetrahedralize

MAX_MOVED = 1e-4  # largest motion of a surface by a repair; a larger one would close a real hole [m]
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
    left_out: float = 0.0  # largest distance of old faces that bound no volume from the new surface [m]
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

    Triangles of no area must not be removed before: they close T-junctions.

    Args:
        name: Name of the file, for error messages.
        vertices: Vertices (V, 3) [m]; equal points are one vertex.
        triangles: Triangles (T, 3).

    Raises:
        InputError: If the mesh cannot be closed, or only by moving its surface by more than `MAX_MOVED`.
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

    `gaps` are the gaps in words, for messages.
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
