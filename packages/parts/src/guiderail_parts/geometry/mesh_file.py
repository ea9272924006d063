"""Mesh files of parts: read in meters and checked to be solids, and written with their SDF models."""

import io
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from guiderail.models.common.errors import InputError, brief, import_extra
from guiderail.models.common.files import read_bytes
from guiderail.models.objects.sdf import (
    ContactMaterial,
    TriangleMesh,
    area_vectors,
    at,
    collision,
    convex_mesh,
    mesh,
    model,
    visual,
)
from guiderail_parts.geometry.repair import Repair, close_surface
from guiderail_parts.geometry.solids import to_manifold
from guiderail_parts.isolation import IsolatedError, run_isolated

ENDINGS = (".stl", ".obj", ".ply", ".glb", ".step", ".stp")
UNITS = {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "inch": 0.0254}
"""Length of one unit of a file [m]."""

SMALLEST, LARGEST = 1e-3, 0.5  # bounds of the longest side of a part that an arm inserts [m]
MAX_FILE_SIZE = 200_000_000  # [bytes]
MAX_TRIANGLES = 2_000_000  # largest number of triangles of a file
_CPU_SECONDS, _MAX_MEMORY = 120, 2 * 2**30  # limits of a parser: CPU time [s] and memory [bytes]
NOTHING_REPAIRED = Repair()
_FORMAT_UNITS = {".glb": "m", ".step": "m", ".stp": "m"}  # units of formats that define one


@dataclass(frozen=True, eq=False)
class Part:
    """Solid part of one or several bodies."""

    path: Path  # mesh file
    # Vertices (V, 3) [m] and triangles (T, 3) of each body, counter-clockwise as seen from outside.
    bodies: tuple[tuple[np.ndarray, np.ndarray], ...]
    repair: Repair = NOTHING_REPAIRED  # changes that made the mesh a solid

    @cached_property
    def solids(self) -> list[Any]:
        """Bodies as `manifold3d` solids; a solid is empty if `manifold3d` refuses the faces of its body."""
        return [to_manifold(vertices, triangles) for vertices, triangles in self.bodies]

    @property
    def corners(self) -> np.ndarray:
        """Vertices of all bodies (V, 3) [m]."""
        return np.concatenate([vertices for vertices, _ in self.bodies])

    @property
    def bounds(self) -> np.ndarray:
        """Lowest and highest corner of the bounding box, (2, 3) [m]."""
        return np.stack([self.corners.min(axis=0), self.corners.max(axis=0)])

    def transform(self, rotation: np.ndarray, translation: np.ndarray) -> "Part":
        """Return the part with every point p at R p + t; rotation (3, 3), translation (3,) [m]."""
        return Part(self.path, tuple((v @ rotation.T + translation, t) for v, t in self.bodies), self.repair)


def find_unit(path: Path, unit: str | None) -> str | None:
    """Return the unit that the format of a file defines, or else `unit`."""
    return _FORMAT_UNITS.get(path.suffix.lower()) or unit


def find_units(paths: Sequence[Path], unit: str | None) -> list[str | None]:
    """Return the unit of each file; see `find_unit`.

    Raises:
        InputError: If `unit` is unknown, or contradicts the formats of all files.
    """
    if unit is not None:
        _check_unit(unit)
    units = [find_unit(path, unit) for path in paths]
    if unit is not None and unit not in units:
        names = " and ".join(path.name for path in paths)
        raise InputError(f"{names} are read in meters, as their formats define: remove --unit {unit}")
    return units


def _check_unit(unit: str) -> None:
    if unit not in UNITS:
        raise InputError(f"there is no unit {unit!r}: choose one of {', '.join(UNITS)}")


