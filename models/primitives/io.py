"""Files of demonstrations: `.npz`, which is exact and small, and `.csv`, which every other program writes.

Whatever a file holds, reading it takes a bounded time and memory, and nothing in it is ever executed. An `.npz` is a
zip of `.npy` arrays; NumPy's own reader allocates what a header claims, and does not check what it has no use for, so
that the headers are read here, and an array only where its header, its size and its checksum agree.
"""

import ast
import csv
import io
import os
import re
import struct
import sys
import zipfile
import zlib
from array import array
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from guiderail.models.common.errors import InputError, brief
from guiderail.models.common.files import read_bytes, write_atomically

MOST_NUMBERS = 2_000_000  # times and outputs together: five minutes of six outputs at a kilohertz
MOST_DEMONSTRATIONS = 1_000
MOST_LINES = 400_000  # of text: six minutes at a kilohertz
LARGEST_FILE = 32_000_000  # [bytes]
_LONGEST_LINE = 100_000  # characters
_LARGEST_NAMES = 1_000_000  # [bytes]
_LARGEST_DIRECTORY = 100_000  # [bytes] of an archive

# Whoever writes a demonstration a file calls its clock one of these, with or without a unit.
_TIME = re.compile(r"(?:t|time|timestamp)\s*(?P<unit>[\[(/].*)?", re.IGNORECASE)
SECONDS = ("s", "sec", "secs", "second", "seconds")


class Recording(NamedTuple):
    """What a file holds, as `Demonstrations` takes it."""

    times: Sequence[np.ndarray] | np.ndarray
    outputs: Sequence[np.ndarray] | np.ndarray
    names: Sequence[str] | None


def read(path: Path) -> Recording:
    """Reads a file by its ending, or all `.csv` files of a folder.

    Raises:
        InputError: if there is nothing, it is damaged, too large, or what it holds are no demonstrations.
    """
    if not _is_folder(path):
        return _read_file(path, LARGEST_FILE)
    try:
        return _read_folder(path)
    except OSError as error:
        raise InputError(f"the folder '{path}' can't be read ({error.strerror}): check its rights") from error


def _read_file(path: Path, most: int) -> Recording:
    """Reads one file of at most `most` bytes."""
    reader = {".npz": _read_npz, ".csv": _read_csv}.get(path.suffix)
    if reader is None:
        raise InputError(
            f"cannot read demonstrations from '{path.name}': the ending must be .npz or .csv, or it must be a folder"
        )
    data = read_bytes(path, "demonstration file", most)
    try:
        return reader(data)
    except InputError as error:
        raise InputError(f"'{path}': {error}") from error


def write_npz(path: Path, times: Sequence[np.ndarray], outputs: Sequence[np.ndarray], names: Sequence[str]) -> None:
    """All samples one after the other, and how many each demonstration has."""
    content = io.BytesIO()
    np.savez_compressed(
        content,
        lengths=np.array([len(t) for t in times]),
        times=np.concatenate(times),
        outputs=np.concatenate(outputs),
        names=np.array(names),
    )
    write_atomically(path, content.getvalue())


def write_csv(path: Path, times: Sequence[np.ndarray], outputs: Sequence[np.ndarray], names: Sequence[str]) -> None:
    """One row a sample: demonstration, time, outputs."""
    text = io.StringIO(newline="")
    writer = csv.writer(text)
    writer.writerow(["demonstration", "time", *names])
    for m, (t, y) in enumerate(zip(times, outputs, strict=True)):
        writer.writerows([m, repr(float(a)), *(repr(float(v)) for v in b)] for a, b in zip(t, y, strict=True))
    write_atomically(path, text.getvalue().encode())


def _is_folder(path: Path) -> bool:
    try:
        return path.is_dir()
    except OSError as error:
        raise InputError(f"the path '{brief(str(path))}' can't be read ({error.strerror}): check it") from error


# --- .npz ---


