"""Readers of demonstration files return a result or raise an error in bounded time and memory."""

import io
import os
import struct
import tracemalloc
import zipfile

import numpy as np
import pytest

from guiderail.models.common.errors import InputError
from guiderail.models.primitives import Demonstrations

T = np.linspace(0.0, 1.0, 4)
Y = np.column_stack([np.sin(T), T**2])


def npy(description, shape, data=b"", version=b"\x01\x00", fortran_order=False):
    """Return the bytes of an array in NumPy's format, with a header that need not match the data."""
    header = f"{{'descr': {description!r}, 'fortran_order': {fortran_order}, 'shape': {shape}, }}".encode() + b"\n"
    size = struct.pack("<H" if version == b"\x01\x00" else "<L", len(header))
    return b"\x93NUMPY" + version + size + header + data


def archive(path, compression=zipfile.ZIP_DEFLATED, **members):
    """Write an NPZ archive with the bytes of its members; return its path."""
    with zipfile.ZipFile(path, "w", compression) as file:
        for key, value in members.items():
            file.writestr(f"{key}.npy", value)
    return path


def load_error(path):
    """Return the error message of a refused file; check that reading needs less than 100 MB."""
    tracemalloc.start()
    with pytest.raises(InputError) as error:
        Demonstrations.load(path)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    message = str(error.value)
    assert peak < 100e6
    assert path.name in message
    assert "\n" not in message
    assert len(message) < 400
    return message


GOOD = {"times": npy("<f8", (4,), T.tobytes()), "outputs": npy("<f8", (1, 4, 2), Y.tobytes())}


@pytest.mark.parametrize(
    ("members", "message"),
    [
        ({"outputs": npy("<f8", "(1, 4, 9223372036854775807)", Y.tobytes())}, "claims the shape"),
        ({"outputs": npy("<f8", "(1, 4, 2, -1)", Y.tobytes())}, "claims the shape"),
        ({"outputs": npy("<f8", "(1, 4, 3)", Y.tobytes())}, "not what it holds"),
        ({"outputs": npy("<f8", "(1, 4, 1)", Y.tobytes())}, "not what it holds"),
        ({"outputs": npy("<f8", "(1000000000, 0, 2)")}, "empty"),
        ({"outputs": npy("<f8", "(1, 4.0, 2)", Y.tobytes())}, "header of 'outputs'"),
        ({"outputs": npy("<f8", "(1, True, 8)", Y.tobytes())}, "claims the shape"),
        ({"outputs": npy("<f8", "8", Y.tobytes())}, "header of 'outputs'"),
        ({"outputs": npy("<f8", "(" * 300, Y.tobytes())}, "header of 'outputs'"),
        ({"outputs": npy("<f8", "(1, 4, 2), 'shape': __import__('os')", Y.tobytes())}, "header of 'outputs'"),
        ({"outputs": npy("<f8", "(1, 4, 2)" + " " * 2000, Y.tobytes())}, "header of 'outputs'"),
        ({"outputs": npy("<f8", (1, 4, 2), Y.tobytes(), version=b"\x09\x00")}, "not an array"),
        ({"outputs": b"\x93NUMPY"}, "not an array"),
        ({"outputs": b""}, "not an array"),
        ({"outputs": npy("<c16", (1, 4, 1), Y.tobytes())}, "must hold numbers"),
        ({"outputs": npy("|O", (1, 4, 2), b"cos\nsystem\n(S'true'\ntR.")}, "Python objects"),
        ({"outputs": npy([("x", "<f8")], (1, 4, 2), Y.tobytes())}, "must hold numbers"),
        ({"outputs": npy("<M8[s]", (1, 4, 2), Y.tobytes())}, "must hold numbers"),
        ({"outputs": npy("<U2", (1, 4, 2), Y.tobytes())}, "must hold numbers"),
        ({"outputs": npy("<f8", (4, 2), Y.tobytes())}, "must be (M, N, O)"),
        ({"times": npy("<f8", (), T[:1].tobytes())}, "times (N,)"),
        ({"times": npy("<i8", (4,), np.array([0, 1, 2, 2**53 + 1]).tobytes())}, "2^53"),
        ({"times": npy("<f8", (2, 2), T.tobytes())}, "times (N,)"),
        ({"names": npy("<f8", (2,), T[:2].tobytes())}, "names"),
        ({"names": npy("<U1", (), "x".encode("utf-32-le"))}, "names"),
        ({"names": npy("<U1", (2,), b"\xff" * 8)}, "characters"),
        ({"names": npy("<U1", (2,), "\n\n".encode("utf-32-le"))}, "can't be named"),
        ({"names": npy("<U1", (3,), "abc".encode("utf-32-le"))}, "3 names for 2 outputs"),
    ],
)
def test_npz_reader_refuses_invalid_arrays(tmp_path, members, message):
    assert message in load_error(archive(tmp_path / "d.npz", **{**GOOD, **members}))


