"""Overlap of assembled parts, its position and depth, and a plug that is shrunk to avoid it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from guiderail.models.common.errors import InputError
from guiderail.models.common.units import MM
from guiderail.models.parts.assembly_check import MAX_RESTING_OVERLAP, make_solids, measure_overlap
from guiderail.models.parts.mesh_file import Part
from guiderail.models.parts.solids import to_arrays, to_manifold
from guiderail.models.parts.surface_distance import SurfaceLocator, sample_surface

MAX_SHRINK = 0.5 * MM  # largest distance that is offered; parts that overlap more are not drawn assembled [m]
_SPARE = 0.01 * MM  # clearance left by the offered distance [m]
_SAMPLES = 1000  # points on the surface of a common volume
_REGULARIZATION = 1e-3  # relative weight of a vertex that does not move along a face


class OverlapError(InputError):
    """The parts overlap at the target.

    Attributes:
        shrink: Distance by which the plug's surface would have to move inwards [m]; None if that is too much.
    """

    def __init__(self, message: str, shrink: float | None):
        """Construct the error; see the attributes."""
        super().__init__(message)
        self.shrink = shrink


def check_target(plug: Part, socket: Part) -> None:
    """Check that the parts do not overlap with the plug at its target.

    Raises:
        OverlapError: If they do, with the depth, the position, and the distance that `shrink` would need.
    """
    plug_solids, socket_solids = make_solids(plug), make_solids(socket)
    thickness, where = measure_overlap(plug_solids, socket_solids)
    if thickness <= MAX_RESTING_OVERLAP:
        return
    depth = measure_depth(plug_solids, socket_solids)
    needed = 1e-5 * np.ceil((depth + _SPARE) / 1e-5 - 1e-3)
    place = (
        f"overlap at the target by about {1e3 * depth:.2g} mm, around {np.round(1e3 * where, 1)} mm in the target frame"
    )
    if needed > MAX_SHRINK:
        raise OverlapError(
            f"the parts {place}: draw them assembled in one frame, or place the plug with --plug-pose", None
        )
    raise OverlapError(
        f"the parts {place}: --shrink {1e3 * needed:.2f} makes the plug smaller by that much; else correct the "
        "drawing, or place the plug with --plug-pose",
        float(needed),
    )


def measure_depth(first: Sequence[Any], second: Sequence[Any]) -> float:
    """Return the largest distance of a point of the common volume from the surface of the second part [m]."""
    deepest = 0.0
    for one in first:
        for other in second:
            common = one ^ other
            if not common.is_empty():
                # Corners of the common volume lie on both surfaces: the deepest points are between them.
                points, _ = sample_surface(*to_arrays(common), _SAMPLES)
                deepest = max(deepest, float(SurfaceLocator(*to_arrays(other)).find_nearest(points)[1].max()))
    return deepest


def shrink(part: Part, distance: float) -> Part:
    """Return a part whose faces are moved inwards by a distance [m].

    Each vertex moves such that the planes of its faces move by the distance, in the sense of least squares.

    Raises:
        InputError: If the part would have no volume left.
    """
    bodies = []
    for vertices, triangles in part.bodies:
        smaller = vertices + _vertex_motion(vertices, triangles, distance)
        if to_manifold(smaller, triangles).volume() <= 0.0:
            raise InputError(f"{part.path.name} is too thin for --shrink {1e3 * distance:g}")
        bodies.append((smaller, triangles))
    return Part(part.path, tuple(bodies), part.repair)


def _vertex_motion(vertices: np.ndarray, triangles: np.ndarray, distance: float) -> np.ndarray:
    corners = vertices[triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.where(areas > 1e-14, normals / np.maximum(areas, 1e-30), 0.0)
    matrices, sides = np.zeros((len(vertices), 3, 3)), np.zeros((len(vertices), 3))
    for i in range(3):
        one, two = corners[:, (i + 1) % 3] - corners[:, i], corners[:, (i + 2) % 3] - corners[:, i]
        lengths = np.linalg.norm(one, axis=1) * np.linalg.norm(two, axis=1)
        cosine = np.einsum("ij,ij->i", one, two) / np.maximum(lengths, 1e-30)
        angle = np.arccos(np.clip(cosine, -1.0, 1.0))  # the weight of a face must not depend on its triangulation
        np.add.at(matrices, triangles[:, i], angle[:, None, None] * normals[:, :, None] * normals[:, None, :])
        np.add.at(sides, triangles[:, i], angle[:, None] * normals)
    weight = _REGULARIZATION * np.trace(matrices, axis1=1, axis2=2)[:, None, None] + 1e-12
    motion = -distance * np.linalg.solve(matrices + weight * np.eye(3), sides[..., None])[..., 0]
    length = np.linalg.norm(motion, axis=1, keepdims=True)
    return motion * np.minimum(1.0, 2.0 * distance / np.maximum(length, 1e-30))
