"""Readers and writers of demonstration files: small `.npz` files, and `.csv` files, which any program can write.

Reading takes bounded time and memory for any content, and never executes code. NumPy's reader allocates the size that a
header claims. Headers are therefore compared with the size of the array before the array is read. CSV files are read by
the standard library's strict reader, because `pandas.read_csv` fills short rows and accepts text after a closing quote.
"""

import csv
import io
import os
import re
import sys
import zipfile
import zlib
from array import array
from collections.abc import Iterable, Iterator, Sequence
from math import prod
from pathlib import Path
from tokenize import TokenError
from typing import Any, NamedTuple

import numpy as np

from guiderail.models.common.arrays import parse_number
from guiderail.models.common.errors import InputError, brief
from guiderail.models.common.files import in_order, read_bytes, write_atomically

MAX_NUMBERS = 2_000_000  # largest number of values in a file, enough for four minutes of six outputs at 1 kHz
MAX_DEMONSTRATIONS = 1_000  # largest number of demonstrations in a file or a folder
MAX_LINES = 400_000  # largest number of lines of a text file or samples of a folder, enough for six minutes at 1 kHz
MAX_FILE_SIZE = 32_000_000  # largest size of a file, or of all files of a folder [bytes]
# Largest accepted step to the last number of a file without a final line end, relative to the largest step before.
MAX_LAST_STEP = 3.0
_MAX_LINE_LENGTH = 100_000  # largest length of a line [characters]
_MAX_HEADER_SIZE = 1_000  # largest header of an array [bytes]; NumPy writes 118
_MAX_NAMES_SIZE = 1_000_000  # largest size of the array of names [bytes]
_MAX_DIRECTORY_SIZE = 100_000  # largest directory of an archive [bytes]

# Name of the clock's column in a file of one demonstration, with or without a unit.
_TIME = re.compile(r"(?:t|time|timestamp)\s*(?P<unit>[\[(/].*)?", re.IGNORECASE)
SECONDS = ("s", "sec", "secs", "second", "seconds")  # accepted spellings of the unit of time


class Recording(NamedTuple):
    """Content of a demonstration file: the arguments of `Demonstrations`."""

    times: Sequence[np.ndarray] | np.ndarray
    outputs: Sequence[np.ndarray] | np.ndarray
    names: Sequence[str] | None


def read(path: Path) -> Recording:
    """Read a file by its ending, or all `.csv` files of a folder except hidden ones.

    Raises:
        InputError: If there is no such file, it is damaged or too large, or it does not hold demonstrations.
    """
    try:
        is_folder = path.is_dir()
    except OSError as error:
        raise InputError(f"the path '{brief(str(path))}' can't be read ({error.strerror}): check it") from error
    if not is_folder:
        return _read_file(path, MAX_FILE_SIZE)
    try:
        return _read_folder(path)
    except OSError as error:
        raise InputError(f"the folder '{path}' can't be read ({error.strerror}): check its rights") from error


def _read_file(path: Path, max_size: int) -> Recording:
    reader = {".npz": _read_npz, ".csv": _read_csv}.get(path.suffix)
    if reader is None:
        raise InputError(
            f"cannot read demonstrations from '{path.name}': the ending must be .npz or .csv, or it must be a folder"
        )
    data = read_bytes(path, "demonstration file", max_size)
    try:
        return reader(data)
    except InputError as error:
        raise InputError(f"'{path}': {error}") from error


def write_npz(path: Path, times: Sequence[np.ndarray], outputs: Sequence[np.ndarray], names: Sequence[str]) -> None:
    """Write demonstrations to an .npz file: their concatenated samples, their `lengths` and the outputs' names.

    Args:
        path: File to write.
        times: M clocks (N_m,) [s or phase].
        outputs: M arrays (N_m, O).
        names: Names of the O outputs.

    Raises:
        InputError: If the file cannot be written.
    """
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
    """Write demonstrations to a .csv file with one row per sample: demonstration, time, outputs.

    Arguments and errors are those of `write_npz`.
    """
    text = io.StringIO(newline="")
    writer = csv.writer(text)
    writer.writerow(["demonstration", "time", *names])
    for m, (t, y) in enumerate(zip(times, outputs, strict=True)):
        writer.writerows([m, repr(float(a)), *(repr(float(v)) for v in b)] for a, b in zip(t, y, strict=True))
    write_atomically(path, text.getvalue().encode())


