"""Solids of `manifold3d`, in millimeters, distances between surfaces in meters (libigl), and tetrahedral meshes.

Tetrahedra (fTetWild) are used for parts whose surface is not exactly closed, or that do not decompose into few convex
pieces.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import chdir
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from guiderail.models.common.errors import import_extra
from guiderail.models.objects.sdf import area_vectors

SCALE = 1e3  # from meters to millimeters, the unit that suits the tolerances of manifold3d and fTetWild


def to_manifold(vertices: np.ndarray, triangles: np.ndarray) -> Any:
    """Return a `manifold3d.Manifold` in millimeters from vertices (V, 3) [m] and triangles (T, 3)."""
    manifold3d = import_extra("manifold3d")
    mesh = manifold3d.Mesh64(np.ascontiguousarray(vertices * SCALE), np.ascontiguousarray(triangles, dtype=np.uint64))
    mesh.merge()
    return manifold3d.Manifold(mesh)


def hull_of(points: np.ndarray) -> Any:
    """Return the convex hull of points (P, 3) [m] as a solid; it is empty if they span no volume."""
    return import_extra("manifold3d").Manifold.hull_points(np.ascontiguousarray(points * SCALE))


def to_arrays(solid: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (V, 3) [m] and triangles (T, 3) of a solid."""
    mesh = solid.to_mesh64()
    return np.asarray(mesh.vert_properties)[:, :3] / SCALE, np.asarray(mesh.tri_verts).astype(int)


def join_surfaces(surfaces: Sequence[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (V, 3) [m] and triangles (T, 3) of several surfaces, at least one, as one surface."""
    starts = np.cumsum([0, *(len(vertices) for vertices, _ in surfaces)])
    triangles = [t + start for (_, t), start in zip(surfaces, starts, strict=False)]
    return np.concatenate([vertices for vertices, _ in surfaces]), np.concatenate(triangles)


NUM_SAMPLES = 2000  # default number of points sampled on a surface


class SurfaceLocator:
    """Nearest points on a triangle surface."""

    def __init__(self, vertices: np.ndarray, triangles: np.ndarray):
        """Construct the bounding volume hierarchy of triangles (T, 3), at least one, which index vertices (V, 3)."""
        self._vertices = np.ascontiguousarray(vertices, dtype=np.float64)
        self._triangles = np.ascontiguousarray(triangles, dtype=np.int64)
        self._tree: Any = import_extra("igl").AABB()
        self._tree.init(self._vertices, self._triangles)

    def find_nearest(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the nearest points (P, 3) to `points` (P, 3), their distances (P,) and triangles' indices (P,)."""
        points = np.ascontiguousarray(points, dtype=np.float64)
        if not len(points):
            return points, np.empty(0), np.empty(0, int)
        squared, faces, nearest = self._tree.squared_distance(self._vertices, self._triangles, points)
        distances = np.sqrt(np.maximum(squared, 0.0))
        return np.asarray(nearest).reshape(-1, 3), np.atleast_1d(distances), np.atleast_1d(faces)


def sample_surface(vertices: np.ndarray, triangles: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return points (P, 3) of a surface and the indices of their triangles (P,): uniform samples, and corners.

    The `count` samples are the same in every call. The corners are every n-th corner of the mesh, fewer than
    `2 * count`.
    """
    corners = vertices[triangles]
    cumulative = np.cumsum(0.5 * np.linalg.norm(area_vectors(vertices, triangles), axis=1))
    rng = np.random.default_rng(0)
    chosen = np.searchsorted(cumulative, rng.uniform(0.0, cumulative[-1], count)).clip(0, len(triangles) - 1)
    u, v = np.sqrt(rng.uniform(size=count)), rng.uniform(size=count)
    weights = np.column_stack([1.0 - u, u * (1.0 - v), u * v])
    inner = np.einsum("pi,pij->pj", weights, corners[chosen])
    every = max(1, 3 * len(triangles) // count)
    owners = np.repeat(np.arange(len(triangles)), 3)[::every]
    return np.concatenate([inner, corners.reshape(-1, 3)[::every]]), np.concatenate([chosen, owners])


def measure_distance(
    points_of: tuple[np.ndarray, np.ndarray], surface: tuple[np.ndarray, np.ndarray], count: int = NUM_SAMPLES
) -> float:
    """Return the largest distance of sampled points of one surface from another surface [m].

    See `measure_deviation` for the arguments.
    """
    points, _ = sample_surface(*points_of, count)
    return float(SurfaceLocator(*surface).find_nearest(points)[1].max())


def measure_deviation(
    first: tuple[np.ndarray, np.ndarray], second: tuple[np.ndarray, np.ndarray], count: int = NUM_SAMPLES
) -> float:
    """Return the sampled Hausdorff distance of two surfaces [m].

    Each surface is a pair of vertices (V, 3) [m] and triangles (T, 3). See `sample_surface` for `count`.
    """
    return max(measure_distance(first, second, count), measure_distance(second, first, count))


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

    Raises:
        ValueError: If the triangles enclose no volume.
    """
    diagonal = float(np.linalg.norm(np.ptp(vertices, axis=0)))
    mesher = import_extra("pytetwild")
    with TemporaryDirectory() as folder, chdir(folder):  # the mesher writes a file into the current folder
        points, cells = mesher.tetrahedralize(
            np.ascontiguousarray(SCALE * vertices),
            np.ascontiguousarray(triangles, dtype=np.int32),
            edge_length_abs=SCALE * edge * diagonal,
            epsilon=tolerance / diagonal,
            optimize=optimize,
            stop_energy=100.0,
            num_opt_iter=5,
            num_threads=1,
            quiet=True,
        )[:2]
    points, cells = np.asarray(points, dtype=float) / SCALE, np.asarray(cells).reshape(-1, 4).astype(int)
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
    """Return vertices (V, 3) [m] and outward triangles (T, 3) of the boundary of tetrahedra (N, 4)."""
    used, faces = np.unique(_boundary_faces(cells), return_inverse=True)
    return points[used], faces.reshape(-1, 3)


def _boundary_faces(cells: np.ndarray) -> np.ndarray:
    """Return the faces (T, 3) that belong to one tetrahedron only."""
    faces = np.concatenate([cells[:, corners] for corners in _FACES])
    _, first, count = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
    return faces[first[count == 1]]


def add_interior_points(points: np.ndarray, cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Split each tetrahedron at its center if all its corners are on the boundary, where the pressure is zero.

    Points are (P, 3) [m] and tetrahedra (N, 4); returns new arrays of both.
    """
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
    """Return the text of a VTK file of points (P, 3) [m] and tetrahedra (N, 4)."""
    lines = ["# vtk DataFile Version 3.0", "guiderail", "ASCII", "DATASET UNSTRUCTURED_GRID"]
    lines += [f"POINTS {len(points)} double", *(f"{x:.9g} {y:.9g} {z:.9g}" for x, y, z in points)]
    lines += [f"CELLS {len(cells)} {5 * len(cells)}", *(f"4 {a} {b} {c} {d}" for a, b, c, d in cells)]
    return "\n".join([*lines, f"CELL_TYPES {len(cells)}", *["10"] * len(cells)]) + "\n"
