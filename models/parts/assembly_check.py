"""How a plug fits its socket: where both overlap, how much room is between their walls, how far out is clear."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from guiderail.models.common.errors import InputError
from guiderail.models.parts.convex_decomposition import as_arrays, as_solid
from guiderail.models.parts.mesh_file import Part, need

ACROSS = 0.5  # a wall's normal has less than this along the axis
# Faces that rest on each other overlap by rounding; deeper is a fault [m].
RESTING = 2e-6
_SAMPLES = 4000


@dataclass(frozen=True)
class Motion:
    """How a plug comes to its target, along z and about it.

    Attributes:
        travel: how far above the target it starts [m].
        rim: at what height its lowest point is level with the socket's highest [m].
        turn: by how much it turns at the end, counter-clockwise as seen from above [rad].
    """

    travel: float
    rim: float
    turn: float = 0.0

    def path(self, steps: int = 24) -> list[tuple[float, float]]:
        """Heights [m] and turns [rad] from the rim to the target."""
        down = [(float(z), -self.turn) for z in np.linspace(self.rim, 0.0, steps)]
        turning = np.linspace(-self.turn, 0.0, steps)[1:] if self.turn else np.empty(0)
        return down + [(0.0, float(angle)) for angle in turning]


def solids(part: Part) -> list[Any]:
    """A part's bodies as solids.

    Raises:
        InputError: if one of them has faces that cross each other.
    """
    found = []
    for vertices, triangles in part.bodies:
        solid = as_solid(vertices, triangles)
        if solid.is_empty():
            raise InputError(
                f"{part.path.name} has faces that cross each other (manifold3d: {solid.status()}): unite its bodies "
                "where it was drawn, and export it again"
            )
        found.append(solid)
    return found


def turned(solid: Any, height: float, angle: float) -> Any:
    """A solid turned by `angle` [rad] about z and lifted by `height` [m]."""
    return solid.rotate((0.0, 0.0, float(np.rad2deg(angle)))).translate((0.0, 0.0, 1e3 * height))


def overlap(first: Sequence[Any], second: Sequence[Any]) -> tuple[float, np.ndarray]:
    """How thick the thickest overlap of two parts is [m], about, and where (3,) [m].

    The thickness of an overlap is twice its volume by its surface, that of a sheet.
    """
    thickest, where = 0.0, np.zeros(3)
    for one in first:
        for other in second:
            for common in (one ^ other).decompose():
                area = common.surface_area()
                thickness = 2e-3 * common.volume() / area if area > 0.0 else 0.0
                if thickness > thickest:
                    thickest = thickness
                    where = as_arrays(common)[0].mean(axis=0)
    return thickest, where


def centre_of_mass(part: Part) -> np.ndarray:
    """Of a part of one density, (3,) [m]; it lies on the axis of what is the same after a part of a turn."""
    trimesh = need("trimesh")
    meshes = [trimesh.Trimesh(vertices, triangles, process=False) for vertices, triangles in part.bodies]
    volumes = np.array([mesh.volume for mesh in meshes])
    return volumes @ np.array([mesh.center_mass for mesh in meshes]) / volumes.sum()


def check_target(plug: Part, socket: Part) -> None:
    """Refuses parts that overlap where the plug should be.

    Raises:
        InputError: saying by how much, and where.
    """
    thickness, where = overlap(solids(plug), solids(socket))
    if thickness > RESTING:
        raise InputError(
            f"the parts overlap at the target by about {1e3 * thickness:.2g} mm, around {np.round(1e3 * where, 1)} mm "
            "in the target frame: draw them assembled in one frame, or say with --place where the plug goes"
        )


def motion(plug: Part, socket: Part, turn: float, clear: float = 3e-3) -> Motion:
    """From how high the plug comes: `clear` [m] above the socket.

    Raises:
        InputError: if it is above the socket at the target already.
    """
    rim = float(socket.bounds[1, 2] - plug.bounds[0, 2])
    if rim < 5e-4:
        raise InputError(
            f"the plug ends {max(-rim, 0.0) * 1e3:.1f} mm above the socket at the target and goes into nothing: draw "
            "them assembled, say with --place where it goes, or with --axis which way it comes out"
        )
    return Motion(travel=rim + clear, rim=rim, turn=turn)


def side_clearance(plug: Part, socket: Part) -> float:
    """The least distance between walls along the axis at the target [m]."""
    trimesh = need("trimesh")
    meshes = [_walls(part) for part in (plug, socket)]
    least = np.inf
    for one, other in (meshes, meshes[::-1]):
        if not len(one.faces) or not len(other.faces):
            continue
        count = min(_SAMPLES, 40 * len(one.faces))
        points, faces = trimesh.sample.sample_surface(one, count, seed=0)
        points = np.concatenate([points, one.vertices])
        normals = np.concatenate([one.face_normals[faces], one.vertex_normals])
        # Walls of the two that face each other: a distance to the back of a wall, or past a corner, is none.
        near, distance, face = nearest_on_surface(points, other.triangles)
        facing = np.einsum("ij,ij->i", normals, other.face_normals[face]) < -0.7
        towards = np.einsum("ij,ij->i", normals, near - points) > -1e-9
        if (facing & towards).any():
            least = min(least, float(distance[facing & towards].min()))
    return least


def _walls(part: Part) -> Any:
    trimesh = need("trimesh")
    mesh = trimesh.util.concatenate([trimesh.Trimesh(v, t, process=False) for v, t in part.bodies])
    return mesh.submesh([np.flatnonzero(np.abs(mesh.face_normals[:, 2]) < ACROSS)], append=True, only_watertight=False)


def nearest_on_surface(points: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The nearest point (P, 3), its distance (P,) and its triangle (P,) for points (P, 3) and triangles (T, 3, 3)."""
    trimesh = need("trimesh")
    nearest, distances, faces = np.zeros_like(points), np.full(len(points), np.inf), np.zeros(len(points), int)
    chunk = max(1, 400_000 // max(len(triangles), 1))
    for start in range(0, len(points), chunk):
        some = points[start : start + chunk]
        pairs = np.repeat(some, len(triangles), axis=0)
        on = trimesh.triangles.closest_point(np.tile(triangles, (len(some), 1, 1)), pairs)
        apart = np.linalg.norm(on - pairs, axis=1).reshape(len(some), -1)
        best = apart.argmin(axis=1)
        rows = slice(start, start + len(some))
        nearest[rows] = on.reshape(len(some), -1, 3)[np.arange(len(some)), best]
        distances[rows], faces[rows] = apart.min(axis=1), best
    return nearest, distances, faces


def in_the_way(plug: Part, socket: Part, motion: Motion) -> list[tuple[float, float]]:
    """For each of the plug's bodies how much it overlaps the socket at most on its way [m], and at what height [m]."""
    fixed, found = solids(socket), []
    for body in solids(plug):
        most = max(((overlap([turned(body, z, a)], fixed)[0], z) for z, a in motion.path()), key=lambda one: one[0])
        found.append(most)
    return found