# --- .npz ---


class _Header(NamedTuple):
    """Header of one array of an archive."""

    info: zipfile.ZipInfo
    shape: tuple[int, ...]
    dtype: np.dtype


def _read_npz(data: bytes) -> Recording:
    try:
        _check_directory(data)
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            return _read_archive(archive)
    except InputError:
        raise
    except (zipfile.BadZipFile, zlib.error, ValueError, OSError, EOFError, NotImplementedError) as error:
        raise InputError(f"it is damaged or not an .npz file: {brief(str(error))}") from error


def _check_directory(data: bytes) -> None:
    """Raise an InputError if data are not a complete archive, or if the archive's directory is too large.

    Every entry of the directory costs time and memory.
    """
    if data[:6] == b"\x93NUMPY":
        raise InputError("it is a single array (.npy): save `times` and `outputs` with numpy.savez")
    end = data[-22:]
    if data[:4] != b"PK\x03\x04" or end[:4] != b"PK\x05\x06":
        raise InputError("it is damaged or not an .npz file: its beginning or its end is missing")
    if int.from_bytes(end[12:16], "little") > _MAX_DIRECTORY_SIZE or data[-42:-38] == b"PK\x06\x07":
        raise InputError("it holds too many arrays: save `times` and `outputs` alone")


def _read_archive(archive: zipfile.ZipFile) -> Recording:
    files = [info.filename for info in archive.infolist()]
    keys = [key for key in ("times", "outputs", "lengths", "names") if f"{key}.npy" in files]
    headers = {key: _read_header(archive, key) for key in keys}
    for key in ("times", "outputs"):
        if key not in headers:
            raise InputError(f"the array '{key}' is missing")
    for key, header in headers.items():
        if files.count(f"{key}.npy") > 1:
            raise InputError(f"there are two arrays '{key}'")
        if key != "names" and header.dtype.kind not in "fiub":
            raise InputError(f"'{key}' must hold numbers, not {header.dtype}: save it as float64")
    times, outputs = headers["times"].shape, headers["outputs"].shape
    total = prod(times) + prod(outputs)
    if total > MAX_NUMBERS:
        raise InputError(f"it holds {total} numbers, more than {MAX_NUMBERS}: thin the samples out")
    names = _read_names(archive, headers["names"]) if "names" in headers else None
    if "lengths" in headers:
        return _split(archive, headers, names)
    if len(outputs) != 3 or times not in (outputs[1:2], outputs[:2]):
        raise InputError(
            f"without 'lengths', outputs must be (M, N, O) and times (N,) or (M, N), not {outputs} and {times}"
        )
    _check_count(outputs[0])
    return Recording(_read_array(archive, headers["times"]), _read_array(archive, headers["outputs"]), names)


def _split(archive: zipfile.ZipFile, headers: dict[str, _Header], names: list[str] | None) -> Recording:
    """Read the concatenated samples of all demonstrations and split them by demonstration."""
    lengths, times, outputs = (headers[key] for key in ("lengths", "times", "outputs"))
    if lengths.dtype.kind not in "iu" or len(lengths.shape) != 1:
        raise InputError(f"'lengths' must be whole numbers (M,), not {lengths.dtype} {lengths.shape}")
    _check_count(lengths.shape[0])
    if len(times.shape) != 1 or len(outputs.shape) != 2 or outputs.shape[:1] != times.shape:
        raise InputError(
            f"with 'lengths', times must be (N,) and outputs (N, O), not {times.shape} and {outputs.shape}"
        )
    counts = [int(length) for length in _read_array(archive, lengths)]
    if min(counts) < 1:
        raise InputError(f"'lengths' must be positive, not {min(counts)}")
    if sum(counts) != times.shape[0]:
        raise InputError(f"lengths add up to {sum(counts)}, but there are {times.shape[0]} samples")
    cuts = np.cumsum(counts)[:-1]
    return Recording(np.split(_read_array(archive, times), cuts), np.split(_read_array(archive, outputs), cuts), names)


def _read_names(archive: zipfile.ZipFile, header: _Header) -> list[str]:
    if header.dtype.kind != "U" or len(header.shape) != 1 or header.info.file_size > _MAX_NAMES_SIZE:
        raise InputError("'names' must be a list of short texts, one for each output")
    names = _read_array(archive, header)
    codes = np.ascontiguousarray(names).view(names.dtype.byteorder.replace("|", "=") + "u4")
    if (codes > sys.maxunicode).any():  # NumPy would not raise a ValueError for them
        raise InputError("'names' holds invalid characters")
    return [str(name) for name in names]


