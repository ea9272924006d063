"""The SDF files of a task folder, written from its numbers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from guiderail.models.objects.sdf import ContactMaterial, at, collision, convex_mesh, mesh, model, visual
from guiderail.models.objects.triangle_mesh import TriangleMesh


class Surface(Protocol):
    """A mesh that touches."""

    file: str
    modulus: float | None
    friction: float
    dissipation: float


def obj_text(vertices: np.ndarray, triangles: np.ndarray) -> str:
    """An OBJ file of vertices (V, 3) [m] and triangles (T, 3); triangles that are next to nothing are left out."""
    corners = vertices[triangles]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    return TriangleMesh(vertices, triangles[area > 1e-10]).to_obj()


def part_sdf(
    name: str,
    shown: str,
    surfaces: Sequence[Surface],
    *,
    mass: float,
    centre: Sequence[float],
    gyration: float,
    colour: str,
) -> str:
    """A model of one link, `name`, with geometry `piece_0`, …: a compliant piece is convex, a rigid one any mesh."""
    contents = visual("visual", at(), mesh(shown), colour)
    for number, surface in enumerate(surfaces):
        geometry = mesh(surface.file) if surface.modulus is None else convex_mesh(surface.file)
        material = ContactMaterial(surface.friction, surface.modulus, dissipation=surface.dissipation)
        contents += collision(f"piece_{number}", at(), geometry, material)
    return model(name, mass, centre, gyration, contents, source="guiderail from task.yaml")