def test_npz_reader_accepts_the_valid_archive(tmp_path):
    loaded = Demonstrations.load(archive(tmp_path / "d.npz", **GOOD))
    np.testing.assert_array_equal(loaded.outputs[0], Y)


@pytest.mark.parametrize(
    ("lengths", "message"),
    [
        ([-2, 6], "positive, not -2"),
        ([0, 4], "positive, not 0"),
        ([2.0, 2.0], "whole numbers"),
        ([[2, 2]], "whole numbers"),
        (4, "whole numbers"),
        ([True, True], "whole numbers"),
        ([2**63 - 1, 2**63 - 1, 6], "add up to"),
        ([2, 3], "add up to 5, but there are 4"),
        ([1, 3], "1 point"),
        ([], "empty"),
        (np.full(1001, 2), "more than 1000"),
    ],
)
def test_npz_reader_refuses_invalid_lengths(tmp_path, lengths, message):
    path = tmp_path / "d.npz"
    np.savez(path, lengths=np.asarray(lengths), times=np.r_[T[:2], T[:2]], outputs=Y)
    assert message in load_error(path)


def test_npz_reader_refuses_large_arrays_before_unpacking(tmp_path):
    path = tmp_path / "d.npz"
    np.savez_compressed(path, times=np.arange(2000.0), outputs=np.zeros((1, 2000, 2000)))
    assert path.stat().st_size < 100_000
    assert "more than 2000000" in load_error(path)


def test_npz_reader_accepts_other_arrays_but_not_thousands(tmp_path):
    path = archive(tmp_path / "d.npz", **GOOD, force=npy("|O", (), b"x"))
    assert Demonstrations.load(path).num_outputs == 2
    path = archive(tmp_path / "e.npz", **GOOD, **{f"a{i}": b"" for i in range(3000)})
    assert "too many arrays" in load_error(path)


def test_npz_reader_refuses_many_demonstrations_before_splitting(tmp_path):
    path = tmp_path / "d.npz"
    np.savez(path, times=T, outputs=np.zeros((200_000, 4, 1)))
    assert "200000 demonstrations" in load_error(path)
    uneven = [2] * 900 + [10_000]
    np.savez(
        path, lengths=uneven, times=np.concatenate([np.arange(float(n)) for n in uneven]), outputs=np.ones((11_800, 1))
    )
    assert "far more samples than the others" in load_error(path)


def test_npz_reader_refuses_archives_not_written_by_numpy(tmp_path):
    renamed = tmp_path / "renamed.npz"
    buffer = io.BytesIO()
    np.save(buffer, Y)
    renamed.write_bytes(buffer.getvalue())
    assert "single array" in load_error(renamed)

    good = archive(tmp_path / "good.npz", **GOOD).read_bytes()
    encrypted = tmp_path / "encrypted.npz"
    flags = bytearray(good)
    for at in range(len(good) - 8):
        if good[at : at + 4] == b"PK\x01\x02":
            flags[at + 8] |= 1
        if good[at : at + 4] == b"PK\x03\x04":
            flags[at + 6] |= 1
    encrypted.write_bytes(flags)
    assert "encrypted" in load_error(encrypted)

    for compression in (zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA):
        path = archive(tmp_path / "packed.npz", compression, **GOOD)
        assert "compressed in a way" in load_error(path)

    twice = tmp_path / "twice.npz"
    with zipfile.ZipFile(twice, "w") as file:
        for key in ("times.npy", "outputs.npy", "outputs_npy"):
            file.writestr(key, GOOD[key[:-4]])
    twice.write_bytes(twice.read_bytes().replace(b"outputs_npy", b"outputs.npy"))
    assert "two arrays" in load_error(twice)

    for content in (b"", b"demonstration,time,x\n", good[:200]):
        (tmp_path / "damaged.npz").write_bytes(content)
        assert "damaged" in load_error(tmp_path / "damaged.npz")


