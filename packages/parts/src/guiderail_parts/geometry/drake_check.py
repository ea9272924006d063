"""Selection of compliant contact pieces that Drake accepts: degenerate pieces raise an error or abort the process."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from guiderail_parts.geometry.mesh_file import obj_text
from guiderail_parts.geometry.solids import hull_of, to_arrays, vtk_text
from guiderail_parts.isolation import IsolatedError, run_isolated


@dataclass(frozen=True)
class Piece:
    """Piece of a compliant part."""

    body: int  # index of the piece's body in `ContactSurface.bodies`
    suffix: str  # ".obj" of a convex surface, or ".vtk" of tetrahedra
    points: np.ndarray  # points (P, 3) [m]
    cells: np.ndarray  # triangles (T, 3) or tetrahedra (N, 4)


def piece_text(piece: Piece) -> str:
    """Return the text of a piece's OBJ or VTK file."""
    return (obj_text if piece.suffix == ".obj" else vtk_text)(piece.points, piece.cells)


_GRIDS = (6, 5)  # decimal places [m] to which a refused convex piece is rounded, in the order of the attempts
_NEGLIGIBLE = 1e-4  # fraction of the volume of all pieces below which a refused piece is left out
_SECONDS = 20  # largest CPU time of a check [s]


def accepted_pieces(pieces: Sequence[Piece]) -> list[Piece] | None:
    """Return pieces that Drake accepts; a refused piece is rounded to a grid, or left out if it is negligible.

    Returns:
        The pieces; None if a refused piece can be neither rounded nor left out, or has tetrahedra.
    """
    refused = _refused(pieces)
    if not refused:
        return list(pieces)
    if any(pieces[number].suffix != ".obj" for number in refused):
        return None
    total, accepted = sum(map(_hull_volume, pieces)), []
    for number, piece in enumerate(pieces):
        if number not in refused:
            accepted.append(piece)
            continue
        for rounded in _rounded(piece):
            if not _refused([rounded]):
                accepted.append(rounded)
                break
        else:
            if _hull_volume(piece) > _NEGLIGIBLE * total:
                return None
    return accepted


def _hull_volume(piece: Piece) -> float:
    return float(hull_of(piece.points).volume()) if piece.suffix == ".obj" else 0.0


def _rounded(piece: Piece) -> list[Piece]:
    """Return copies of a convex piece with vertices rounded to each of `_GRIDS`, if they span a volume."""
    hulls = [hull_of(np.unique(np.round(piece.points, digits), axis=0)) for digits in _GRIDS]
    arrays = [to_arrays(hull) for hull in hulls if not hull.is_empty()]
    return [replace(piece, points=points, cells=cells) for points, cells in arrays]


def _refused(pieces: Sequence[Piece]) -> set[int]:
    """Return the indices of the pieces that Drake refuses; an abort only ends the child process of the check."""
    if not pieces:
        return set()
    try:
        return set(run_isolated(_try_each, pieces, cpu_seconds=_SECONDS))
    except IsolatedError:
        if len(pieces) == 1:
            return {0}
        half = len(pieces) // 2
        return _refused(pieces[:half]) | {half + number for number in _refused(pieces[half:])}


def _try_each(pieces: Sequence[Piece]) -> list[int]:
    from pydrake.geometry import (
        AddCompliantHydroelasticProperties,
        AddContactMaterial,
        Convex,
        GeometryInstance,
        Mesh,
        ProximityProperties,
        SceneGraph,
    )
    from pydrake.math import RigidTransform
    from pydrake.multibody.plant import CoulombFriction

    refused = []
    with TemporaryDirectory() as folder:
        for number, piece in enumerate(pieces):
            file = Path(folder) / f"{number}{piece.suffix}"
            file.write_text(piece_text(piece), encoding="utf-8")
            properties = ProximityProperties()
            AddContactMaterial(1.0, None, CoulombFriction(0.2, 0.2), properties)
            AddCompliantHydroelasticProperties(0.01, 1e9, properties)
            shape = Convex(str(file)) if piece.suffix == ".obj" else Mesh(str(file))
            instance = GeometryInstance(RigidTransform(), shape, "piece")
            instance.set_proximity_properties(properties)
            graph = SceneGraph()
            source = graph.RegisterSource("check")
            try:
                graph.RegisterAnchoredGeometry(source, instance)
            except RuntimeError:
                refused.append(number)
    return refused
