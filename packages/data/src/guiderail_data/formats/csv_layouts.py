"""CSV files with time, position, and an orientation in one of several conventions.

Columns are found by their names. The table is read with the strict reader of the standard library:
`pandas.read_csv` fills short rows and accepts text after a closing quote.
"""

from __future__ import annotations

import csv
import io
import re
import unicodedata
from array import array
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from guiderail.models.common.arrays import parse_number
from guiderail.models.common.errors import InputError, brief
from guiderail.models.common.files import read_bytes
from guiderail.models.common.transforms import POSE_NAMES
from guiderail.models.primitives import Demonstrations
from guiderail.models.primitives.io import MAX_FILE_SIZE, SECONDS, find_repeated
from guiderail_data.formats.recorded import (
    UNITS,
    Frames,
    Recorded,
    describe_frames,
    plain_frame,
    poses_in_target,
    rotations_of,
)
from guiderail_data.reading import visible_files

TIME = re.compile(r"(?:%|__)?(t|time|timestamp|stamp|sec|secs|seconds)", re.IGNORECASE)  # names of a time column
_STAMP = r"(?:.*[._/ ])?"  # prefix of the seconds and nanoseconds of a ROS message's stamp
_TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_ANGLE_UNITS = {"deg": np.pi / 180.0, "rad": 1.0}
_ORDERS = ("wxyz", "xyzw")
# Other spellings of units.
_SPELLINGS = {
    "m": ("meter", "meters", "metre", "metres"),
    "deg": ("degree", "degrees", "\u00b0"),
    "rad": ("radian", "radians"),
    "s": SECONDS,
    "ms": ("msec",),
    "us": ("usec", "\u03bcs"),
    "ns": ("nsec",),
}
_UNIT_OF_SPELLING = {spelling: unit for unit, spellings in _SPELLINGS.items() for spelling in spellings}
_PERIODS = (1e-4, 1.0)  # range of plausible sampling periods [s]; a time step outside it must have another unit
# Prefix of the name of a pose column.
_PREFIX = r"(?:.*[._/ ])?(?:p|t|pos|position|tool|tcp|ee|actual_tcp_pose|translation)?[._/ ]?"
# Names of columns of other quantities than a pose, such as velocity and force.
_NO_POSE = re.compile(
    r"(?:.*[._/ ])?(v|vel|velocity|speed|twist|omega|gyro|acc|accel|acceleration|f|force|torque|wrench|delta|error"
    r"|increment|relative|covariance)[._/ ].*"
)
_NO_POSITION = re.compile(r"(?:.*[._/ ])?(orientation|orient|rotation|rot|rotvec|quaternion|quat|q|euler|rpy)[._/ ].*")
# Patterns of the names of a quaternion's columns; the letters state their order.
_QUATERNION = tuple(
    tuple(rf"{word}{axis}" for axis in "xyzw")
    for word in (r"(?:q|quat|quaternion)[._/ ]?", "o", r"(?:orientation|orient|rotation|rot)[._/ ]?")
)
# Names of columns that describe an orientation, alone or with others.
_ORIENTATION = re.compile(
    r"(?:.*[._/ ])?(?:orientation|orient|rotation|rot|rotvec|quaternion|quat|euler|rpy|ypr|roll|pitch|yaw|heading"
    r"|rotation_vector|rv|axis_angle|angles?|phi|theta|psi|attitude"
    r"|o_t_ee|q[._/ ]?[xyzw]|r_?[xyz]|o[xyzw]|r[0-3][0-3])[._/ ]?(?:[xyzw]|[0-9]+)?(?:_rpy)?(?:_deg|_rad)?"
)
# Names of columns that describe another quantity than an orientation.
_OTHER = re.compile(
    r".*(?:force|torque|wrench|moment|twist|vel|speed|acc|jerk|gripper|finger|width|aperture|joint|effort|current|volt"
    r"|power|temp|press|stamp|time|sec|index|seq|frame|count|step|label|name|status|mode|phase|reward|action|done|episode"
    r"|demo|cov|error|dist|button|trigger|contact|load|mass|robot|tool|valid|success).*"
    r"|[ftmv][._/ ]?[xyz].*|[a-z]+[0-9]{2,}|q[0-9].*",
    re.IGNORECASE,
)
_ORIENTATION_SIZES = (3, 4, 9)  # numbers of columns of an orientation
_ROTATION_VECTOR = ("r_?x", "r_?y", "r_?z")
_KUKA = ("A", "B", "C")  # angles of a KUKA about z, y and x [degrees]
_TCP_POSE = re.compile(r"(actual|target)_TCP_pose_[0-5]")  # columns of a Universal Robots recording (RTDE)
_ROS_FIELD = re.compile(r"(?P<message>.*?)(?:position|translation)[._/][xyz]")  # position in a ROS message
_ROS_ROTATION = re.compile(r"(?P<message>.*?)(?:orientation|rotation)[._/][xyzw]")
_FRAME = re.compile(r"(?:.*[._/ ])?(?P<child>child_)?frame_id", re.IGNORECASE)
_EULER = (("roll", "pitch", "yaw"), ("rx_rpy", "ry_rpy", "rz_rpy"))
# Numbered columns of a quaternion, whose names do not state the order. Five or more such columns are joint positions.
_UNNAMED = (("q0", "q1", "q2", "q3"), ("q1", "q2", "q3", "q4"))
_DELIMITERS = ",\t;| "  # accepted delimiters; the first one in the header is used, in this order
_EMPTY = ("", "na", "n/a", "#n/a", "null", "none")  # texts of an empty field, in lower case
_MAX_LISTED = 8  # largest number of names in a message


