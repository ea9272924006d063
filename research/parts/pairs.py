"""Pairs of meshes below a folder, found by file name: of IndustReal, of Factory, and files named plug and socket."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from pathlib import Path

from guiderail.models.common.errors import InputError
from guiderail_parts.geometry.mesh_file import ENDINGS

_INDUSTREAL, _FACTORY = "industreal_", "factory_"
_SIZES = (4, 8, 12, 16)
_FACTORY_PAIRS = {
    "round_8mm_loose": ("factory_round_peg_8mm_loose.obj", "factory_round_hole_8mm_subdiv_3x.obj"),
    "round_8mm_tight": ("factory_round_peg_8mm_tight.obj", "factory_round_hole_8mm_subdiv_3x.obj"),
    "rectangular_8mm_loose": (
        "factory_rectangular_peg_8mm_loose_subdiv_3x.obj",
        "factory_rectangular_hole_8mm_subdiv_3x.obj",
    ),
    "rectangular_8mm_tight": (
        "factory_rectangular_peg_8mm_tight_subdiv_3x.obj",
        "factory_rectangular_hole_8mm_subdiv_3x.obj",
    ),
    "gear_medium": ("factory_gear_medium_space_5e-4.obj", "factory_gear_base_loose_space_5e-4_subdiv_4x.obj"),
    "nut_m16": ("factory_nut_m16_loose_subdiv_3x.obj", "factory_bolt_m16_loose.obj"),
}


@dataclass(frozen=True)
class Pair:
    """Plug and socket.

    Attributes:
        name: Name of the pair.
        plug: Mesh file.
        socket: Mesh file.
        unit: Unit of both files.
    """

    name: str
    plug: Path
    socket: Path
    unit: str = "m"


def find_pairs(folder: Path, unit: str = "m") -> list[Pair]:
    """Return the pairs below a folder, sorted by name.

    Args:
        folder: Folder of meshes, such as `assets` of IsaacGymEnvs, or a folder that has a subfolder with `plug.*` and
            `socket.*` for each pair.
        unit: Unit of all files.

    Raises:
        InputError: If there are no pairs, two pairs have the same name (results are stored by name), or a file of
            IndustReal or Factory is in two folders.
    """
    meshes = [path for path in sorted(folder.rglob("*")) if path.suffix.lower() in ENDINGS]
    names = {
        f"{_INDUSTREAL}{shape}_{size}mm": (
            f"industreal_{shape}_peg_{size}mm.obj",
            f"industreal_tray_insert_{shape}_peg_{size}mm.obj",
        )
        for shape in ("round", "rectangular")
        for size in _SIZES
    }
    names |= {
        f"{_INDUSTREAL}gear_{size}": (f"industreal_gear_{size}.obj", "industreal_gear_base.obj")
        for size in ("small", "medium", "large")
    }
    names |= {f"{_FACTORY}{name}": pair for name, pair in _FACTORY_PAIRS.items()}
    known = {name for pair in names.values() for name in pair}
    files: dict[str, Path] = {}
    for path in meshes:
        if path.name in known and files.setdefault(path.name, path) != path:
            raise InputError(f"{path.name} is in two folders ({files[path.name].parent}, {path.parent}): remove one")
    pairs = [
        Pair(name, files[plug], files[socket], unit)
        for name, (plug, socket) in names.items()
        if plug in files and socket in files
    ]
    for plug in sorted(folder.rglob("*plug.*")):
        socket = plug.with_name(plug.name.replace("plug", "socket"))
        if plug.suffix.lower() in ENDINGS and socket.is_file():
            pairs.append(Pair(plug.parent.name, plug, socket, unit))
    if not pairs:
        raise InputError(f"{folder} has no pairs: name a folder that has subfolders with plug.stl and socket.stl")
    pairs = sorted(pairs, key=lambda pair: pair.name)
    for first, second in itertools.pairwise(pairs):
        if first.name == second.name:
            raise InputError(f"two pairs are named {first.name!r} ({first.plug}, {second.plug}): rename a subfolder")
    return pairs
