"""CSV files in the layouts that people have: a clock, a position, and an orientation in one of several ways."""

from __future__ import annotations

import csv
import io
import re
import unicodedata
from array import array
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from guiderail.models.common.errors import InputError, brief
from guiderail.models.primitives.io import SECONDS
from guiderail.tools.datasets.formats.recorded import POSE_NAMES, UNITS, Recorded, poses_in_target, rotations_of
from guiderail.tools.datasets.paths import in_order

TIME = re.compile(r"(t|time|timestamp|stamp|sec|secs|seconds)", re.IGNORECASE)
_TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_ANGLE_UNITS = {"deg": np.pi / 180.0, "rad": 1.0}
_ORDERS = ("wxyz", "xyzw")
_ALSO = {
    "m": ("meter", "meters", "metre", "metres"),
    "deg": ("degree", "degrees", "\u00b0"),
    "rad": ("radian", "radians"),
    "s": SECONDS,
    "ms": ("msec",),
    "us": ("usec", "\u03bcs"),
    "ns": ("nsec",),
}  # other names of units
_SAME_UNIT = {other: unit for unit, others in _ALSO.items() for other in others}
_PERIODS = (1e-4, 1.0)  # [s] between samples of a robot; anything else is another unit
_PREFIX = r"(?:.*[._/ ])?(?:p|pos|position|tool|tcp|ee|actual_tcp_pose|translation)?[._ ]?"
_NO_POSE = re.compile(
    r"(?:.*[._/ ])?(v|vel|velocity|speed|twist|omega|gyro|acc|accel|acceleration|f|force|torque|wrench)[._/ ].*"
)  # words before an axis that make it one of something else
_QUATERNION = (("qx", "qy", "qz", "qw"), ("quat_x", "quat_y", "quat_z", "quat_w"), ("ox", "oy", "oz", "ow"))
_EULER = (("roll", "pitch", "yaw"), ("rx_rpy", "ry_rpy", "rz_rpy"))
_UNNAMED = (("q0", "q1", "q2", "q3"), ("q1", "q2", "q3", "q4"))
_DELIMITERS = ",\t;| "
_NOTHING = ("", "na", "n/a", "#n/a", "null", "none")
_MOST_LISTED = 8


@dataclass(frozen=True)
class _Column:
    """One of a table.

    Attributes:
        name: as the file says it.
        values: (N,).
    """

    name: str
    values: np.ndarray

    @property
    def plain(self) -> str:
        """The name without what is in brackets."""
        return re.sub(r"[\[(].*", "", self.name).strip().lower()


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
    for option, given, known in (
        ("--unit", unit, UNITS),
        ("--time-unit", time_unit, _TIME_UNITS),
        ("--quaternion", quaternion, _ORDERS),
        ("--angles", angles, _ANGLE_UNITS),
    ):
        if given is not None and given not in known:
            raise InputError(f"{option} is one of {', '.join(known)}, not {given!r}")
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
    columns = _table(file)
    if len(columns[0].values) < 2:
        raise InputError(f"{file} has fewer than two lines of numbers: a motion needs at least two")
    assumed: list[str] = []
    clock, times = _time(file, columns, time_unit, assumed)
    position = [one for axis in "xyz" if (one := _column(file, columns, axis)) is not None]
    if len(position) < 3:
        raise InputError(
            f"{file} has no columns x, y and z: name them so; where they are others, guiderail check reads "
            "it as it is, with time in seconds"
        )
    positions = np.column_stack([one.values for one in position])
    units = _units(file, position, UNITS, unit, "--unit")
    if None in units:
        unsaid = [o for o, one in enumerate(units) if one is None]
        size = float(np.ptp(positions[:, unsaid], axis=0).max())
        which = _listed(["xyz"[o] for o in unsaid])
        raise InputError(f"{file} does not say the unit of {which}, moving by {size:.4g}: give --unit m or mm")
    positions = positions * [UNITS[str(one)] for one in units]
    orientation, rotations = _rotations(file, columns, quaternion, angles, assumed)
    if rotations is None:
        if target is not None:
            raise InputError(f"{file} has no quaternion nor roll, pitch and yaw, and --target needs an orientation")
        assumed.append("there is no orientation")
    elif target is None:
        assumed.append("poses stay in the frame of the recording: --target says where the task's target is in it")
    used = (clock, *position, *orientation)
    if left := [one.name for one in columns if one.name and not any(one is other for other in used)]:
        assumed.append(f"{_listed(left)} {'is' if len(left) == 1 else 'are'} left out")
    if rotations is None:
        return Recorded([times], [positions], POSE_NAMES[:3], assumed)
    return Recorded([times], [poses_in_target(positions, rotations, target, like)], POSE_NAMES, assumed)


