"""CSV files in the layouts that people have: a clock, a position, and an orientation in one of several ways."""

from __future__ import annotations

import csv
import re
from collections.abc import Collection, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.spatial.transform import Rotation

from guiderail.models.errors import InputError, brief
from guiderail.tools.recording.formats.recorded import POSE_NAMES, UNITS, Recorded, poses_in_target, rotations_of
from guiderail.tools.recording.places import in_order

TIME = re.compile(r"(t|time|timestamp|stamp|sec|secs|seconds)", re.IGNORECASE)
_TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_ANGLE_UNITS = {"deg": np.pi / 180.0, "rad": 1.0}
_PERIODS = (1e-4, 1.0)  # [s] between samples of a robot; anything else is another unit
_PREFIX = r"(?:.*[._/ ])?(?:p|pos|position|tool|tcp|ee|actual_tcp_pose|translation)?[._ ]?"
_QUATERNION = (("qx", "qy", "qz", "qw"), ("quat_x", "quat_y", "quat_z", "quat_w"), ("ox", "oy", "oz", "ow"))
_EULER = (("roll", "pitch", "yaw"), ("rx_rpy", "ry_rpy", "rz_rpy"))
_UNNAMED = (("q0", "q1", "q2", "q3"), ("q1", "q2", "q3", "q4"))


def read_csv_files(
    path: Path,
    *,
    unit: str | None = None,
    time_unit: str | None = None,
    quaternion: str | None = None,
    angles: str | None = None,
    target: Sequence[float] | None = None,
) -> Recorded:
    """One demonstration a file.

    Args:
        path: a file, or a folder of them.
        unit: of positions, m, cm or mm, where a column's name doesn't say it; each name is that column's own.
        time_unit: s, ms, us or ns, where neither the name nor the size says it.
        quaternion: "xyzw" or "wxyz", where columns are numbered and not named.
        angles: "deg" or "rad" of roll, pitch and yaw, where a column's name doesn't say it.
        target: see `poses_in_target`.

    Raises:
        InputError: if a file is none, doesn't say what only whoever recorded it knows, or says something else.
    """
    files = [path] if path.is_file() else in_order(path.glob("*.csv"))
    if not files:
        raise InputError(f"there is no .csv file in {path}: name a file, or a folder of them")
    found = Recorded([], [], ())
    for file in files:
        like = found.outputs[0] if found.outputs else None
        one = _read(file, unit, time_unit, quaternion, angles, target, like)
        if found.names and one.names != found.names:
            raise InputError(f"{file} has other columns than {files[0].name}: record the same ones in all of them")
        found.times += one.times
        found.outputs += one.outputs
        found.names = one.names
        found.assumed += [words for words in one.assumed if words not in found.assumed]
    return found


def _read(
    file: Path,
    unit: str | None,
    time_unit: str | None,
    quaternion: str | None,
    angles: str | None,
    target: Sequence[float] | None,
    like: np.ndarray | None,
) -> Recorded:
    try:
        # Excel begins a file with a mark, which plain utf-8 would read as part of the first name.
        table = pd.read_csv(file, sep=None, engine="python", skipinitialspace=True, encoding="utf-8-sig").astype(float)
    except (ValueError, OSError, csv.Error, pd.errors.ParserError) as error:
        raise InputError(f"{file} is no table of numbers under a line of names: {brief(str(error))}") from error
    if len(table) < 2:
        raise InputError(f"{file} has fewer than two lines of numbers: a motion needs at least two")
    columns = {_plain(name): name for name in table.columns}
    assumed: list[str] = []
    times = _time(file, table, columns, time_unit, assumed)
    position = [_column(columns, axis) for axis in "xyz"]
    if None in position:
        raise InputError(f"{file} has no columns x, y and z: name them so, or use guiderail check on it as it is")
    positions = table[position].to_numpy()
    units = _units(file, position, UNITS, unit, "--unit")
    if None in units:
        unsaid = [o for o, one in enumerate(units) if one is None]
        size = float(np.ptp(positions[:, unsaid], axis=0).max())
        which = _listed(["xyz"[o] for o in unsaid])
        raise InputError(f"{file} does not say the unit of {which}, moving by {size:.4g}: give --unit m or mm")
    positions = positions * [UNITS[str(one)] for one in units]
    rotations = _rotations(file, table, columns, quaternion, angles, assumed)
    if rotations is None:
        if target is not None:
            raise InputError(f"{file} has no orientation, and --target needs one")
        return Recorded([times], [positions], POSE_NAMES[:3], [*assumed, "there is no orientation"])
    if target is None:
        assumed.append("poses stay in the frame of the recording: --target says where the task's target is in it")
    return Recorded([times], [poses_in_target(positions, rotations, target, like)], POSE_NAMES, assumed)