def _read_header(archive: zipfile.ZipFile, key: str) -> _Header:
    """Read the header of one array and check that it matches the array's size, without decompressing the array."""
    info = archive.getinfo(f"{key}.npy")
    if info.flag_bits & 1:
        raise InputError(f"'{key}' is encrypted: save it without a password")
    if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise InputError(f"'{key}' is compressed in a way that NumPy does not write: save it with numpy.savez")
    with archive.open(info) as file:
        shape, dtype = _parse_header(file, key)
        start = file.tell()
    if not all(type(length) is int and length >= 0 for length in shape):
        raise InputError(f"'{key}' claims the shape {brief(shape)}")
    if dtype.hasobject:
        raise InputError(f"'{key}' holds Python objects, which could execute: save it as float64")
    if dtype.kind not in "fiubU":
        raise InputError(f"'{key}' must hold numbers or names, not {brief(dtype)}: save it as float64")
    if info.file_size != start + prod(shape) * dtype.itemsize:
        raise InputError(f"'{key}' claims the shape {shape}, which is not what it holds")
    if not prod(shape):
        raise InputError(f"'{key}' is empty, of shape {shape}")
    return _Header(info, shape, dtype)


def _parse_header(file: Any, key: str) -> tuple[tuple[int, ...], np.dtype]:
    readers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    try:
        reader = readers[np.lib.format.read_magic(file)]
    except (ValueError, KeyError) as error:
        raise InputError(f"'{key}' is not an array") from error
    try:
        shape, _, dtype = reader(file, max_header_size=_MAX_HEADER_SIZE)
    except (ValueError, TypeError, SyntaxError, TokenError, RecursionError, MemoryError) as error:
        raise InputError(f"the header of '{key}' can't be read") from error
    return shape, dtype


def _read_array(archive: zipfile.ZipFile, header: _Header) -> np.ndarray:
    """Read one array; the archive's reader verifies its checksum."""
    with archive.open(header.info) as file:
        return np.lib.format.read_array(file, allow_pickle=False, max_header_size=_MAX_HEADER_SIZE)


def _check_count(count: int) -> None:
    if count > MAX_DEMONSTRATIONS:
        raise InputError(f"there are {count} demonstrations, more than {MAX_DEMONSTRATIONS}: a few are enough")


# --- .csv ---


def _read_csv(data: bytes) -> Recording:
    parse = float if data.isascii() and b"_" not in data else parse_number  # `float` is faster
    rows = csv.reader(_lines(data), strict=True)
    values = array("d")
    try:
        header = [name.strip() for name in next(rows, [])]
        is_numbered = header[:2] == ["demonstration", "time"]
        _check_clock(header, int(is_numbered))
        if repeated := find_repeated(header):
            raise InputError(f"it has two columns {brief(repeated)}: keep only the right one")
        for row in rows:
            if not row:
                continue
            if len(row) != len(header):
                raise InputError(f"line {rows.line_num} has {len(row)} fields, the header has {len(header)}")
            try:
                values.extend(map(parse, row))
            except ValueError as error:
                raise InputError(f"line {rows.line_num} holds something other than numbers: {error}") from error
            if len(values) > MAX_NUMBERS:
                raise InputError(f"it holds more than {MAX_NUMBERS} numbers: thin the samples out")
    except (csv.Error, UnicodeDecodeError) as error:
        raise InputError(f"it is not a table of numbers: {error}") from error
    samples = np.frombuffer(values, dtype=float).reshape(-1, len(header))
    if not data.endswith((b"\n", b"\r")):
        is_last = samples[:, 0] == samples[-1, 0] if is_numbered and len(samples) else slice(None)
        _check_last_value(samples[is_last, -1])
    if not is_numbered:
        return Recording([samples[:, 0]], [samples[:, 1:]], header[1:])
    parts = _split_samples(samples)
    return Recording([part[:, 1] for part in parts], [part[:, 2:] for part in parts], header[2:])