def test_npz_reader_detects_a_flipped_bit_anywhere(tmp_path):
    """Flip one bit in every byte of an archive: if the archive still loads, the content is unchanged."""
    good = archive(tmp_path / "good.npz", **GOOD).read_bytes()
    path = tmp_path / "d.npz"
    loaded = 0
    for at in range(len(good)):
        path.write_bytes(good[:at] + bytes([good[at] ^ (1 << at % 8)]) + good[at + 1 :])
        try:
            demonstrations = Demonstrations.load(path)
        except InputError:
            continue
        loaded += 1
        np.testing.assert_array_equal(demonstrations.times[0], T)
        np.testing.assert_array_equal(demonstrations.outputs[0], Y)
    assert loaded < len(good) / 3


@pytest.mark.parametrize("kind", ["<f4", ">f8", "<f2", "<i4", "|u1", "|b1", ">i8"])
def test_npz_reader_reads_every_numeric_type(tmp_path, kind):
    values = np.array([[[0, 1], [1, 0], [1, 1]]]).astype(kind)
    path = tmp_path / "d.npz"
    np.savez(path, times=np.arange(3, dtype=np.int64), outputs=np.asfortranarray(values))
    loaded = Demonstrations.load(path)
    assert loaded.outputs[0].dtype == float
    np.testing.assert_array_equal(loaded.outputs[0], [[0, 1], [1, 0], [1, 1]])


def test_csv_reader_accepts_the_clock_names_of_other_programs(tmp_path):
    path = tmp_path / "d.csv"
    for clock in ("t", "time", "Time [s]", " timestamp (Sec)", "t/s", "t [ s ]"):
        path.write_text(f"{clock},x,y [m],z\n0,1,2,3\n0.5,4,5,6\n1e0, 7,8,-9.5e-1\n\n", encoding="utf-8-sig")
        loaded = Demonstrations.load(path)
        assert loaded.names == ("x", "y [m]", "z")
        np.testing.assert_array_equal(loaded.times[0], [0, 0.5, 1])
        np.testing.assert_array_equal(loaded.outputs[0], [[1, 2, 3], [4, 5, 6], [7, 8, -0.95]])


@pytest.mark.parametrize("clock", ["t [ms]", "time (us)", "Timestamp/ns", "t [min]", "t []", "t (UTC)"])
def test_csv_reader_refuses_time_in_another_unit(clock, tmp_path):
    (tmp_path / "d.csv").write_text(f"{clock},x\n0,1\n1,2\n")
    message = load_error(tmp_path / "d.csv")
    assert "time is in seconds" in message
    assert clock in message
    assert "guiderail dataset import" in message


def test_folder_is_read_in_the_numeric_order_of_its_files(tmp_path):
    for m in range(12):
        (tmp_path / f"demo_{m}.csv").write_text(f"t,x\n0,{m}\n1,{m + 1}\n2,{m}\n")
    (tmp_path / "notes.txt").write_text("not read")
    (tmp_path / "._demo_1.csv").write_bytes(b"\x00\x05")
    loaded = Demonstrations.load(tmp_path)
    assert [y[0, 0] for y in loaded.outputs] == list(range(12))
    (tmp_path / "demo_5.csv").write_text("t,y\n0,1\n1,1\n")
    assert "demo_5.csv" in load_error(tmp_path)
    (tmp_path / "demo_5.csv").unlink()
    (tmp_path / "demo_5.csv").symlink_to(tmp_path)
    assert "demonstration file" in load_error(tmp_path)