def _plain(name: str) -> str:
    return re.sub(r"[\[(].*", "", str(name)).strip().lower()


def _units(
    file: Path, names: Sequence[object], known: Collection[str], given: str | None, option: str
) -> list[str | None]:
    """The unit of each column: what its own name says, else what was given.

    Raises:
        InputError: if no such unit was given, or a column says another one.
    """
    if given is not None and given not in known:
        raise InputError(f"{option} is one of {', '.join(known)}, not {given!r}")
    said = [re.search(rf"[\[(_]({'|'.join(known)})(?:rees|ians)?[\])]?$", str(name).strip()) for name in names]
    units = [given if found is None else found.group(1) for found in said]
    for name, one in zip(names, units, strict=True):
        if given not in (None, one):
            raise InputError(f"{file} has {name}, and {option} says {given}: leave it out, and name each column's unit")
    return units


def _listed(names: Sequence[str]) -> str:
    *most, last = names
    return f"{', '.join(most)} and {last}" if most else last


def _column(columns: dict[str, str], wanted: str) -> str | None:
    """The column of that name, or the only one that ends in it, with a unit behind or not."""
    ends = [full for name, full in columns.items() if re.fullmatch(rf"{_PREFIX}{wanted}(_mm|_cm|_m|_rad|_deg)?", name)]
    return columns.get(wanted) or (ends[0] if len(ends) == 1 else None)


def _time(
    file: Path, table: pd.DataFrame, columns: dict[str, str], given: str | None, assumed: list[str]
) -> np.ndarray:
    names = [full for name, full in columns.items() if TIME.fullmatch(re.sub(r"_(s|ms|us|ns)$", "", name))]
    if not names:
        raise InputError(f"{file} has no column t, time or timestamp: add one")
    (unit,) = _units(file, names[:1], _TIME_UNITS, given, "--time-unit")
    ticks = table[names[0]].to_numpy()
    step = float(np.median(np.diff(ticks)))
    if unit is None:
        fitting = [name for name, scale in _TIME_UNITS.items() if _PERIODS[0] <= step * scale < _PERIODS[1]]
        if fitting[:1] != ["s"]:
            words = " or ".join(fitting) or "s, ms, us or ns"
            raise InputError(
                f"{file} does not say the unit of {names[0]}, whose step is {step:g}: give --time-unit {words}"
            )
        unit = "s"
        assumed.append(f"{names[0]} is in seconds, {1.0 / step:.4g} samples in each")
    return (ticks - ticks[0]) * _TIME_UNITS[unit]


def _rotations(
    file: Path,
    table: pd.DataFrame,
    columns: dict[str, str],
    quaternion: str | None,
    angles: str | None,
    assumed: list[str],
) -> Rotation | None:
    for names in _QUATERNION:
        found = [_column(columns, name) for name in names]
        if None not in found:
            return rotations_of(table[found].to_numpy(), str(file))
    for names in _UNNAMED:
        if all(name in columns for name in names):
            if quaternion not in ("xyzw", "wxyz"):
                raise InputError(
                    f"{file} has the quaternion {', '.join(names)} and does not say which is its scalar: give "
                    "--quaternion wxyz or xyzw"
                )
            values = table[[columns[name] for name in names]].to_numpy()
            return rotations_of(values if quaternion == "xyzw" else values[:, [1, 2, 3, 0]], str(file))
    for euler in _EULER:
        found = [_column(columns, name) for name in euler]
        if None not in found:
            units = _units(file, found, _ANGLE_UNITS, angles, "--angles")
            for name, one in zip(found, units, strict=True):
                if one is None:
                    raise InputError(f"{file} does not say whether {name} is in degrees: give --angles deg or rad")
            assumed.append("roll, pitch and yaw are about fixed axes, Rz(yaw) Ry(pitch) Rx(roll)")
            return Rotation.from_euler("xyz", table[found].to_numpy() * [_ANGLE_UNITS[str(one)] for one in units])
    return None
