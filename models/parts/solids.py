"""Solids of `manifold3d`, in millimeters, and their vertices and triangles in meters."""

from importlib import import_module
from typing import Any

import numpy as np

from guiderail.models.common.errors import InputError

_SCALE = 1e3  # from meters to millimeters, for which the tolerances of manifold3d are meant


def require_module(module: str) -> Any:
    """Import an optional library for meshes.

    Raises:
        InputError: If it is not installed.
    """
    try:
        return import_module(module)
    except ImportError:
        raise InputError(f"meshes need {module}, which is not installed: pip install 'guiderail[onboard]'") from None


def to_manifold(vertices: np.ndarray, triangles: np.ndarray) -> Any:
    """Return a `manifold3d.Manifold` in millimeters from vertices (V, 3) [m] and triangles (T, 3)."""
    manifold3d = require_module("manifold3d")
    mesh = manifold3d.Mesh64(np.ascontiguousarray(vertices * _SCALE), np.ascontiguousarray(triangles, dtype=np.uint64))
    mesh.merge()
    return manifold3d.Manifold(mesh)


def to_arrays(solid: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (V, 3) [m] and triangles (T, 3) of a solid."""
    mesh = solid.to_mesh64()
    return np.asarray(mesh.vert_properties)[:, :3] / _SCALE, np.asarray(mesh.tri_verts).astype(int)
