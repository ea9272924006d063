"""A part from a mesh file: read, brought to metres, and refused in a sentence where it is no solid."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from guiderail.models.common.errors import InputError, brief

ENDINGS = (".stl", ".obj", ".glb", ".step", ".stp")
UNITS = {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "inch": 0.0254}
"""What one unit of a file is [m]."""

SMALLEST, LARGEST = 1e-3, 0.5  # [m] of a part that an arm inserts, its longest side
_KNOWN = {".glb": "m", ".step": "m", ".stp": "m"}  # formats that say their unit, and in what they are read


@dataclass(frozen=True)
class Part:
    """A solid of one or several bodies.

    Attributes:
        path: where it came from.
        bodies: vertices (V, 3) [m] and triangles (T, 3) of each, counter-clockwise as seen from outside.
    """

    path: Path
    bodies: tuple[tuple[np.ndarray, np.ndarray], ...]

    @property
    def bounds(self) -> np.ndarray:
        """The lowest and the highest corner, (2, 3) [m]."""
        points = np.concatenate([vertices for vertices, _ in self.bodies])
        return np.stack([points.min(axis=0), points.max(axis=0)])

    def moved(self, rotation: np.ndarray, translation: np.ndarray) -> Part:
        """The part with every point p at R p + t; rotation (3, 3), translation (3,) [m]."""
        return Part(self.path, tuple((v @ rotation.T + translation, t) for v, t in self.bodies))


def need(module: str) -> Any:
    """A library that only onboarding needs.

    Raises:
        InputError: if it is not installed.
    """
    try:
        return import_module(module)
    except ImportError:
        raise InputError(f"meshes need {module}, which is not installed: pip install 'guiderail[onboard]'") from None


def unit_of(path: Path, given: str | None) -> str | None:
    """The unit of a file: what its format says, or what was given; None where nobody said.

    Raises:
        InputError: for a unit that there isn't, or one that the format contradicts.
    """
    if given is not None and given not in UNITS:
        raise InputError(f"there is no unit {given!r}: choose one of {', '.join(UNITS)}")
    known = _KNOWN.get(path.suffix.lower())
    if known and given not in (None, known):
        raise InputError(f"{path.name} is read in metres, as its format says: leave --unit {given} out")
    return known or given


def load_part(path: Path, unit: str) -> Part:
    """Reads a mesh file.

    Args:
        path: of STL, OBJ, GLB, or STEP where cascadio is installed.
        unit: one of `UNITS`, of the file's numbers.

    Raises:
        InputError: if the file can't be read, or is not watertight, is hollow, inside out or of a size that no arm
            inserts.
    """
    if path.suffix.lower() not in ENDINGS:
        raise InputError(f"{path} has the ending {path.suffix!r}: a part is {', '.join(ENDINGS[:-1])}")
    if not path.is_file():
        raise InputError(f"there is no file {path}: name the part's mesh")
    mesh = _read(path)
    if mesh is None or not len(mesh.faces):
        raise InputError(f"{path} holds no triangles: export the part as a mesh")
    mesh.merge_vertices(merge_norm=True, merge_tex=True)
    mesh.update_faces(mesh.nondegenerate_faces())
    if not np.isfinite(mesh.vertices).all():
        raise InputError(f"{path} holds vertices that are no numbers: export it again")
    size = float(mesh.extents.max()) * UNITS[unit]
    if not SMALLEST <= size <= LARGEST:
        fitting = [name for name, scale in UNITS.items() if SMALLEST <= size / UNITS[unit] * scale <= LARGEST]
        remedy = f"is its unit {' or '.join(fitting)}?" if fitting else f"give parts of {SMALLEST} to {LARGEST} m"
        raise InputError(f"{path.name} would be {size:.3g} m long with --unit {unit}: {remedy}")
    bodies = []
    found = mesh.split(only_watertight=False, repair=False)
    for body in found:
        _check_body(path, body, found)
        bodies.append((np.asarray(body.vertices) * UNITS[unit], np.asarray(body.faces)))
    return Part(path, tuple(bodies))


def _read(path: Path) -> Any:
    trimesh = need("trimesh")
    if path.suffix.lower() in (".step", ".stp"):
        need("cascadio")
    try:
        return trimesh.load(path, force="mesh", process=False)
    except Exception as error:  # whatever a damaged file makes a parser raise
        raise InputError(f"{path} can't be read as a mesh ({brief(str(error))}): export it again") from error


def _encloses(outer: Any, inner: Any) -> bool:
    """Whether a body with its faces outwards is around another, as far as their boxes tell."""
    (low, high), (inner_low, inner_high) = outer.bounds, inner.bounds
    return bool(outer.volume > 0.0 and (low < inner_low).all() and (inner_high < high).all())


def _check_body(path: Path, body: Any, bodies: Sequence[Any]) -> None:
    edges = np.sort(body.edges, axis=1)
    _, counts = np.unique(edges, axis=0, return_counts=True)
    if not body.is_watertight:
        open_edges = int((counts == 1).sum())
        where = body.bounds.mean(axis=0).round(3).tolist()
        what = f"{open_edges} open edges" if open_edges else "edges that more than two triangles share"
        raise InputError(
            f"{path.name} is not watertight ({what}, in the body around {where}): close it where it was drawn, or by "
            "a repair such as Meshlab's or Blender's 3D-print toolbox, and export it again"
        )
    if not body.is_winding_consistent:
        raise InputError(
            f"{path.name} has triangles that face different ways: recalculate its normals outwards, and export it again"
        )
    if body.volume <= 0.0 and any(_encloses(other, body) for other in bodies):
        raise InputError(
            f"{path.name} has a closed cavity, around {body.bounds.mean(axis=0).round(3).tolist()}: fill it where it "
            "was drawn, as nothing touches there, and export it again"
        )
    if body.volume <= 0.0:
        raise InputError(
            f"{path.name} is inside out, its triangles face inwards: flip its normals, and export it again"
        )
