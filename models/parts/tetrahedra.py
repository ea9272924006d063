"""Tetrahedral meshes of parts that do not close exactly, or do not decompose into few convex pieces (fTetWild)."""

from __future__ import annotations

from contextlib import chdir
from tempfile import TemporaryDirectory

import numpy as np

from guiderail.models.common.errors import import_extra

_FACES = ([0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3])
_FLAT = 1e-21  # six times the volume below which a tetrahedron is degenerate [m³]


def tetrahedralize(
    vertices: np.ndarray, triangles: np.ndarray, tolerance: float, edge: float = 0.15, optimize: bool = True
) -> tuple[np.ndarray, np.ndarray]:
    """Return points (P, 3) [m] and tetrahedra (N, 4) of the volume within triangles that may cross or leave gaps.

    Args:
        vertices: Vertices (V, 3) [m].
        triangles: Triangles (T, 3).
        tolerance: Largest deviation of the boundary [m].
        edge: Desired length of an edge, as a fraction of the diagonal of the bounding box.
        optimize: True to improve the shape of the tetrahedra, which takes most of the time.
    """
    scale = 1e3  # tolerances of fTetWild are meant for numbers around one
    diagonal = float(np.linalg.norm(np.ptp(vertices, axis=0)))
    mesher = import_extra("pytetwild")
    with TemporaryDirectory() as folder, chdir(folder):  # the mesher writes a file into the current folder
        points, cells = mesher.tetrahedralize(
            np.ascontiguousarray(scale * vertices),
            np.ascontiguousarray(triangles, dtype=np.int32),
            edge_length_abs=scale * edge * diagonal,
            epsilon=tolerance / diagonal,
            optimize=optimize,
            stop_energy=100.0,
            num_opt_iter=5,
            num_threads=1,
            quiet=True,
        )[:2]
    points, cells = np.asarray(points, dtype=float) / scale, np.asarray(cells).reshape(-1, 4).astype(int)
    if not len(cells):
        raise ValueError("no volume")
    return points, _oriented(points, cells)


def _oriented(points: np.ndarray, cells: np.ndarray) -> np.ndarray:
    a, b, c, d = (points[cells[:, i]] for i in range(4))
    volumes = np.einsum("ij,ij->i", np.cross(b - a, c - a), d - a)
    cells = cells.copy()
    cells[volumes < 0.0] = cells[volumes < 0.0][:, [0, 2, 1, 3]]
    return cells[np.abs(volumes) > _FLAT]


def boundary_of(points: np.ndarray, cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (V, 3) and outward triangles (T, 3) of the boundary of tetrahedra."""
    used, faces = np.unique(_boundary_faces(cells), return_inverse=True)
    return points[used], faces.reshape(-1, 3)


def _boundary_faces(cells: np.ndarray) -> np.ndarray:
    """Return the faces (T, 3) that belong to one tetrahedron only."""
    faces = np.concatenate([cells[:, corners] for corners in _FACES])
    _, first, count = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
    return faces[first[count == 1]]


def add_interior_points(points: np.ndarray, cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Split each tetrahedron at its center if all its corners are on the boundary, where the pressure is zero."""
    is_outer = np.zeros(len(points), bool)
    is_outer[_boundary_faces(cells)] = True
    flat = is_outer[cells].all(axis=1)
    centers = points[cells[flat]].mean(axis=1)
    center = len(points) + np.arange(len(centers))
    a, b, c, d = cells[flat].T
    split = [(a, b, c, center), (a, b, center, d), (a, center, c, d), (center, b, c, d)]
    points = np.concatenate([points, centers])
    return points, _oriented(points, np.concatenate([cells[~flat], *(np.column_stack(one) for one in split)]))


def vtk_text(points: np.ndarray, cells: np.ndarray) -> str:
    """Return a VTK file of points (P, 3) [m] and tetrahedra (N, 4)."""
    lines = ["# vtk DataFile Version 3.0", "guiderail", "ASCII", "DATASET UNSTRUCTURED_GRID"]
    lines += [f"POINTS {len(points)} double", *(f"{x:.9g} {y:.9g} {z:.9g}" for x, y, z in points)]
    lines += [f"CELLS {len(cells)} {5 * len(cells)}", *(f"4 {a} {b} {c} {d}" for a, b, c, d in cells)]
    return "\n".join([*lines, f"CELL_TYPES {len(cells)}", *["10"] * len(cells)]) + "\n"