@dataclass(frozen=True)
class _Column:
    """Column of a table."""

    name: str  # name in the file
    values: np.ndarray  # values (N,)
    frame: str = ""  # text in all fields of a column of frame names, whose values are NaN

    @property
    def plain(self) -> str:
        """Name in lower case, without the first bracket and all that follows it."""
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
    """Return one demonstration per file, or all demonstrations of files that guiderail has written.

    Args:
        path: File, or a folder of files.
        unit: Unit of positions, m, cm or mm, for columns without a unit in their name.
        time_unit: Unit of time, s, ms, us or ns, if neither the column's name nor its step size determines it.
        quaternion: Order of numbered quaternion columns, "xyzw" or "wxyz".
        angles: Unit of roll, pitch and yaw, "deg" or "rad", for columns without a unit in their name.
        target: See `poses_in_target`.

    Raises:
        InputError: If a file is invalid, a unit is neither stated nor given, the stated and the given unit differ, or
            recordings are mixed with a file that guiderail has written, which may hold the same motions.
    """
    for option, given, known in (
        ("--unit", unit, UNITS),
        ("--time-unit", time_unit, _TIME_UNITS),
        ("--quaternion", quaternion, _ORDERS),
        ("--angles", angles, _ANGLE_UNITS),
    ):
        if given is not None and given not in known:
            raise InputError(f"{option} is one of {', '.join(known)}, not {given!r}")
    files = [path] if path.is_file() else visible_files(path, (".csv",))
    if not files:
        raise InputError(f"there is no .csv file in {path}: name a file, or a folder of them")
    recorded = Recorded([], [], ())
    first_of_kind: dict[bool, Path] = {}  # first file that guiderail wrote (True), and first file of another origin
    for file in files:
        like = recorded.outputs[0] if recorded.outputs else None
        columns = _table(file)
        is_written = [column.name for column in columns[:2]] == ["demonstration", "time"]
        first_of_kind.setdefault(is_written, file)
        columns = columns if is_written else _named(file, columns)
        if len(first_of_kind) > 1:
            raise InputError(
                f"{first_of_kind[True]} holds demonstrations, next to recordings such as {first_of_kind[False].name}, "
                "and may hold the same motions: name one file, or move it to another folder"
            )
        if is_written:
            options = {"unit": unit, "time-unit": time_unit, "quaternion": quaternion, "angles": angles}
            part = _read_written(file, [name for name, value in options.items() if value is not None], target, like)
        else:
            part = _read(file, columns, unit, time_unit, quaternion, angles, target, like)
        if recorded.names and part.names != recorded.names:
            raise InputError(f"{file} has other columns than {files[0].name}: record the same ones in all of them")
        if recorded.names and part.frames != recorded.frames:
            raise InputError(
                f"{file} has poses of {describe_frames(*part.frames)}, and {files[0].name} of "
                f"{describe_frames(*recorded.frames)}: record the same frames in all files"
            )
        recorded.frames = part.frames
        recorded.times += part.times
        recorded.outputs += part.outputs
        recorded.names = part.names
        recorded.assumptions += [text for text in part.assumptions if text not in recorded.assumptions]
    return recorded


