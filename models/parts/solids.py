"""Solids of `manifold3d`, in millimeters, and distances between triangle surfaces in meters (libigl)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from guiderail.models.common.errors import import_extra
from guiderail.models.objects.sdf import area_vectors

_SCALE = 1e3  # from meters to millimeters, for which the tolerances of manifold3d are meant


def to_manifold(vertices: np.ndarray, triangles: np.ndarray) -> Any:
    """Return a `manifold3d.Manifold` in millimeters from vertices (V, 3) [m] and triangles (T, 3)."""
    manifold3d = import_extra("manifold3d")
    mesh = manifold3d.Mesh64(np.ascontiguousarray(vertices * _SCALE), np.ascontiguousarray(triangles, dtype=np.uint64))
    mesh.merge()
    return manifold3d.Manifold(mesh)


def to_arrays(solid: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (V, 3) [m] and triangles (T, 3) of a solid."""
    mesh = solid.to_mesh64()
    return np.asarray(mesh.vert_properties)[:, :3] / _SCALE, np.asarray(mesh.tri_verts).astype(int)


def join_surfaces(surfaces: Sequence[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (V, 3) and triangles (T, 3) of several surfaces as one surface."""
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
        """Return the nearest points (P, 3) to `points` (P, 3), their distances (P,) and triangles (P,)."""
        points = np.ascontiguousarray(points, dtype=np.float64)
        if not len(points):
            return points, np.empty(0), np.empty(0, int)
        squared, faces, nearest = self._tree.squared_distance(self._vertices, self._triangles, points)
        distances = np.sqrt(np.maximum(squared, 0.0))
        return np.asarray(nearest).reshape(-1, 3), np.atleast_1d(distances), np.atleast_1d(faces)


def sample_surface(vertices: np.ndarray, triangles: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return points (P, 3) of a surface and their triangles (P,): uniform samples, and corners of triangles.

    There are `count` samples and fewer than `2 * count` corners, every n-th one of the mesh. The samples are the
    same in every call.
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
    """Return the largest distance of sampled points of one surface from another, each as in `measure_deviation`."""
    points, _ = sample_surface(*points_of, count)
    return float(SurfaceLocator(*surface).find_nearest(points)[1].max())


def measure_deviation(
    first: tuple[np.ndarray, np.ndarray], second: tuple[np.ndarray, np.ndarray], count: int = NUM_SAMPLES
) -> float:
    """Return the sampled Hausdorff distance of two surfaces, each as vertices (V, 3) and triangles (T, 3)."""
    return max(measure_distance(first, second, count), measure_distance(second, first, count))