@dataclass(frozen=True)
class _Member:
    """One array of an archive, as its header describes it."""

    info: zipfile.ZipInfo
    dtype: np.dtype
    shape: tuple[int, ...]
    fortran_order: bool
    start: int  # of the numbers, behind the header [bytes]

    @property
    def count(self) -> int:
        size = 1
        for length in self.shape:
            size *= length
        return size

    def read(self, archive: zipfile.ZipFile) -> np.ndarray:
        data = archive.read(self.info)  # its checksum too
        values = np.frombuffer(data, self.dtype, offset=self.start)
        return values.reshape(self.shape, order="F" if self.fortran_order else "C")


def _read_npz(data: bytes) -> Recording:
    try:
        _refuse_large_directory(data)
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            return _read_archive(archive)
    except InputError:
        raise
    except (zipfile.BadZipFile, zlib.error, ValueError, OSError, EOFError, NotImplementedError, struct.error) as error:
        raise InputError(f"it is damaged or no .npz file: {brief(str(error))}") from error


def _refuse_large_directory(data: bytes) -> None:
    """Every entry of an archive's directory costs a reader time and memory; NumPy writes one an array, at its end."""
    if data[:6] == b"\x93NUMPY":
        raise InputError("it is a single array (.npy): save `times` and `outputs` with numpy.savez")
    end = data[-22:]
    if data[:4] != b"PK\x03\x04" or end[:4] != b"PK\x05\x06":
        raise InputError("it is damaged or no .npz file: its beginning or its end is missing")
    (size,) = struct.unpack("<L", end[12:16])
    if size > _LARGEST_DIRECTORY or data[-42:-38] == b"PK\x06\x07":
        raise InputError("it holds too many arrays: save `times` and `outputs` alone")


def _read_archive(archive: zipfile.ZipFile) -> Recording:
    held = [info.filename for info in archive.infolist()]
    members = {key: _member(archive, key) for key in ("times", "outputs", "lengths", "names") if f"{key}.npy" in held}
    for key in ("times", "outputs"):
        if key not in members:
            raise InputError(f"the array '{key}' is missing")
    for key, member in members.items():
        if held.count(f"{key}.npy") > 1:
            raise InputError(f"there are two arrays '{key}'")
        if key != "names" and member.dtype.kind not in "fiub":
            raise InputError(f"'{key}' must hold numbers, not {member.dtype}: save it as float64")
    total = members["times"].count + members["outputs"].count
    if total > MOST_NUMBERS:
        raise InputError(f"it holds {total} numbers, more than {MOST_NUMBERS}: thin the samples out")
    names = _names(archive, members["names"]) if "names" in members else None
    if "lengths" in members:
        return _split(archive, members, names)
    outputs, times = members["outputs"], members["times"]
    if len(outputs.shape) != 3 or times.shape not in (outputs.shape[1:2], outputs.shape[:2]):
        raise InputError(
            f"without 'lengths', outputs must be (M, N, O) and times (N,) or (M, N), not {outputs.shape} and "
            f"{times.shape}"
        )
    _refuse_many(outputs.shape[0])
    return Recording(times.read(archive), outputs.read(archive), names)


def _split(archive: zipfile.ZipFile, members: dict[str, _Member], names: list[str] | None) -> Recording:
    """All samples one after the other, cut into demonstrations."""
    lengths, times, outputs = members["lengths"], members["times"], members["outputs"]
    if lengths.dtype.kind not in "iu" or len(lengths.shape) != 1:
        raise InputError(f"'lengths' must be whole numbers (M,), not {lengths.dtype} {lengths.shape}")
    _refuse_many(lengths.count)
    if len(times.shape) != 1 or len(outputs.shape) != 2 or outputs.shape[:1] != times.shape:
        raise InputError(
            f"with 'lengths', times must be (N,) and outputs (N, O), not {times.shape} and {outputs.shape}"
        )
    counts = [int(length) for length in lengths.read(archive)]
    if min(counts) < 1:
        raise InputError(f"'lengths' must be positive, not {min(counts)}")
    if sum(counts) != times.count:
        raise InputError(f"lengths add up to {sum(counts)}, but there are {times.count} samples")
    cuts = np.cumsum(counts)[:-1]
    return Recording(np.split(times.read(archive), cuts), np.split(outputs.read(archive), cuts), names)