def _read_written(
    file: Path, given: Sequence[str], target: Sequence[float] | None, like: np.ndarray | None
) -> Recorded:
    """Read a file that `Demonstrations.save` wrote; `given` has the names of the user's options, which are refused."""
    if given:
        raise InputError(f"{file} holds demonstrations, whose conventions are known: leave --{given[0]} out")
    demonstrations = Demonstrations.load(file)
    outputs, names = list(demonstrations.outputs), demonstrations.names
    if target is not None:
        if names != POSE_NAMES:
            raise InputError(f"{file} has the outputs {_listed(names)}, and --target needs {_listed(POSE_NAMES)}")
        for m, y in enumerate(outputs):
            outputs[m] = poses_in_target(y[:, :3], Rotation.from_euler("ZYX", y[:, 3:]), target, like)
            like = outputs[0] if like is None else like
    return Recorded(list(demonstrations.times), outputs, names)


def _read(
    file: Path,
    columns: Sequence[_Column],
    unit: str | None,
    time_unit: str | None,
    quaternion: str | None,
    angles: str | None,
    target: Sequence[float] | None,
    like: np.ndarray | None,
) -> Recorded:
    if len(columns[0].values) < 2:
        raise InputError(f"{file} has fewer than two lines of numbers: a motion needs at least two")
    assumptions: list[str] = []
    clock, times = _time(file, columns, time_unit, assumptions)
    position = _columns(file, columns, "xyz")
    if position:  # a recorder of several signals leaves the fields of the others empty
        is_empty = np.all([np.isnan(column.values) for column in position], axis=0)
        if is_empty.any() and not is_empty.all():
            columns = [replace(column, values=column.values[~is_empty]) for column in columns]
            clock, times = _time(file, columns, time_unit, [])
            position = _columns(file, columns, "xyz")
            assumptions.append(f"{np.count_nonzero(is_empty)} lines without a position are left out")
    if not position:
        raise InputError(
            f"{file} has no columns x, y and z: name them so; a table of outputs other than a pose needs "
            "no import: guiderail reads it as it is, if its time is in seconds"
        )
    positions = np.column_stack([column.values for column in position])
    units = _units(file, position, UNITS, unit, "--unit")
    unstated: list[tuple[str, str]] = []  # what the file does not state, and the option that states it
    orientation, rotations = _rotations(file, columns, quaternion, angles, assumptions, unstated)
    stated = _stated_meters(file, position, orientation)
    if None in units and stated:
        units = [known or "m" for known in units]
        assumptions.append(stated)
    if None in units:
        missing = [o for o, known in enumerate(units) if known is None]
        size = float(np.ptp(positions[:, missing], axis=0).max())
        which = _listed(["xyz"[o] for o in missing])
        unstated.insert(0, (f"the unit of {which}, moving by {size:.4g}", "--unit m or mm"))
    if unstated:
        described, options = zip(*unstated, strict=True)
        raise InputError(f"{file} does not state {', nor '.join(described)}: give {', and '.join(options)}")
    positions = positions * [UNITS[str(known)] for known in units]
    frames = _frames_of(columns)
    if rotations is None:
        _refuse_orientation(file, columns, (*clock, *position))
        if target is not None:
            raise InputError(f"{file} has no quaternion nor roll, pitch and yaw, and --target needs an orientation")
        assumptions.append("there is no orientation")
    elif target is not None and frames[0]:
        assumptions.append(f"--target is a pose in the frame {frames[0]!r}")
    elif target is None:
        frame = f"the frame {frames[0]!r}" if frames[0] else "the frame of the recording"
        assumptions.append(
            f"poses stay in {frame}: to convert them, give the pose of the task's target in it as --target"
        )
    used = (*clock, *position, *orientation)
    unused = [column for column in columns if column.name and not any(column is other for other in used)]
    if left := [column.name for column in unused if not column.frame]:
        assumptions.append(f"{_listed(left)} {'is' if len(left) == 1 else 'are'} left out")
    if rotations is None:
        return Recorded([times], [positions], POSE_NAMES[:3], assumptions, frames)
    return Recorded([times], [poses_in_target(positions, rotations, target, like)], POSE_NAMES, assumptions, frames)