def _table(file: Path) -> list[_Column]:
    """Every column, what is empty in it as NaN.

    Raises:
        InputError: if it's no table of numbers, or a line has more or fewer fields than the header has.
    """
    try:
        text = file.read_text(encoding="utf-8-sig")  # Excel begins a file with a mark, which is no part of a name
        first = next((line for line in io.StringIO(text) if line.strip()), "")
        delimiter = next((one for one in _DELIMITERS if one in first), ",")
        lines = csv.reader(io.StringIO(text), delimiter=delimiter, skipinitialspace=True, strict=True)
        rows = ((lines.line_num, row) for row in lines if len(row) > 1 or "".join(row).strip())
        _, names = next(rows, (0, []))
        values = array("d")
        for number, row in rows:
            if len(row) != len(names):
                raise InputError(f"{file}: line {number} has {len(row)} fields, the header has {len(names)}")
            values.extend([np.nan if one.strip().lower() in _NOTHING else float(one) for one in row])
    except InputError:
        raise
    except (ValueError, OSError, csv.Error) as error:
        raise InputError(f"{file} is no table of numbers under a line of names: {brief(str(error))}") from error
    if not names:
        raise InputError(f"{file} is no table of numbers under a line of names: it is empty")
    table = np.frombuffer(values, dtype=float).reshape(-1, len(names))
    return [_Column(name.strip(), column) for name, column in zip(names, table.T, strict=True)]


def _units(
    file: Path, columns: Sequence[_Column], known: Collection[str], given: str | None, option: str
) -> list[str | None]:
    """The unit of each column: what its own name says, else what was given.

    Raises:
        InputError: if a column says another one than was given, or one that is not known.
    """
    units = []
    for column in columns:
        one = _said(file, column.name, known) or given
        if given not in (None, one):
            raise InputError(
                f"{file} has {column.name}, and {option} says {given}: leave it out, and name each column's unit"
            )
        units.append(one)
    return units


def _said(file: Path, name: str, known: Collection[str]) -> str | None:
    """The unit that a column's name says, in brackets or at its end; None if it has neither.

    Raises:
        InputError: if it has brackets, and nothing known in them.
    """
    plain = unicodedata.normalize("NFKC", name).lower()  # a micro sign and a Greek letter become the same
    if inside := [words.strip() for words in re.findall(r"[\[(]([^\[\]()]*)", plain)]:
        said = [one for words in inside if (one := _SAME_UNIT.get(words, words)) in known]
        if not said:
            raise InputError(f"{file} has {name}, whose unit is none of {', '.join(known)}: convert it, or name it so")
        return said[-1]
    at_end = re.search(rf"_({'|'.join(known)})$", plain)
    return at_end and at_end.group(1)


def _listed(names: Sequence[str]) -> str:
    if len(names) > _MOST_LISTED:
        names = [*names[:_MOST_LISTED], f"{len(names) - _MOST_LISTED} more"]
    *most, last = names
    return f"{', '.join(most)} and {last}" if most else last


def _column(file: Path, columns: Sequence[_Column], wanted: str) -> _Column | None:
    """The column of that name, or the only one that ends in it and is of nothing else, with a unit behind or not.

    Raises:
        InputError: if several could be meant.
    """
    named = rf"{wanted}(_mm|_cm|_m|_rad|_deg)?"
    exact = [one for one in columns if re.fullmatch(named, one.plain)]
    ends = [one for one in columns if re.fullmatch(_PREFIX + named, one.plain)]
    return _only(file, exact or [one for one in ends if not _NO_POSE.fullmatch(one.plain)], wanted)


