"""CSV recordings: units in the names of columns, delimiters, and refused tables."""

import numpy as np
import pytest

from guiderail.models.common.errors import InputError
from guiderail_data.formats.csv_layouts import read_csv_files

CLOCK = 0.01 * np.arange(4)


def write(path, header, *row, clock=CLOCK):
    """Write a table with `row` at every time of `clock`; return its path."""
    path.write_text("\n".join([header, *(",".join(map(str, (t, *row))) for t in clock)]) + "\n")
    return path


@pytest.fixture
def file(tmp_path):
    return tmp_path / "a.csv"


@pytest.mark.parametrize(
    ("header", "unit", "scales"),
    [
        ("t,x_mm,y_mm,z_m", None, (1e-3, 1e-3, 1)),
        ("t,x [cm],y (mm),z_m", None, (1e-2, 1e-3, 1)),
        ("t,x [metres],y [meters],z_mm", None, (1, 1, 1e-3)),
        ("t,x_mm,y_mm,z_mm", "mm", (1e-3, 1e-3, 1e-3)),
        ("t,x_mm,y,z", "mm", (1e-3, 1e-3, 1e-3)),
    ],
)
def test_positions_have_the_unit_of_their_column(header, unit, scales, file):
    result = read_csv_files(write(file, header, 9, 8, 7), unit=unit)
    np.testing.assert_allclose(result.outputs[0][0], np.array([9, 8, 7]) * scales)


def test_angles_have_the_unit_of_their_column(file):
    header = "t,x_m,y_m,z_m,roll_rad,pitch [deg],yaw (degrees)"
    result = read_csv_files(write(file, header, 0, 0, 0, 0.1, 10, 20))
    np.testing.assert_allclose(result.outputs[0][0, 3:], [np.deg2rad(20), np.deg2rad(10), 0.1])


@pytest.mark.parametrize(
    ("header", "options"),
    [
        ("t,x_mm,y_mm,z_mm", {"unit": "m"}),
        ("t,x_mm,y_mm,z_m", {"unit": "m"}),
        ("t,x_mm,y,z", {"unit": "m"}),
        ("t_s,x_m,y_m,z_m", {"time_unit": "ms"}),
        ("t,x_m,y_m,z_m,roll_rad,pitch_deg,yaw_rad", {"angles": "rad"}),
    ],
)
def test_unit_is_refused_when_a_column_contradicts(header, options, file):
    write(file, header, *range(header.count(",")))
    with pytest.raises(InputError, match=f"which contradicts --.* {next(iter(options.values()))}: leave --.* out"):
        read_csv_files(file, **options)


@pytest.mark.parametrize("option", ["unit", "time_unit", "angles"])
def test_unit_is_refused_when_unknown(option, file):
    write(file, "t,x_m,y_m,z_m,roll_rad,pitch_rad,yaw_rad", *range(6))
    with pytest.raises(InputError, match="is one of"):
        read_csv_files(file, **{option: "furlong"})


def test_unit_of_a_column_is_not_used_for_other_columns(file):
    with pytest.raises(InputError, match="unit of y and z"):
        read_csv_files(write(file, "t,x_mm,y,z", 1, 2, 3))


def test_byte_order_mark_is_not_part_of_the_first_name(file):
    text = write(file, "t,x_m,y_m,z_m", 1, 2, 3).read_text()
    file.write_text(text, encoding="utf-8-sig")  # the encoding of Excel
    np.testing.assert_allclose(read_csv_files(file).times[0], CLOCK)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "not a table of numbers"),
        ("t,x_m,y_m,z_m\n", "fewer than two lines"),
        ("t,x_m,y_m,z_m\n0,1,2,3\n", "fewer than two lines"),
    ],
)
def test_table_is_refused_with_fewer_than_two_samples(text, message, file):
    file.write_text(text)
    with pytest.raises(InputError, match=message):
        read_csv_files(file, time_unit="s")


@pytest.mark.parametrize("length", ["nan", 3])
def test_quaternion_is_refused_when_its_length_is_not_one(length, file):
    write(file, "t,x_m,y_m,z_m,qx,qy,qz,qw", 0, 0, 0, 0, 0, 0, length)
    with pytest.raises(InputError, match=rf"length {length} at sample 0.*cut such samples out"):
        read_csv_files(file)


@pytest.mark.parametrize("number", ["1_0", "\u0661", "\uff11"])
def test_number_is_refused_when_valid_only_in_python(number, file):
    with pytest.raises(InputError, match="not a table of numbers"):
        read_csv_files(write(file, "t,x_m,y_m,z_m", 0, number, 2))


def test_hidden_file_in_a_folder_is_not_read(file):
    write(file, "t,x_m,y_m,z_m", 0, 1, 2)
    file.with_name("._a.csv").write_bytes(b"\x00\x05\x16\x07")
    assert len(read_csv_files(file.parent).times) == 1
    file.with_name("b.csv").mkdir()
    with pytest.raises(InputError, match=r"b\.csv is a folder with the name of a file"):
        read_csv_files(file.parent)


@pytest.mark.parametrize("row", ["0,0,0,3,5", "0,0,0,3,", "0,0,0"])
def test_line_is_refused_when_its_number_of_fields_differs(row, file):
    file.write_text(f"t,x,y,z\n{row}\n" + 3 * "0.1,1,2,3\n")
    with pytest.raises(InputError, match=f"line 2 has {row.count(',') + 1} fields, the header has 4"):
        read_csv_files(file, unit="m")


