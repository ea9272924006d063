"""Random and mutated files of demonstrations: each is read exactly, or refused with one sentence.

`python -m pytest tests/harness/fuzz --hypothesis-profile=long` tries thousands of inputs and prints their outcomes.
"""

import io
import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from fuzz.changes import bit_flips, edited, edits, flipped
from fuzz.tally import attempt, few_inputs
from guiderail.models.common.errors import InputError
from guiderail.models.primitives import Demonstrations
from guiderail.models.primitives.demonstrations import MAX_MAGNITUDE
from oracles.files import csv_demonstrations, npz_demonstrations

FLOATS = st.floats(-MAX_MAGNITUDE, MAX_MAGNITUDE)
NAMES = st.text(st.characters(codec="utf-8", exclude_categories=("Cs", "Cc")), max_size=12).filter(
    lambda name: name.isprintable() and name == name.strip()
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("fuzz")


@st.composite
def demonstrations(draw):
    """Draw demonstrations with finite values and any names."""
    outputs = draw(st.integers(1, 4))
    times, values = [], []
    for _ in range(draw(st.integers(1, 4))):
        instants = sorted(draw(st.sets(FLOATS, min_size=2, max_size=8)))
        times.append(instants)
        values.append(draw(hnp.arrays(float, (len(instants), outputs), elements=FLOATS)))
    names = draw(st.lists(NAMES, min_size=outputs, max_size=outputs, unique_by=lambda name: name or object()))
    return Demonstrations(times, values, names)


def assert_equal(loaded: Demonstrations, parts) -> None:
    """Assert that demonstrations equal the given pairs of times and outputs."""
    assert loaded.num_demonstrations == len(parts)
    for t, y, (expected_t, expected_y) in zip(loaded.times, loaded.outputs, parts, strict=True):
        np.testing.assert_array_equal(t, expected_t)
        np.testing.assert_array_equal(y, expected_y)


def assert_exact_or_refused(target: str, path: Path, read) -> None:
    """Assert that a file is refused, or loaded with the values that the independent reader `read` finds."""
    loaded = attempt(target, InputError, lambda: Demonstrations.load(path))
    if loaded is not None:
        assert_equal(loaded, read(path))


@pytest.mark.parametrize("ending", ["npz", "csv"])
@few_inputs
@given(demonstrations())
def test_demonstrations_round_trip_is_bit_exact(folder, ending, saved):
    path = folder / f"round.{ending}"
    saved.save(path)
    loaded = attempt(f"{ending}, round trip", (), lambda: Demonstrations.load(path))
    assert loaded.names == saved.names
    assert_equal(loaded, list(zip(saved.times, saved.outputs, strict=True)))
    for a, b in zip(loaded.outputs, saved.outputs, strict=True):
        np.testing.assert_array_equal(np.signbit(a), np.signbit(b))


KINDS = ["<f8", ">f8", "<f4", "<f2", "<i8", "<u8", "<i4", "|u1", "|b1", "<c16", "<U3", "|S3", "<M8[s]", "|O"]


@st.composite
def members(draw):
    """Draw the arrays of a file: concatenated or stacked demonstrations, with a few replaced or missing arrays."""
    counts = draw(st.lists(st.integers(2, 4), min_size=1, max_size=3))
    width, is_stacked = draw(st.integers(1, 3)), draw(st.booleans())
    if is_stacked:
        counts = [counts[0]] * len(counts)
    times = [draw(st.sampled_from([0.0, 0.1, -3.0])) + np.arange(n) for n in counts]
    values = draw(hnp.arrays(float, (sum(counts), width), elements=st.integers(-3, 9) | FLOATS))
    arrays = {"times": np.concatenate(times), "outputs": values}
    if is_stacked:
        arrays = {"times": np.stack(times), "outputs": values.reshape(len(counts), counts[0], width)}
    else:
        arrays["lengths"] = np.array(counts)
    for _ in range(draw(st.integers(0, 2))):
        key = draw(st.sampled_from(["times", "outputs", "lengths", "names", "other"]))
        shape = np.shape(arrays.get(key, np.zeros(width)))
        if draw(st.integers(0, 3)) == 0:
            shape = draw(hnp.array_shapes(min_dims=0, max_dims=4, min_side=0, max_side=4))
        if draw(st.integers(0, 9)) == 0:
            arrays.pop(key, None)
        else:
            array = draw(hnp.arrays(int, shape, elements=st.integers(-1, 4)))
            array = np.cumsum(array, axis=-1) if key == "times" and array.ndim else array
            arrays[key] = array.astype(draw(st.sampled_from(KINDS)))
    if draw(st.booleans()) and "names" not in arrays:
        arrays["names"] = np.array(draw(st.lists(NAMES, min_size=width, max_size=width)))
    return {key: np.asfortranarray(array) if draw(st.booleans()) else array for key, array in arrays.items()}


@few_inputs
@given(members(), st.booleans())
def test_npz_with_any_arrays_is_exact_or_refused(folder, arrays, compressed):
    path = folder / "arrays.npz"
    (np.savez_compressed if compressed else np.savez)(path, **arrays)
    assert_exact_or_refused("npz, arrays", path, npz_demonstrations)


def archive(compression) -> bytes:
    """Return an .npz file with two demonstrations."""
    buffer = io.BytesIO()
    t = np.linspace(0, 1, 4)
    write = np.savez_compressed if compression else np.savez
    write(buffer, lengths=[4, 4], times=np.r_[t, t], outputs=np.cos(np.arange(16.0)).reshape(8, 2), names=["x", "y"])
    return buffer.getvalue()


ARCHIVES = [archive(False), archive(True)]


@few_inputs
@given(st.sampled_from(ARCHIVES), edits(), bit_flips(4))
def test_npz_with_changed_bytes_is_exact_or_refused(folder, data, changes, flips):
    """Most of these files have a wrong checksum and are refused."""
    path = folder / "bytes.npz"
    path.write_bytes(flipped(edited(data, changes) if len(flips) % 2 else data, flips))
    assert_exact_or_refused("npz, bytes changed", path, npz_demonstrations)


@few_inputs
@given(st.data())
def test_npz_with_changed_members_is_exact_or_refused(folder, data):
    with zipfile.ZipFile(io.BytesIO(ARCHIVES[0])) as file:
        members = {name: file.read(name) for name in file.namelist()}
    for name in data.draw(st.lists(st.sampled_from(sorted(members)), min_size=1, max_size=2)):
        members[name] = edited(members[name], data.draw(edits(2)))
    path = folder / "members.npz"
    with zipfile.ZipFile(path, "w") as file:
        for name, content in members.items():
            file.writestr(name, content)
    assert_exact_or_refused("npz, members changed", path, npz_demonstrations)


DTYPES = st.sampled_from(["<f8", "<f4", "|b1", "<U2", "|O", "<f99", "f8", "=f8", "<i8", "V8", "", "<m8", "<f8,<f8"])
LENGTHS = st.integers(-2, 9) | st.sampled_from([2**31, 2**63 - 1, 2**64, 10**30])
SHAPES = st.sampled_from([[1, 4, 2], [2, 4, 1], [2, 4, 1]]) | st.lists(LENGTHS, max_size=4)


@few_inputs
@given(
    st.sampled_from(["<f8", "<i4", "|u1"]) | DTYPES,
    SHAPES,
    st.booleans(),
    st.binary(min_size=64, max_size=64).map(lambda b: b[::-1] + b[:5]),
    st.sampled_from([64, 32, 8, 63, 69]),
    st.sampled_from([1, 1, 2, 3, 4]),
)
@example("<f8", [10**9, 0, 2], False, b"", 0, 1)
@example("<f8", [1, 4, 99999999999], False, bytes(64), 64, 1)
def test_npz_with_any_header_is_exact_or_refused(folder, kind, shape, fortran_order, content, length, version):
    header = f"{{'descr': {kind!r}, 'fortran_order': {fortran_order}, 'shape': {tuple(shape)}}}\n".encode()
    size = struct.pack("<H" if version == 1 else "<L", len(header))
    t = io.BytesIO()
    np.save(t, np.linspace(0, 1, 4))
    path = folder / "header.npz"
    with zipfile.ZipFile(path, "w") as file:
        file.writestr("times.npy", t.getvalue())
        file.writestr("outputs.npy", b"\x93NUMPY" + bytes([version, 0]) + size + header + content[:length])
    assert_exact_or_refused("npz, headers", path, npz_demonstrations)


FIELDS = st.sampled_from(
    ["0", "1", "2", "3", "-1", "0.5", "1e3", "1e-320", ".5", "5.", "+2", " 1 ", "nan", "inf", "1e999", "", "x", "1_0"]
    + ["0x10", "1,", '"1"', '"1', '1"', "١", "1 2", "9007199254740993", "-0.0", "\x00", "'1'", "1d3", "1\t", "#1"]
)
FIRST_LINES = st.sampled_from(
    [
        "t,x", "t,x,y", "time [s],x", "demonstration,time,x", "demonstration,time,x,y", "", "x,y", '"t","x"', "t;x",
        "T,x,",
    ]
)  # fmt: skip
NUMBERS = st.sampled_from(["0", "1", "-2.5", "1e-3", " 7"])


@few_inputs
@given(
    st.sampled_from(["t,x", "t,x", "time [s],x,y"]) | FIRST_LINES,
    st.lists(st.lists(NUMBERS | NUMBERS | NUMBERS | FIELDS, min_size=1, max_size=2), max_size=4),
    st.sampled_from(["\n", "\r\n"]),
)
def test_csv_with_any_fields_is_exact_or_refused(folder, first, rows, end):
    rows = [[str(number), *row] for number, row in enumerate(rows)]
    path = folder / "fields.csv"
    path.write_text(end.join([first, *(",".join(row) for row in rows), ""]), encoding="utf-8", newline="")
    assert_exact_or_refused("csv, odd fields", path, csv_demonstrations)


@few_inputs
@given(
    st.sampled_from(["t,x", "demonstration,time,x"]),
    st.integers(2, 6),
    st.lists(st.tuples(st.integers(0, 5), st.integers(0, 2), FIELDS | FLOATS.map(repr)), max_size=3),
)
def test_csv_with_few_changed_fields_is_exact_or_refused(folder, first, length, changes):
    width = first.count(",") + 1
    rows = [["0"] * (width - 2) + [str(n), repr(n / 3)] for n in range(length)]
    for row, column, field in changes:
        rows[row % length][column % width] = field
    path = folder / "few.csv"
    path.write_text("\n".join([first, *map(",".join, rows)]), encoding="utf-8", newline="")
    assert_exact_or_refused("csv, a few odd fields", path, csv_demonstrations)


TABLE = b"demonstration,time,x [m],y\n" + b"".join(b"%d,%d,%d.5,-1e-%d\n" % (n // 5, n % 5, n, n) for n in range(10))


@few_inputs
@given(edits(2))
def test_csv_with_changed_bytes_is_exact_or_refused(folder, changes):
    path = folder / "bytes.csv"
    path.write_bytes(edited(TABLE, changes))
    assert_exact_or_refused("csv, bytes changed", path, csv_demonstrations)


SCALARS = (
    st.none() | st.booleans() | st.integers() | st.floats() | st.complex_numbers() | st.text(max_size=3) | st.binary()
)
ANYTHING = st.recursive(
    SCALARS,
    lambda inside: st.lists(inside, max_size=3) | st.tuples(inside) | st.dictionaries(st.text(max_size=2), inside),
    max_leaves=8,
) | hnp.arrays(st.sampled_from([float, complex, int, "U2", "M8[s]"]), hnp.array_shapes(max_side=3))
ROWS = st.sampled_from([[[1], [2]], [[1.0, 2.0], [3.0, 4.0]], np.eye(2), np.array([[1], [True]], dtype=object)])


@few_inputs
@given(
    st.sampled_from([[0, 1], [[0, 1]], [[0, 1], (0.5, 2)], np.arange(2)]) | ANYTHING,
    st.lists(ROWS, min_size=1, max_size=2) | st.lists(ROWS | ANYTHING, max_size=2) | ANYTHING,
    st.none() | st.lists(NAMES, min_size=1, max_size=2) | ANYTHING,
)
def test_demonstrations_of_any_arguments_are_exact_or_refused(times, outputs, names):
    demonstrations = attempt("arguments", InputError, lambda: Demonstrations(times, outputs, names))
    if demonstrations is not None:
        for y, expected_y in zip(demonstrations.outputs, outputs, strict=True):
            assert y.tolist() == [[float(value) for value in row] for row in expected_y]