def _names(archive: zipfile.ZipFile, member: _Member) -> list[str]:
    if member.dtype.kind != "U" or len(member.shape) != 1 or member.info.file_size > _LARGEST_NAMES:
        raise InputError("'names' must be a list of short texts, one for each output")
    names = member.read(archive)
    codes = np.ascontiguousarray(names).view(names.dtype.byteorder.replace("|", "=") + "u4")
    if (codes > sys.maxunicode).any():  # NumPy would fail on it, and not with a ValueError
        raise InputError("'names' holds characters that there are none of")
    return [str(name) for name in names]


def _member(archive: zipfile.ZipFile, key: str) -> _Member:
    """The header of one array, with nothing else decompressed."""
    info = archive.getinfo(f"{key}.npy")
    if info.flag_bits & 1:
        raise InputError(f"'{key}' is encrypted: save it without a password")
    if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise InputError(f"'{key}' is compressed in a way that NumPy does not write: save it with numpy.savez")
    with archive.open(info) as file:
        head = file.read(12)
        long = head[6:7] in (b"\x02", b"\x03")
        if head[:6] != b"\x93NUMPY" or head[6:8] not in (b"\x01\x00", b"\x02\x00", b"\x03\x00"):
            raise InputError(f"'{key}' is no array")
        start = 12 if long else 10
        (length,) = struct.unpack("<L", head[8:12]) if long else struct.unpack("<H", head[8:10])
        if length > 1000:
            raise InputError(f"'{key}' has a header that NumPy does not write")
        header = (head[start:] + file.read(length + start - 12))[:length].decode("latin-1")
    dtype, shape, fortran_order = _header(header, key)
    member = _Member(info, dtype, shape, fortran_order, start + length)
    if info.file_size != start + length + member.count * dtype.itemsize:
        raise InputError(f"'{key}' claims the shape {shape}, which is not what it holds")
    if not member.count:
        raise InputError(f"'{key}' is empty, of shape {shape}")
    return member


def _header(text: str, key: str) -> tuple[np.dtype, tuple[int, ...], bool]:
    try:
        header = ast.literal_eval(text.strip())
        description, fortran_order, shape = header["descr"], header["fortran_order"], header["shape"]
    except (SyntaxError, ValueError, TypeError, LookupError, RecursionError, MemoryError) as error:
        raise InputError(f"'{key}' has no header that can be read") from error
    if not isinstance(fortran_order, bool) or not isinstance(shape, tuple):
        raise InputError(f"'{key}' has no header that can be read")
    if not all(type(length) is int and length >= 0 for length in shape):
        raise InputError(f"'{key}' claims the shape {brief(shape)}")
    if description == "|O":
        raise InputError(f"'{key}' holds Python objects, which could execute: save it as float64")
    if not isinstance(description, str) or not re.fullmatch(r"[<>=|](f[248]|[iu][1248]|b1|U[1-9]\d{0,3})", description):
        raise InputError(f"'{key}' must hold numbers or names, not {brief(description)}: save it as float64")
    return np.dtype(description), shape, fortran_order


def _refuse_many(count: int) -> None:
    if count > MOST_DEMONSTRATIONS:
        raise InputError(f"there are {count} demonstrations, more than {MOST_DEMONSTRATIONS}: a few are enough")


# --- .csv ---