def test_folder_with_no_or_too_many_files_is_refused(tmp_path):
    assert "no .csv file" in load_error(tmp_path)
    for m in range(1001):
        (tmp_path / f"{m}.csv").touch()
    assert "more than 1000" in load_error(tmp_path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "first line"),
        ("\n", "first line"),
        ("0,1,2\n1,1,2\n", "first line"),
        ("t\n0\n1\n", "first line"),
        ("demonstration,time\n0,0\n", "first line"),
        ("demonstration,time,x\n", "at least one"),
        ("t,x\n", "0 point"),
        ("t,x\n0,1\n", "1 point"),
        ("t,x\n0,1\n1\n", "line 3 has 1 fields"),
        ("t,x,y,x\n0,1,2,3\n1,1,2,3\n", "two columns 'x'"),
        ("t,x,t\n0,1,2\n1,1,2\n", "two columns 't'"),
        ("demonstration,time,x,time\n0,0,1,2\n0,1,1,2\n", "two columns 'time'"),
        ("t,x\n0,1\n1,one\n", "line 3"),
        ("t,x\n0,1\n1,1_0\n", "line 3"),
        ("t,x\n0,1\n1,١\n", "line 3"),
        ("t,x\n0,1\n1,nan\n", "NaN"),
        ("t,x\n0,1\n1,1e999\n", "infinity"),
        ("t,x\n0,1\n1,0x10\n", "line 3"),
        ("demonstration,time,x\nnan,0,1\nnan,1,1\n", "whole numbers"),
        ("demonstration,time,x\n0.5,0,1\n0.5,1,1\n", "whole numbers"),
        ("demonstration,time,x\n9007199254740993,0,1\n9007199254740992,1,1\n", "whole numbers"),
        ("demonstration,time,x\n" + "".join(f"{m},0,1\n{m},1,1\n" for m in range(1001)), "more than 1000"),
        ("t,x\n0," + "1" * 140_000, "longer than"),
        ("t,x\n" + "," * 200_000, "longer than"),
        ('t,x\n0,"' + "\n" * 200_000, "field limit"),
        ('t,x\n0,1\n"1"5,1\n', "not a table"),
        ("t,x\x00y\n0,1\n1,2\n", "can't be named"),
        ('t,"x\ny"\n0,1\n1,2\n', "can't be named"),
        ("t,x\n" + "\n" * 400_001, "more than 400000 lines"),
    ],
)
def test_csv_reader_refuses_invalid_tables(tmp_path, text, message):
    path = tmp_path / "d.csv"
    path.write_text(text, encoding="utf-8")
    assert message in load_error(path)


def test_csv_reader_refuses_invalid_utf8(tmp_path):
    (tmp_path / "d.csv").write_bytes(b"t,x\n0,\xff\n")
    assert "not a table" in load_error(tmp_path / "d.csv")


def test_read_refuses_pipes_and_devices(tmp_path):
    os.mkfifo(tmp_path / "pipe.csv")
    assert "no demonstration file" in load_error(tmp_path / "pipe.csv")
    os.symlink("/dev/zero", tmp_path / "zero.npz")
    assert "no demonstration file" in load_error(tmp_path / "zero.npz")
    assert "no demonstration file" in load_error(tmp_path / "missing.npz")
    (tmp_path / "d.txt").touch()
    assert "ending" in load_error(tmp_path / "d.txt")
    with pytest.raises(InputError):
        Demonstrations.load("x" * 5000 + ".npz")
    with pytest.raises(InputError):
        Demonstrations.load("a\0b.csv")


def test_csv_reader_groups_rows_by_demonstration(tmp_path):
    (tmp_path / "d.csv").write_text("demonstration,time,x\n7,0,1\n-3,0,5\n7,1,2\n-3,1,6\n7,2,3\n")
    loaded = Demonstrations.load(tmp_path / "d.csv")
    assert [y.ravel().tolist() for y in loaded.outputs] == [[5, 6], [1, 2, 3]]


def test_folder_is_named_when_its_files_are_too_large(tmp_path, monkeypatch):
    for name in ("a", "b"):
        (tmp_path / f"{name}.csv").write_text("time,x\n0,0\n1,1\n")
    monkeypatch.setattr("guiderail.models.primitives.io.MAX_FILE_SIZE", 25)
    assert load_error(tmp_path) == f"the files of the folder '{tmp_path}' have more than 25 bytes: thin the samples out"


@pytest.mark.parametrize(("header", "number"), [("t,x", ""), ("demonstration,time,x", "7,")])
@pytest.mark.parametrize("end", ["", "\n"])
def test_truncated_last_number_is_refused_without_a_line_end(tmp_path, header, number, end):
    rows = [f"{number}{0.1 * n},{0.7 + 0.01 * n}" for n in range(6)]
    (tmp_path / "whole.csv").write_text("\n".join([header, *rows]) + end)
    assert Demonstrations.load(tmp_path / "whole.csv").num_demonstrations == 1
    (tmp_path / "cut.csv").write_text("\n".join([header, *rows, f"{number}0.6,0."]) + end)
    if end:
        assert Demonstrations.load(tmp_path / "cut.csv").outputs[0][-1] == 0.0
        return
    with pytest.raises(InputError, match=r"no line end, and its last number 0 is far from 0\.75 before it"):
        Demonstrations.load(tmp_path / "cut.csv")
