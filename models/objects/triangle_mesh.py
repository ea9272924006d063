"""Triangle meshes for Wavefront OBJ files."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


def cylindrical(radius: np.ndarray | float, angle: np.ndarray | float, height: np.ndarray | float) -> np.ndarray:
    """Return points (N, 3) from cylindrical coordinates about z."""
    radius, angle, height = np.broadcast_arrays(radius, angle, height)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=-1)


def equal_area_radius(radius: float, num_sides: int) -> float:
    """Return the circumradius [m] of the regular polygon that has the area of a circle of `radius` [m]."""
    turn = 2.0 * np.pi / num_sides
    return radius * float(np.sqrt(turn / np.sin(turn)))


def strip(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return quads (N-1, 4, 3) between two polylines (N, 3), counter-clockwise if `second` is right of `first`."""
    return np.stack([first[:-1], second[:-1], second[1:], first[1:]], axis=1)


@dataclass(frozen=True)
class TriangleMesh:
    """Triangle mesh: vertices (V, 3) [m] and triangles (T, 3), counter-clockwise as seen from outside."""

    vertices: np.ndarray
    triangles: np.ndarray

    @staticmethod
    def from_quads(quads: np.ndarray) -> "TriangleMesh":
        """Split counter-clockwise quads (Q, 4, 3) into triangles; merge equal corners and drop degenerate triangles."""
        corners = np.round(np.asarray(quads, dtype=float), 9).reshape(-1, 3) + 0.0  # -0.0 becomes 0.0
        vertices, numbers = np.unique(corners, axis=0, return_inverse=True)
        a, b, c, d = numbers.reshape(-1, 4).T
        triangles = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
        has_area = (triangles != np.roll(triangles, 1, axis=1)).all(axis=1)
        return TriangleMesh(vertices, triangles[has_area])

    def normals(self) -> np.ndarray:
        """Return the unit normals (T, 3) of the triangles."""
        a, b, c = (self.vertices[self.triangles[:, i]] for i in range(3))
        normal = np.cross(b - a, c - a)
        return normal / np.linalg.norm(normal, axis=1, keepdims=True)

    def to_obj(self) -> str:
        """Return an OBJ file's text: vertices rounded to 1 nm, and one normal per triangle, as renderers require."""
        lines = [f"v {x:.9f} {y:.9f} {z:.9f}" for x, y, z in self.vertices]
        lines += [f"vn {x:.4f} {y:.4f} {z:.4f}" for x, y, z in np.round(self.normals(), 4) + 0.0]
        for number, corners in enumerate(self.triangles + 1, start=1):
            lines.append("f " + " ".join(f"{corner}//{number}" for corner in corners))
        return "\n".join(lines) + "\n"


def lathe(profile: Sequence[tuple[float, float]], num_sides: int) -> TriangleMesh:
    """Return a surface of revolution about z with regular polygons for circles.

    The middle of a side lies on the x axis.

    Args:
        profile: (radius, height) [m] of each circle. Along the profile, with the radius plotted to the right and the
            height up, the outside is on the left: the wall of a bore is listed upwards, that of a shaft downwards.
        num_sides: Number of sides of the polygons.
    """
    angles = 2.0 * np.pi * (np.arange(num_sides + 1) + 0.5) / num_sides
    circles = [cylindrical(radius, angles, height) for radius, height in profile]
    return TriangleMesh.from_quads(
        np.concatenate([strip(first, second) for first, second in itertools.pairwise(circles)])
    )