@pytest.mark.parametrize("delimiter", [",", ", ", ";", "\t", " "])
def test_delimiter_is_detected(delimiter, file):
    lines = [("t", "x_m", "y_m", "z_m", "note"), *((0.1 * n, 1, 2, 3, 4 if delimiter == " " else "") for n in range(3))]
    file.write_text("\n\n".join(delimiter.join(map(str, line)) for line in lines))
    np.testing.assert_array_equal(read_csv_files(file).outputs[0], [[1, 2, 3]] * 3)


@pytest.mark.parametrize(
    ("header", "names"),
    [
        ("t,x [m],y [m],z [m],x [mm]", r"x \[m\] and x \[mm\], and does not state which of them is x"),
        ("t,x (cmd) [m],y [m],z [m],x [m]", r"x \(cmd\) \[m\] and x \[m\]"),
        ("t,x_m,y_m,z_m,y [m]", r"y_m and y \[m\]"),
        ("t,x_m,y_m,z_m,z_m", "z_m and z_m"),
        ("t,time,x_m,y_m,z_m", "t and time, and does not state which of them is time"),
        ("t,is.x_m,is.y_m,is.z_m,set.x_m,set.y_m,set.z_m", "is.x_m and set.x_m"),
        ("t,x_m,y_m,z_m,qx,qx,qy,qz,qw", "qx and qx"),
        ("t,x_m,y_m,z_m,q1,q2,q3,q4,q4", "q4 and q4"),
        ("t,x_m,y_m,z_m,force,force", "force and force"),
    ],
)
def test_ambiguous_columns_are_named_in_the_message(header, names, file):
    write(file, header, *range(header.count(",")))
    with pytest.raises(InputError, match=names):
        read_csv_files(file)


@pytest.mark.parametrize(
    ("header", "options", "message"),
    [
        ("time [min],x_m,y_m,z_m", {}, r"time \[min\], whose unit is not one of s, ms, us, ns"),
        ("t,x [in],y [in],z [in]", {}, r"x \[in\], whose unit is not one of m, cm, mm"),
        ("t,x [in],y [in],z [in]", {"unit": "m"}, r"x \[in\], whose unit is not one of"),
        ("t,x [m],y (foo),z [m]", {}, r"y \(foo\), whose unit is not one of"),
        ("t,x_m,y_m,z_m,roll [gon],pitch [deg],yaw [deg]", {}, r"roll \[gon\], whose unit is not one of deg, rad"),
    ],
)
def test_unknown_unit_in_a_column_name_is_refused(header, options, message, file):
    write(file, header, *range(header.count(",")))
    with pytest.raises(InputError, match=message):
        read_csv_files(file, **options)


@pytest.mark.parametrize(
    ("unit", "scale"), [("µs", 1e-6), ("\u03bcs", 1e-6), ("us", 1e-6), ("sec", 1), ("Seconds", 1), ("MS", 1e-3)]
)
def test_spelling_of_a_unit_is_recognized(unit, scale, file):
    write(file, f"t [{unit}],x [meters],y (M),Z [m] (raw)", 1, 2, 3)
    result = read_csv_files(file)
    np.testing.assert_allclose(result.times[0], CLOCK * scale)
    np.testing.assert_array_equal(result.outputs[0][0], [1, 2, 3])


@pytest.mark.parametrize("option", ["unit", "time_unit", "quaternion", "angles"])
def test_option_is_validated_when_unused(option, file):
    write(file, "t [s],x_m,y_m,z_m", 1, 2, 3)
    with pytest.raises(InputError, match=rf"--{option.replace('_', '-')} is one of .*, not 'foo'"):
        read_csv_files(file, **{option: "foo"})


@pytest.mark.parametrize("header", ["t,x_m,y_m,z_m", "t [s],x_m,y_m,z_m"])
def test_time_that_does_not_increase_is_refused(header, file):
    for clock, message in ((-CLOCK, "decreases at sample 1"), (0 * CLOCK, "does not increase")):
        with pytest.raises(InputError, match=f"the time column {header.split(',')[0][0]}.*{message}"):
            read_csv_files(write(file, header, 1, 2, 3, clock=clock))


def test_duplicated_samples_do_not_change_the_time_unit(file):
    result = read_csv_files(write(file, "t,x_m,y_m,z_m", 1, 2, 3, clock=np.repeat(CLOCK, 2)))
    assert "t is in seconds, 100 samples in each" in result.assumptions


@pytest.mark.parametrize("prefix", ["v.", "vel_", "tcp_velocity_", "twist.linear.", "wrench.force."])
def test_velocity_and_force_columns_are_not_positions(prefix, file):
    columns = ",".join(prefix + axis for axis in "xyz")
    result = read_csv_files(write(file, f"t,pos_x_mm,pos_y_mm,pos_z_mm,{columns}", 1, 2, 3, 4, 5, 6))
    np.testing.assert_allclose(result.outputs[0][0], [1e-3, 2e-3, 3e-3])
    with pytest.raises(InputError, match="no columns x, y and z"):
        read_csv_files(write(file, f"t,{columns}", 4, 5, 6), unit="m")


def test_unused_columns_are_listed_as_left_out(file):
    result = read_csv_files(write(file, "t [s],x_m,y_m,z_m,rx,ry,rz", *range(6)))
    assert result.assumptions == ["there is no orientation", "rx, ry and rz are left out"]
    many = ",".join(f"f{n}" for n in range(20))
    result = read_csv_files(write(file, f"t [s],x_m,y_m,z_m,roll_rad,pitch_rad,yaw_rad,{many}", *range(26)))
    assert result.assumptions[-1] == "f0, f1, f2, f3, f4, f5, f6, f7 and 12 more are left out"
    result = read_csv_files(write(file, "t [s],x_m,y_m,z_m,force", *range(4)))
    assert result.assumptions[-1] == "force is left out"