def _only(file: Path, found: Sequence[_Column], wanted: str) -> _Column | None:
    """The one that was found, if one was.

    Raises:
        InputError: if several were.
    """
    if len(found) > 1:
        names = _listed([one.name for one in found])
        raise InputError(f"{file} has {names}, and does not say which of them is {wanted}: keep that one alone")
    return found[0] if found else None


def _time(file: Path, columns: Sequence[_Column], given: str | None, assumed: list[str]) -> tuple[_Column, np.ndarray]:
    """The column of time, and what it holds in seconds (N,) from its first sample."""
    found = [one for one in columns if TIME.fullmatch(re.sub(r"_(s|ms|us|ns)$", "", one.plain))]
    clock = _only(file, found, "time")
    if clock is None:
        raise InputError(f"{file} has no column t, time or timestamp: add one")
    (unit,) = _units(file, [clock], _TIME_UNITS, given, "--time-unit")
    ticks = clock.values
    steps = np.diff(ticks)
    if (steps < 0.0).any():
        at = int(np.argmax(steps < 0.0)) + 1
        raise InputError(f"{file}: time, which is {clock.name}, goes back at sample {at}: sort or drop samples")
    if not (steps > 0.0).any():
        raise InputError(f"{file}: time, which is {clock.name}, stands still: a motion needs a clock that goes on")
    if unit is None:
        step = float(np.median(steps[steps > 0.0]))  # a recorder that is faster than its robot logs a sample twice
        fitting = [name for name, scale in _TIME_UNITS.items() if _PERIODS[0] <= step * scale < _PERIODS[1]]
        if fitting[:1] != ["s"]:
            words = " or ".join(fitting) or "s, ms, us or ns"
            raise InputError(
                f"{file} does not say the unit of {clock.name}, whose step is {step:g}: give --time-unit {words}"
            )
        unit = "s"
        assumed.append(f"{clock.name} is in seconds, {1.0 / step:.4g} samples in each")
    return clock, (ticks - ticks[0]) * _TIME_UNITS[unit]


def _rotations(
    file: Path,
    columns: Sequence[_Column],
    quaternion: str | None,
    angles: str | None,
    assumed: list[str],
) -> tuple[list[_Column], Rotation | None]:
    """The columns that say an orientation, and its rotations (N,); none of either where nothing does."""
    for names in _QUATERNION:
        found = [one for name in names if (one := _column(file, columns, name)) is not None]
        if len(found) == len(names):
            return found, rotations_of(np.column_stack([one.values for one in found]), str(file))
    for names in _UNNAMED:
        same = [_only(file, [one for one in columns if one.plain == name], name) for name in names]
        found = [one for one in same if one is not None]
        if len(found) == len(names):
            if quaternion is None:
                raise InputError(
                    f"{file} has the quaternion {', '.join(names)} and does not say which is its scalar: give "
                    "--quaternion wxyz or xyzw"
                )
            values = np.column_stack([one.values for one in found])
            return found, rotations_of(values if quaternion == "xyzw" else values[:, [1, 2, 3, 0]], str(file))
    for euler in _EULER:
        found = [one for name in euler if (one := _column(file, columns, name)) is not None]
        if len(found) == len(euler):
            units = _units(file, found, _ANGLE_UNITS, angles, "--angles")
            for column, one_unit in zip(found, units, strict=True):
                if one_unit is None:
                    raise InputError(
                        f"{file} does not say whether {column.name} is in degrees: give --angles deg or rad"
                    )
            assumed.append("roll, pitch and yaw are about fixed axes, Rz(yaw) Ry(pitch) Rx(roll)")
            scales = [_ANGLE_UNITS[str(one_unit)] for one_unit in units]
            turns = np.column_stack([column.values for column in found]) * scales
            return found, Rotation.from_euler("xyz", turns)
    return [], None