def _named(file: Path, columns: Sequence[_Column]) -> list[_Column]:
    """Return columns with the names that this module searches for: RTDE numbers the coordinates of a pose."""
    if len({match[1] for column in columns if (match := _TCP_POSE.fullmatch(column.name))}) > 1:
        raise InputError(f"{file} has the poses actual_TCP_pose and target_TCP_pose: keep the columns of one of them")
    coordinates = ("x [m]", "y [m]", "z [m]", "rx [rad]", "ry [rad]", "rz [rad]")
    return [
        replace(column, name=f"{column.name[:-1]}{coordinates[int(column.name[-1])]}")
        if _TCP_POSE.fullmatch(column.name)
        else column
        for column in columns
    ]


def _stated_meters(file: Path, position: Sequence[_Column], orientation: Sequence[_Column]) -> str:
    """Return the assumption that positions are in meters if the columns are a ROS message's pose, otherwise "".

    A position and an orientation of two messages are refused.
    """
    fields = [_ROS_FIELD.fullmatch(column.plain) for column in position]
    fields += [_ROS_ROTATION.fullmatch(column.plain) for column in orientation]
    if len(orientation) != 4 or None in fields:
        return ""
    if len({match["message"] for match in fields if match is not None}) > 1:
        raise InputError(
            f"{file} has {position[0].name} and {orientation[0].name}, of two messages: keep the columns of one"
        )
    return f"{position[0].name} is a field of a ROS message, in meters (REP 103)"


def _frames_of(columns: Sequence[_Column]) -> Frames:
    """Return the frame of the poses and the frame that they move, as far as columns name them."""
    frame, child = "", ""
    for column in columns:
        if match := _FRAME.fullmatch(column.name):
            frame, child = (frame, column.frame) if match["child"] else (column.frame, child)
    return frame, child


def _refuse_orientation(file: Path, columns: Sequence[_Column], used: Sequence[_Column]) -> None:
    """Raise an InputError if columns that are not used describe an orientation, which must not be dropped."""
    left = [column for column in columns if not any(column is other for other in used)]
    plain = [column for column in left if not re.search(r"covariance|velocity|vel[._/ ]", column.plain)]
    found = [c.name for c in plain if _ORIENTATION.fullmatch(c.plain) or c.name in (*_KUKA, *"WPRw")]
    if found:
        is_one = len(found) == 1
        raise InputError(
            f"{file} has {_listed(found)}, which {'is' if is_one else 'are'} not the whole of an orientation in a "
            "known convention: name four columns qx, qy, qz and qw, or three roll, pitch and yaw, or delete "
            f"{'it' if is_one else 'them'} to import positions alone"
        )
    unknown = [column for column in left if column.name and not column.frame and not _OTHER.fullmatch(column.plain)]
    unit = next((four for four in combinations(unknown[:_MAX_LISTED], 4) if _is_quaternion(four)), ())
    if unit or len(unknown) in _ORIENTATION_SIZES:
        names = _listed([column.name for column in unit or unknown])
        raise InputError(
            f"{file} has no orientation in a known convention, and {names} could be one: name four columns qx, qy, qz "
            "and qw, or three roll, pitch and yaw, or delete these to import positions alone"
        )


def _is_quaternion(columns: Sequence[_Column]) -> bool:
    """Return True if the values of every line are a unit quaternion in some order."""
    squares = np.sum([column.values**2 for column in columns], axis=0)
    return bool(np.all(np.abs(squares - 1.0) < 2e-3))


