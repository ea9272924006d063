"""Pairs of meshes: rows of a table, or files below a folder, which are found by name.

In a folder, pairs are those of IndustReal, those of Factory, and files named plug and socket.
"""

from __future__ import annotations

import csv
import io
import itertools
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from inspect import signature
from pathlib import Path
from typing import Any

from guiderail.models.common.errors import InputError, brief
from guiderail.models.common.files import read_bytes
from guiderail.models.common.registry import did_you_mean
from guiderail.tools.tables import MAX_FILE_SIZE
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
        unit: Unit of both files; None if their formats state it.
        options: Further arguments of `create_task` by name.
    """

    name: str
    plug: Path
    socket: Path
    unit: str | None = "m"
    options: Mapping[str, Any] = field(default_factory=dict)


def find_pairs(folder: Path, unit: str | None = "m") -> list[Pair]:
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


def read_pairs(table: Path, unit: str | None = None) -> list[Pair]:
    """Return the pairs of a CSV table with the columns `name`, `plug` and `socket`, one a row.

    Paths are relative to the table. Further columns are options of `create_task` that are numbers or words, such as
    `unit`, `axis` or `shrink` [m]; an empty cell leaves its option out.

    Args:
        table: File of the table.
        unit: Unit of the files without the column `unit`.

    Raises:
        InputError: If the table cannot be read, a column is missing or unknown, or two pairs have the same name.
    """
    from guiderail.tools.environments import as_value
    from guiderail_parts.create_task import create_task

    data = read_bytes(table, "table of pairs", MAX_FILE_SIZE)
    try:
        reader = csv.DictReader(io.StringIO(data.decode(), newline=""), strict=True)
        rows, header = list(reader), list(reader.fieldnames or ())
    except (ValueError, csv.Error) as error:
        raise InputError(f"{table} is no CSV table: give a header and a row for each pair") from error
    parameters = signature(create_task).parameters.keys() - {"out", "log", "only_insert", "scenario"}
    for name in ("name", "plug", "socket"):
        if name not in header:
            raise InputError(f"{table} has no column {name}: give name, plug and socket of each pair")
    if unknown := sorted({*header} - {"name", *parameters}):
        raise InputError(f"{table} has the column {unknown[0]!r}: {did_you_mean(unknown[0], parameters)}")
    pairs: list[Pair] = []
    for row in rows:
        if None in row or None in row.values():
            raise InputError(f"{table} has a row that is not as long as the header: {brief([*row.values()])}")
        values = {key: value for key, value in row.items() if value}
        if not {"name", "plug", "socket"} <= values.keys():
            raise InputError(f"{table} has a row without name, plug or socket: {brief(values)}")
        name, plug, socket = (values.pop(key) for key in ("name", "plug", "socket"))
        if not re.fullmatch(r"\w[\w.-]*", name):
            raise InputError(f"{table}: a name has letters, digits, '_', '.' and '-', unlike {name!r}")
        if any(pair.name == name for pair in pairs):
            raise InputError(f"{table} has two pairs named {name!r}: rename one")
        options = {key: as_value(value) for key, value in values.items() if key != "unit"}
        folder = table.parent
        pairs.append(Pair(name, folder / plug, folder / socket, values.get("unit", unit), options))
    return pairs