def _check_last_value(values: np.ndarray) -> None:
    """Raise an InputError if the last of the values (N,) of a file without a final line end seems to be truncated.

    Some programs write no final line end. The last number is therefore refused only if its step from the number before
    is more than `MAX_LAST_STEP` times the largest other step.
    """
    with np.errstate(invalid="ignore"):  # a later check refuses NaN and infinite numbers
        steps = np.abs(np.diff(values))
    if len(steps) > 1 and steps[-1] > MAX_LAST_STEP * steps[:-1].max():
        raise InputError(
            f"the last line has no line end, and its last number {values[-1]:g} is far from {values[-2]:g} before it: "
            "restore what is missing, or end the line"
        )


def find_repeated(names: Iterable[str]) -> str:
    """Return the first name that equals an earlier one, or an empty text; empty names are not compared."""
    names = list(names)
    return next((name for number, name in enumerate(names) if name and name in names[:number]), "")


def _check_clock(header: list[str], column: int) -> None:
    """Raise an InputError if `column` of a header is not a clock in seconds, or if no output follows the clock."""
    clock = _TIME.fullmatch(header[column]) if len(header) >= 2 + column else None
    if clock is None:
        raise InputError("the first line must be demonstration,time,<outputs> or time,<outputs>")
    if clock["unit"] is not None and clock["unit"].strip("[(/)] ").lower() not in SECONDS:
        raise InputError(
            f"time is in seconds, and the first line has {brief(header[column])}: convert it, or let guiderail "
            "dataset import do so where the outputs are poses"
        )


def _lines(data: bytes) -> Iterator[str]:
    for number, line in enumerate(io.TextIOWrapper(io.BytesIO(data), encoding="utf-8-sig", newline="")):
        if number > MAX_LINES:
            raise InputError(f"it has more than {MAX_LINES} lines: thin the samples out")
        if len(line) > _MAX_LINE_LENGTH:
            raise InputError(f"a line is longer than {_MAX_LINE_LENGTH} characters")
        yield line


def _split_samples(samples: np.ndarray) -> list[np.ndarray]:
    """Split samples by the number of the demonstration in their first column."""
    labels = samples[:, 0]
    if not (np.isfinite(labels).all() and (labels == np.round(labels)).all() and (np.abs(labels) < 2**53).all()):
        raise InputError("the column 'demonstration' must hold whole numbers")
    unique, counts = np.unique(labels, return_counts=True)
    _check_count(len(unique))
    if not len(unique):
        raise InputError("there is no demonstration: give at least one")
    return np.split(samples[np.argsort(labels, kind="stable")], np.cumsum(counts)[:-1])


def _read_folder(folder: Path) -> Recording:
    """Read every `.csv` file of a folder in the order of the names, in which numbers are sorted by value."""
    times: list[np.ndarray] = []
    outputs: list[np.ndarray] = []
    names: Sequence[str] | None = None
    remaining_size, num_samples = MAX_FILE_SIZE, 0
    for file in _list_csv_files(folder):
        if file.is_file() and file.stat().st_size > remaining_size:
            raise InputError(
                f"the files of the folder '{folder}' have more than {MAX_FILE_SIZE} bytes: thin the samples out"
            )
        recording = _read_file(file, remaining_size)
        remaining_size -= file.stat().st_size
        num_samples += sum(len(t) for t in recording.times)
        if num_samples > MAX_LINES:
            raise InputError(f"the folder '{folder}' holds more than {MAX_LINES} samples: thin them out")
        names = recording.names if names is None else names
        if recording.names != names:
            raise InputError(f"'{file}' has other columns than the first file: record the same outputs in all of them")
        times += recording.times
        outputs += recording.outputs
    if len(times) > MAX_DEMONSTRATIONS:
        raise InputError(f"the folder '{folder}' holds {len(times)} demonstrations: {MAX_DEMONSTRATIONS} are enough")
    return Recording(times, outputs, names)


def _list_csv_files(folder: Path) -> list[Path]:
    files: list[Path] = []
    with os.scandir(folder) as entries:
        for entry in entries:
            if entry.name.endswith(".csv") and not entry.name.startswith("."):
                files.append(Path(entry.path))
            if len(files) > MAX_DEMONSTRATIONS:
                raise InputError(f"the folder '{folder}' holds more than {MAX_DEMONSTRATIONS} files: a few are enough")
    if not files:
        raise InputError(f"there is no .csv file in the folder '{folder}': put one there for each demonstration")
    return in_order(files)