def _read_csv(data: bytes) -> Recording:
    # NumPy and Python read more as a number than other programs do: digits of other scripts, and 1_000.
    plain = data.isascii() and b"_" not in data
    lines = csv.reader(_lines(data), strict=True)
    values = array("d")
    try:
        header = [name.strip() for name in next(lines, [])]
        several = header[:2] == ["demonstration", "time"]
        clock = _TIME.fullmatch(header[several]) if len(header) >= 2 + several else None
        if clock is None:
            raise InputError("the first line must be demonstration,time,<outputs> or time,<outputs>")
        if clock["unit"] is not None and clock["unit"].strip("[(/)] ").lower() not in SECONDS:
            raise InputError(
                f"time is in seconds, and the first line has {brief(header[several])}: convert it, or let guiderail "
                "import do so where the outputs are poses"
            )
        for row in lines:
            if len(row) != len(header):
                if not row:
                    continue
                raise InputError(f"line {lines.line_num} has {len(row)} fields, the header has {len(header)}")
            if not plain and not all(field.isascii() and "_" not in field for field in row):
                raise InputError(f"line {lines.line_num} holds something that is no number")
            try:
                values.extend(map(float, row))
            except ValueError as error:
                raise InputError(f"line {lines.line_num} holds something that is no number: {error}") from error
            if len(values) > MOST_NUMBERS:
                raise InputError(f"it holds more than {MOST_NUMBERS} numbers: thin the samples out")
    except (csv.Error, UnicodeDecodeError) as error:
        raise InputError(f"it is no table of numbers: {error}") from error
    samples = np.frombuffer(values, dtype=float).reshape(-1, len(header))
    if not several:
        return Recording([samples[:, 0]], [samples[:, 1:]], header[1:])
    parts = _parts(samples)
    return Recording([part[:, 1] for part in parts], [part[:, 2:] for part in parts], header[2:])


def _lines(data: bytes) -> Iterator[str]:
    for number, line in enumerate(io.TextIOWrapper(io.BytesIO(data), encoding="utf-8-sig", newline="")):
        if number > MOST_LINES:
            raise InputError(f"it has more than {MOST_LINES} lines: thin the samples out")
        if len(line) > _LONGEST_LINE:
            raise InputError(f"a line is longer than {_LONGEST_LINE} characters")
        yield line


def _parts(samples: np.ndarray) -> list[np.ndarray]:
    """The rows of each demonstration, by the number in the first column."""
    labels = samples[:, 0]
    if not (np.isfinite(labels).all() and (labels == np.round(labels)).all() and (np.abs(labels) < 2**53).all()):
        raise InputError("the column 'demonstration' must hold whole numbers")
    found, counts = np.unique(labels, return_counts=True)
    _refuse_many(len(found))
    if not len(found):
        raise InputError("there is no demonstration: give at least one")
    return np.split(samples[np.argsort(labels, kind="stable")], np.cumsum(counts)[:-1])


def _read_folder(folder: Path) -> Recording:
    """The demonstrations of every `.csv` file, in the order of the files' names, their numbers read as numbers."""
    files = _csv_files(folder)
    times: list[np.ndarray] = []
    outputs: list[np.ndarray] = []
    first: Sequence[str] | None = None
    left, samples = LARGEST_FILE, 0
    for file in files:
        recording = _read_file(file, left)
        left -= file.stat().st_size
        samples += sum(len(t) for t in recording.times)
        if samples > MOST_LINES:
            raise InputError(f"the folder '{folder}' holds more than {MOST_LINES} samples: thin them out")
        first = recording.names if first is None else first
        if recording.names != first:
            raise InputError(f"'{file}' has other columns than the first file: record the same outputs in all of them")
        times += recording.times
        outputs += recording.outputs
    if len(times) > MOST_DEMONSTRATIONS:
        raise InputError(f"the folder '{folder}' holds {len(times)} demonstrations: {MOST_DEMONSTRATIONS} are enough")
    return Recording(times, outputs, first)


def _csv_files(folder: Path) -> list[Path]:
    files: list[Path] = []
    with os.scandir(folder) as entries:
        for entry in entries:
            if entry.name.endswith(".csv") and not entry.name.startswith("."):
                files.append(Path(entry.path))
            if len(files) > MOST_DEMONSTRATIONS:
                raise InputError(f"the folder '{folder}' holds more than {MOST_DEMONSTRATIONS} files: a few are enough")
    if not files:
        raise InputError(f"there is no .csv file in the folder '{folder}': put one there for each demonstration")
    return sorted(files, key=_natural)


def _natural(path: Path) -> list[tuple[int, int | str]]:
    """So that `demo_10` comes after `demo_9`."""
    parts = re.split(r"([0-9]+)", path.stem)
    return [(0, int(part)) if part.isdigit() else (1, part) for part in parts]
