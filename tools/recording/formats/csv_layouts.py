"""CSV files in the layouts that people have: a clock, a position, and an orientation in one of several ways."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.spatial.transform import Rotation

from guiderail.models.errors import InputError, brief
from guiderail.tools.recording.formats.recorded import POSE_NAMES, UNITS, Recorded, poses_in_target

TIME = re.compile(r"(t|time|timestamp|stamp|sec|secs|seconds)", re.IGNORECASE)
_TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
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
        unit: of positions, m, cm or mm, where no column's name says it.
        time_unit: s, ms, us or ns, where neither the name nor the size says it.
        quaternion: "xyzw" or "wxyz", where columns are numbered and not named.
        angles: "deg" or "rad" of roll, pitch and yaw.
        target: see `poses_in_target`.

    Raises:
        InputError: if a file is none, or doesn't say what only whoever recorded it knows.
    """
    files = [path] if path.is_file() else sorted(path.glob("*.csv"))
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
        table = pd.read_csv(file, sep=None, engine="python", skipinitialspace=True).astype(float)
    except (ValueError, OSError, pd.errors.ParserError) as error:
        raise InputError(f"{file} is no table of numbers under a line of names: {brief(str(error))}") from error
    columns = {_plain(name): name for name in table.columns}
    assumed: list[str] = []
    times = _time(file, table, columns, time_unit, assumed)
    position = [_column(columns, axis) for axis in "xyz"]
    if None in position:
        raise InputError(f"{file} has no columns x, y and z: name them so, or use guiderail check on it as it is")
    named = {m.group(1) for name in position if (m := re.search(r"[\[(_](mm|cm|m)[\])]?$", str(name)))}
    scale_name = named.pop() if len(named) == 1 else unit
    if scale_name is None:
        size = float(np.ptp(table[position].to_numpy(), axis=0).max())
        raise InputError(f"{file} does not say the unit of x, y and z, which move by {size:.4g}: give --unit m or mm")
    if scale_name not in UNITS:
        raise InputError(f"--unit is one of {', '.join(UNITS)}, not {scale_name!r}")
    positions = table[position].to_numpy() * UNITS[scale_name]
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
    said = re.search(r"[\[(_](ms|us|ns|s)[\])]?$", names[0])
    ticks = table[names[0]].to_numpy()
    step = float(np.median(np.diff(ticks))) if len(ticks) > 1 else 0.0
    unit = given or (said.group(1) if said else None)
    if unit is None:
        fitting = [name for name, scale in _TIME_UNITS.items() if _PERIODS[0] <= step * scale < _PERIODS[1]]
        if fitting[:1] != ["s"]:
            words = " or ".join(fitting) or "s, ms, us or ns"
            raise InputError(
                f"{file} does not say the unit of {names[0]}, whose step is {step:g}: give --time-unit {words}"
            )
        unit = "s"
        assumed.append(f"{names[0]} is in seconds, {1.0 / step:.4g} samples in each")
    if unit not in _TIME_UNITS:
        raise InputError(f"--time-unit is one of {', '.join(_TIME_UNITS)}, not {unit!r}")
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
            return _from_quaternions(file, table[found].to_numpy())
    for names in _UNNAMED:
        if all(name in columns for name in names):
            if quaternion not in ("xyzw", "wxyz"):
                raise InputError(
                    f"{file} has the quaternion {', '.join(names)} and does not say which is its scalar: give "
                    "--quaternion wxyz or xyzw"
                )
            values = table[[columns[name] for name in names]].to_numpy()
            return _from_quaternions(file, values if quaternion == "xyzw" else values[:, [1, 2, 3, 0]])
    for euler in _EULER:
        found = [_column(columns, name) for name in euler]
        if None not in found:
            said = re.search(r"(deg|rad)", str(found[0]))
            unit = said.group(1) if said else angles
            if unit not in ("deg", "rad"):
                raise InputError(f"{file} does not say whether {found[0]} is in degrees: give --angles deg or rad")
            assumed.append("roll, pitch and yaw are about fixed axes, Rz(yaw) Ry(pitch) Rx(roll)")
            return Rotation.from_euler("xyz", table[found].to_numpy(), degrees=unit == "deg")
    return None


def _from_quaternions(file: Path, values: np.ndarray) -> Rotation:
    lengths = np.linalg.norm(values, axis=1)
    if np.abs(lengths - 1.0).max() > 0.01:
        raise InputError(f"{file} has quaternions of length {lengths.min():.3g} to {lengths.max():.3g}, and not one")
    return Rotation.from_quat(values)
