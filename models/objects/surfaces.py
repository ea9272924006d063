"""What touches what, as convex solids: for engines that collide nothing else."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from guiderail.models.common.units import MM

# Convex pieces that only meet catch what slides over their seam: there the nearest way out of a piece is sideways. So
# each goes on for SHOULDER into its neighbours, and is BELOW their surface at its end: a way out at nine degrees.
SHOULDER, BELOW = 0.3 * MM, 0.05 * MM


@dataclass(frozen=True)
class Cylinder:
    """A cylinder about its z."""

    radius: float  # [m]
    length: float  # [m]


@dataclass(frozen=True)
class Box:
    """A box by its sizes."""

    x: float  # [m]
    y: float  # [m]
    z: float  # [m]


@dataclass(frozen=True)
class Hull:
    """The convex hull of vertices (V, 3) [m]."""

    vertices: np.ndarray


@dataclass(frozen=True)
class Spring:
    """What a surface gives way on, where the engine's own contact is too hard: a slide.

    Attributes:
        axis: along which it slides, (3,), in its body.
        stiffness: [N/m].
    """

    axis: tuple[float, float, float]
    stiffness: float


@dataclass(frozen=True)
class Surface:
    """A convex solid that touches.

    Attributes:
        name: of the solid, unlike any other's.
        pair: which other surfaces it touches: those of the other body's with the same pair, and nothing else.
        shape: what it is, in its own frame.
        friction: of the pair.
        position: of its frame in its body, (3,) [m].
        pitch: of its frame, about the body's y [rad].
        spring: what it is mounted on; None: on its body.
    """

    name: str
    pair: str
    shape: Cylinder | Box | Hull
    friction: float
    position: tuple[float, float, float] = field(default=(0.0, 0.0, 0.0))
    pitch: float = 0.0
    spring: Spring | None = None


def ring_hulls(profile: np.ndarray, num_sides: int) -> list[np.ndarray]:
    """The convex pieces of a ring about z with a polygon for every circle, whose corners are half a side from x.

    Args:
        profile: (K, 2), corners of its convex section as [radius of the circle inside the polygon, height] [m].
        num_sides: of the polygon, as `triangle_mesh.lathe` counts them.

    Returns:
        Vertices (4 K, 3) of each piece, shoulders included.
    """
    radius, height = np.asarray(profile, dtype=float).T
    radius = radius / np.cos(np.pi / num_sides)
    inwards = BELOW * np.sign(np.mean([radius, height], axis=1)[:, None] - [radius, height])
    hulls = []
    for corner in range(num_sides):
        ends = 2.0 * np.pi * (np.array([corner, corner + 1]) + 0.5) / num_sides
        middle = ends.mean()
        outward = np.array([np.cos(middle), np.sin(middle), 0.0])
        along = np.array([-np.sin(middle), np.cos(middle), 0.0])
        points = []
        for end, side in zip(ends, (-1.0, 1.0), strict=True):
            section = np.stack([radius * np.cos(end), radius * np.sin(end), height], axis=1)
            shoulder = section + side * SHOULDER * along + inwards[0][:, None] * outward
            shoulder[:, 2] += inwards[1]
            points += [section, shoulder]
        hulls.append(np.concatenate(points))
    return hulls
