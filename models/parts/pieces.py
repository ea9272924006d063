"""Pieces of a compliant part, and their files."""

from dataclasses import dataclass

import numpy as np

from guiderail.models.parts.mesh_file import obj_text
from guiderail.models.parts.tetrahedra import vtk_text


@dataclass(frozen=True)
class Piece:
    """Piece of a compliant part.

    Attributes:
        body: Index of its body in `ContactSurface.bodies`.
        suffix: ".obj" of a convex surface, or ".vtk" of tetrahedra.
        points: Points (P, 3) [m].
        cells: Triangles (T, 3) or tetrahedra (N, 4).
    """

    body: int
    suffix: str
    points: np.ndarray
    cells: np.ndarray


def piece_text(piece: Piece) -> str:
    """Return the file of a piece."""
    return (obj_text if piece.suffix == ".obj" else vtk_text)(piece.points, piece.cells)