def _table(file: Path) -> list[_Column]:
    """Return the columns of a table of numbers, empty fields as NaN; every line has as many fields as the header."""
    try:
        data = read_bytes(file, "table", MAX_FILE_SIZE)
        text = data.decode("utf-8-sig")  # Excel writes a byte-order mark, which is not part of a name
        first = next((line for line in io.StringIO(text) if line.strip()), "")
        delimiter = next((character for character in _DELIMITERS if character in first), ",")
        lines = csv.reader(io.StringIO(text), delimiter=delimiter, skipinitialspace=True, strict=True)
        rows = ((lines.line_num, row) for row in lines if len(row) > 1 or "".join(row).strip())
        _, names = next(rows, (0, []))
        if sum(_is_number(name) for name in names) > len(names) // 2:
            raise InputError(
                f"{file} begins with numbers instead of a line of names, as ros2 topic echo --csv writes it: add the "
                "names as the first line, for a PoseStamped sec,nanosec,frame_id,pose.position.x,pose.position.y,"
                "pose.position.z,pose.orientation.x,pose.orientation.y,pose.orientation.z,pose.orientation.w"
            )
        frames: dict[int, str | None] = {at: None for at, name in enumerate(names) if _FRAME.fullmatch(name.strip())}
        values = array("d")
        for number, row in rows:
            if len(row) != len(names):
                raise InputError(f"{file}: line {number} has {len(row)} fields, the header has {len(names)}")
            for at, frame in frames.items():
                text, row[at] = plain_frame(row[at]), ""
                if frame not in (None, text):
                    raise InputError(
                        f"{file} has poses in the frames {brief(str(frame))} and {brief(text)} (line {number}): record "
                        "each frame in a file of its own"
                    )
                frames[at] = text
            values.extend([np.nan if field.strip().lower() in _EMPTY else parse_number(field) for field in row])
    except InputError:
        raise
    except (ValueError, OSError, csv.Error) as error:
        raise InputError(f"{file} is not a table of numbers below a line of names: {brief(str(error))}") from error
    if not names:
        raise InputError(f"{file} is not a table of numbers below a line of names: it is empty")
    if repeated := find_repeated(name.strip() for name in names):
        raise InputError(f"{file} has {repeated[:200]} and {repeated[:200]}: keep only one of the two columns")
    table = np.frombuffer(values, dtype=float).reshape(-1, len(names))
    return [
        _Column(name.strip(), column, frames.get(at) or "")
        for at, (name, column) in enumerate(zip(names, table.T, strict=True))
    ]


def _is_number(text: str) -> bool:
    try:
        parse_number(text)
    except ValueError:
        return False
    return True


def _units(
    file: Path, columns: Sequence[_Column], known: Collection[str], given: str | None, option: str
) -> list[str | None]:
    """Return the unit of each column: the unit in the column's name, otherwise `given`; the two must not differ."""
    units = []
    for column in columns:
        unit = _unit_of_name(file, column.name, known) or given
        if given not in (None, unit):
            raise InputError(
                f"{file} has {column.name}, which contradicts {option} {given}: leave {option} out, and name each "
                "column's unit"
            )
        units.append(unit)
    return units


def _unit_of_name(file: Path, name: str, known: Collection[str]) -> str | None:
    """Return the unit in a column's name, in brackets or as its ending; None if the name has no unit."""
    plain = unicodedata.normalize("NFKC", name).lower()  # maps the micro sign to the Greek letter
    if inside := [text.strip() for text in re.findall(r"[\[(]([^\[\]()]*)", plain)]:
        units = [unit for text in inside if (unit := _UNIT_OF_SPELLING.get(text, text)) in known]
        if not units:
            raise InputError(f"{file} has {name}, whose unit is not one of {', '.join(known)}: convert or rename it")
        return units[-1]
    at_end = re.search(rf"_({'|'.join(known)})$", plain)
    return at_end and at_end.group(1)


def _listed(names: Sequence[str]) -> str:
    if len(names) > _MAX_LISTED:
        names = [*names[:_MAX_LISTED], f"{len(names) - _MAX_LISTED} more"]
    *most, last = names
    return f"{', '.join(most)} and {last}" if most else last


def _column(file: Path, columns: Sequence[_Column], wanted: str) -> _Column | None:
    """Return the column `wanted`, or the only pose column whose name ends in `wanted`; None if both are missing."""
    named = rf"{wanted}(_mm|_cm|_m|_rad|_deg)?"
    exact = [column for column in columns if re.fullmatch(named, column.plain)]
    ends = [column for column in columns if re.fullmatch(_PREFIX + named, column.plain)]
    excluded = [_NO_POSE, *([_NO_POSITION] if wanted in "xyz" else [])]
    ends = [column for column in ends if not any(pattern.fullmatch(column.plain) for pattern in excluded)]
    return _only(file, exact or ends, wanted)