def load_part(path: Path, unit: str) -> Part:
    """Read a mesh file (STL, OBJ, PLY, GLB or STEP) whose coordinates are in `unit`, one of `UNITS`.

    Raises:
        InputError: If the unit is unknown, the file can't be read or has too many triangles, the part can't be made a
            solid, its size is out of bounds, or software for the format is not installed.
    """
    _check_unit(unit)
    if path.suffix.lower() not in ENDINGS:
        raise InputError(f"{path} has the ending {path.suffix!r}: give a file with {', '.join(ENDINGS[:-1])}")
    import_extra("trimesh")
    if path.suffix.lower() in (".step", ".stp"):
        import_extra("cascadio")
    data = read_bytes(path, "mesh", MAX_FILE_SIZE)
    try:
        vertices, triangles, number = run_isolated(
            _parse, data, path.suffix[1:].lower(), cpu_seconds=_CPU_SECONDS, max_bytes=_MAX_MEMORY
        )
    except IsolatedError as error:
        raise InputError(f"{path} can't be read as a mesh ({brief(str(error))}): export it again") from error
    if number > MAX_TRIANGLES:
        raise InputError(
            f"{path} has {number} triangles, more than {MAX_TRIANGLES}: export it with a coarser tolerance"
        )
    if not len(triangles):
        raise InputError(f"{path} has no triangles: export the part as a mesh")
    if not 0 <= triangles.min() <= triangles.max() < len(vertices):
        raise InputError(f"{path} has triangles with vertices that do not exist: export it again")
    corners = vertices[triangles.ravel()]
    if not np.isfinite(corners).all():
        raise InputError(f"{path} has vertices that are NaN or infinite: export it again")
    with np.errstate(over="ignore"):
        size = float(np.ptp(corners, axis=0).max()) * UNITS[unit]
    if not SMALLEST <= size <= LARGEST:
        fitting = [name for name, scale in UNITS.items() if SMALLEST <= size / UNITS[unit] * scale <= LARGEST]
        remedy = f"is its unit {' or '.join(fitting)}?" if fitting else f"give parts of {SMALLEST} to {LARGEST} m"
        raise InputError(f"{path.name} would be {size:.3g} m long with --unit {unit}: {remedy}")
    mesh = import_extra("trimesh").Trimesh(vertices, triangles, process=False)
    mesh.merge_vertices(merge_norm=True, merge_tex=True)
    if not (mesh.area > 0.0):
        raise InputError(f"{path} has only triangles without an area: export the part as a mesh")
    vertices, triangles = np.asarray(mesh.vertices) * UNITS[unit], np.asarray(mesh.faces)
    bodies, repair = close_surface(path.name, vertices, triangles)
    return Part(path, tuple(bodies), repair)


def _parse(data: bytes, ending: str) -> tuple[np.ndarray, np.ndarray, int]:
    """Return vertices (V, 3), triangles (T, 3) and the larger of T and V / 3; empty arrays if that is too large.

    Without a path and materials, a parser opens no other file and decodes no image.
    """
    import trimesh

    try:
        mesh: Any = trimesh.load(io.BytesIO(data), file_type=ending, force="mesh", process=False, skip_materials=True)
    except ImportError:  # trimesh has no library to detect the encoding of a text
        raise ValueError(f"it is damaged or no {ending.upper()} file") from None
    number = 0 if mesh is None else max(len(mesh.faces), len(mesh.vertices) // 3)
    if not 0 < number <= MAX_TRIANGLES:
        return np.empty((0, 3)), np.empty((0, 3), dtype=int), number
    return np.asarray(mesh.vertices, dtype=float), np.asarray(mesh.faces), number


class Surface(Protocol):
    """Mesh with the contact parameters of one surface.

    `modulus` is the hydroelastic modulus [Pa], None for a rigid surface; `dissipation` is the Hunt-Crossley dissipation
    [s/m].
    """

    file: str
    modulus: float | None
    friction: float
    dissipation: float


def obj_text(vertices: np.ndarray, triangles: np.ndarray) -> str:
    """Return the text of an OBJ file of vertices (V, 3) [m] and triangles (T, 3).

    Triangles of negligible area are left out, because their normals are rounding errors.
    """
    has_area = np.linalg.norm(area_vectors(vertices, triangles), axis=1) > 1e-10
    return TriangleMesh(vertices, triangles[has_area]).to_obj()


def part_sdf(
    name: str,
    visual_file: str,
    surfaces: Sequence[Surface],
    *,
    mass: float,
    center: Sequence[float],
    gyration: float,
    color: str,
) -> str:
    """Return an SDF model of one link `name` with collision geometry `piece_0`, ….

    Args:
        name: Name of the model and its link.
        visual_file: OBJ file of the visual geometry.
        surfaces: Collision geometry; a compliant OBJ mesh is convex, a compliant VTK mesh has tetrahedra, and a rigid
            mesh may have any shape.
        mass: Mass [kg].
        center: Center of mass (3,) [m].
        gyration: Radius of gyration [m].
        color: Color as "r g b a".
    """
    contents = visual("visual", at(), mesh(visual_file), color)
    for number, surface in enumerate(surfaces):
        is_convex = surface.modulus is not None and surface.file.endswith(".obj")
        geometry = convex_mesh(surface.file) if is_convex else mesh(surface.file)
        material = ContactMaterial(surface.friction, surface.modulus, dissipation=surface.dissipation)
        contents += collision(f"piece_{number}", at(), geometry, material)
    return model(name, mass, center, gyration, contents, source="guiderail from task.yaml")