def _columns(file: Path, columns: Sequence[_Column], wanted: Sequence[str]) -> list[_Column]:
    """Return the columns `wanted`, or an empty list if one of them is missing."""
    found = [column for name in wanted if (column := _column(file, columns, name)) is not None]
    return found if len(found) == len(wanted) else []


def _only(file: Path, found: Sequence[_Column], wanted: str) -> _Column | None:
    """Return the only column in `found`, or None if it is empty; raise an InputError if there are several."""
    if len(found) > 1:
        names = _listed([column.name for column in found])
        raise InputError(f"{file} has {names}, and does not state which of them is {wanted}: keep only that one")
    return found[0] if found else None


def _time(
    file: Path, columns: Sequence[_Column], given: str | None, assumptions: list[str]
) -> tuple[list[_Column], np.ndarray]:
    """Return the time columns, and the time since the first sample (N,) [s].

    The stamp of a ROS message, in seconds and nanoseconds, counts before another clock.
    """
    parts = [
        _only(file, [c for c in columns if re.fullmatch(_STAMP + name, c.plain)], name)
        for name in ("secs?", "(?:nanosec|nanosecs|nsecs?)")
    ]
    if parts[0] is not None and parts[1] is not None:
        for given_unit in (given,) if given is not None else ():
            raise InputError(f"{file} has {parts[0].name} and {parts[1].name}: leave --time-unit {given_unit} out")
        whole = parts[0].values - parts[0].values[0]
        times = whole + (parts[1].values - parts[1].values[0]) * 1e-9
        _check_clock(file, f"{parts[0].name} and {parts[1].name}", times)
        return [part for part in parts if part is not None], times
    matches = [column for column in columns if TIME.fullmatch(re.sub(r"_(s|ms|us|ns)$", "", column.plain))]
    clock = _only(file, matches, "time")
    if clock is None:
        raise InputError(f"{file} has no column t, time or timestamp: add one")
    (unit,) = _units(file, [clock], _TIME_UNITS, given, "--time-unit")
    if clock.name == "%time" and given is None:
        unit = "ns"  # rostopic echo -p
        assumptions.append("%time is in nanoseconds, as rostopic echo -p writes it")
    ticks = clock.values
    steps = _check_clock(file, clock.name, ticks)
    if unit is None:
        step = float(np.median(steps[steps > 0.0]))  # a recorder faster than the robot repeats time stamps
        fitting = [name for name, scale in _TIME_UNITS.items() if _PERIODS[0] <= step * scale < _PERIODS[1]]
        if fitting[:1] != ["s"]:
            candidates = " or ".join(fitting) or "s, ms, us or ns"
            raise InputError(
                f"{file} does not state the unit of {clock.name}, whose step is {step:g}: give --time-unit {candidates}"
            )
        unit = "s"
        assumptions.append(f"{clock.name} is in seconds, {1.0 / step:.4g} samples in each")
    return [clock], (ticks - ticks[0]) * _TIME_UNITS[unit]


def _check_clock(file: Path, name: str, ticks: np.ndarray) -> np.ndarray:
    """Return the steps of a clock; one that decreases or never increases is refused."""
    steps = np.diff(ticks)
    if (steps < 0.0).any():
        at = int(np.argmax(steps < 0.0)) + 1
        raise InputError(f"{file}: the time column {name} decreases at sample {at}: sort or drop samples")
    if not (steps > 0.0).any():
        raise InputError(f"{file}: the time column {name} does not increase: a motion needs increasing time")
    return steps


def _rotations(
    file: Path,
    columns: Sequence[_Column],
    quaternion: str | None,
    angles: str | None,
    assumptions: list[str],
    unstated: list[tuple[str, str]],
) -> tuple[list[_Column], Rotation | None]:
    """Return the columns of the orientation and its rotations (N,); no columns and None without an orientation.

    If the unit of the angles is not stated, a text about it and the option that states it are added to `unstated`.
    """
    for names in _QUATERNION:
        if matches := _columns(file, columns, names):
            places = {id(column): place for place, column in enumerate(columns)}
            in_file = sorted(zip(matches, "xyzw", strict=True), key=lambda pair: places[id(pair[0])])
            order = "".join(letter for _, letter in in_file)
            if quaternion not in (None, order):
                listed = ", ".join(column.name for column, _ in in_file)
                raise InputError(f"{file} has {listed}, which contradicts --quaternion {quaternion}: leave it out")
            return matches, rotations_of(np.column_stack([column.values for column in matches]), str(file))
    numbers = {column.plain for column in columns if re.fullmatch("q[0-9]+", column.plain)}
    for names in _UNNAMED if len(numbers) == 4 else ():
        same = [_only(file, [column for column in columns if column.plain == name], name) for name in names]
        matches = [column for column in same if column is not None]
        if len(matches) == len(names):
            if quaternion is None:
                raise InputError(
                    f"{file} has the quaternion {', '.join(names)} and does not state which is its scalar: give "
                    "--quaternion wxyz or xyzw"
                )
            values = np.column_stack([column.values for column in matches])
            return matches, rotations_of(values if quaternion == "xyzw" else values[:, [1, 2, 3, 0]], str(file))
    fixed = [[column for column in columns if re.fullmatch(rf"R{axis} ?\[(deg|rad)\]", column.name)] for axis in "xyz"]
    if all(len(named) == 1 for named in fixed):  # names that guiderail writes; a rotation vector has rx, ry and rz
        matches = [column for (column,) in fixed]
        scales = [_ANGLE_UNITS[str(unit)] for unit in _units(file, matches, _ANGLE_UNITS, angles, "--angles")]
        assumptions.append("Rz, Ry and Rx are ZYX Euler angles, Rz Ry Rx")
        return matches, Rotation.from_euler("xyz", np.column_stack([column.values for column in matches]) * scales)
    for euler in _EULER:
        if matches := _columns(file, columns, euler):
            units = _units(file, matches, _ANGLE_UNITS, angles, "--angles")
            if None in units:
                name = matches[units.index(None)].name
                unstated.append((f"whether {name} is in degrees", "--angles deg or rad"))
                return matches, None
            assumptions.append("roll, pitch and yaw are about fixed axes, Rz(yaw) Ry(pitch) Rx(roll)")
            scales = [_ANGLE_UNITS[str(unit)] for unit in units]
            rotation_angles = np.column_stack([column.values for column in matches]) * scales
            return matches, Rotation.from_euler("xyz", rotation_angles)
    if matches := _columns(file, columns, _ROTATION_VECTOR):
        return matches, _rotation_vectors(file, matches, angles, assumptions)
    kuka = [
        column
        for name in _KUKA
        for column in columns
        if re.fullmatch(rf"{name}(?:[ _]?[\[(].*|_deg|_rad)?", column.name)
    ]
    if len(kuka) == len(_KUKA):
        units = [unit or "deg" for unit in _units(file, kuka, _ANGLE_UNITS, angles, "--angles")]
        assumptions.append(f"A, B and C are the angles of a KUKA [{units[0]}], Rz(A) Ry(B) Rx(C)")
        scales = [_ANGLE_UNITS[str(unit)] for unit in units]
        return kuka, Rotation.from_euler("ZYX", np.column_stack([column.values for column in kuka]) * scales)
    return [], None


def _rotation_vectors(file: Path, columns: Sequence[_Column], angles: str | None, assumptions: list[str]) -> Rotation:
    """Return the rotations of rotation vectors, as Universal Robots' rx, ry and rz [rad]."""
    listed = _listed([column.name for column in columns])
    advice = "name the columns roll, pitch and yaw if they are angles about fixed axes"
    if "deg" in _units(file, columns, _ANGLE_UNITS, angles, "--angles"):
        raise InputError(f"{file} has {listed} in degrees, and a rotation vector is in radians: {advice}")
    vectors = np.column_stack([column.values for column in columns])
    if (longest := float(np.linalg.norm(vectors, axis=1).max())) > 2.0 * np.pi + 0.1:
        raise InputError(
            f"{file} has {listed} of length {longest:.4g}, and a rotation vector in radians has at most 2π: {advice}"
        )
    assumptions.append(f"{listed} are a rotation vector in radians, as on a Universal Robots arm")
    return Rotation.from_rotvec(vectors)
