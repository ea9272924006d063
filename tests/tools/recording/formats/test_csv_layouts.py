"""Every column is in the unit that its own name says; what makes no motion is refused in a sentence."""

import numpy as np
import pytest

from guiderail.models.errors import InputError
from guiderail.tools.recording.formats.csv_layouts import read_csv_files

CLOCK = 0.01 * np.arange(4)


def write(path, header, *row, clock=CLOCK):
    path.write_text("\n".join([header, *(",".join(map(str, (t, *row))) for t in clock)]) + "\n")
    return path


@pytest.fixture
def file(tmp_path):
    return tmp_path / "a.csv"


@pytest.mark.parametrize(
    ("header", "given", "scales"),
    [
        ("t,x_mm,y_mm,z_m", None, (1e-3, 1e-3, 1)),
        ("t,x [cm],y (mm),z_m", None, (1e-2, 1e-3, 1)),
        ("t,x_mm,y_mm,z_mm", "mm", (1e-3, 1e-3, 1e-3)),
        ("t,x_mm,y,z", "mm", (1e-3, 1e-3, 1e-3)),
    ],
)
def test_each_position_is_in_its_own_unit(header, given, scales, file):
    found = read_csv_files(write(file, header, 9, 8, 7), unit=given)
    np.testing.assert_allclose(found.outputs[0][0], np.array([9, 8, 7]) * scales)


def test_each_angle_is_in_its_own_unit(file):
    header = "t,x_m,y_m,z_m,roll_rad,pitch [deg],yaw (degrees)"
    found = read_csv_files(write(file, header, 0, 0, 0, 0.1, 10, 20))
    np.testing.assert_allclose(found.outputs[0][0, 3:], [np.deg2rad(20), np.deg2rad(10), 0.1])


@pytest.mark.parametrize(
    ("header", "given"),
    [
        ("t,x_mm,y_mm,z_mm", {"unit": "m"}),
        ("t,x_mm,y_mm,z_m", {"unit": "m"}),
        ("t,x_mm,y,z", {"unit": "m"}),
        ("t_s,x_m,y_m,z_m", {"time_unit": "ms"}),
        ("t,x_m,y_m,z_m,roll_rad,pitch_deg,yaw_rad", {"angles": "rad"}),
    ],
)
def test_a_unit_that_the_table_contradicts_is_refused(header, given, file):
    write(file, header, *range(header.count(",")))
    with pytest.raises(InputError, match=f"says {next(iter(given.values()))}: leave it out"):
        read_csv_files(file, **given)


@pytest.mark.parametrize("option", ["unit", "time_unit", "angles"])
def test_a_unit_that_there_is_none_of_is_refused(option, file):
    write(file, "t,x_m,y_m,z_m,roll_rad,pitch_rad,yaw_rad", *range(6))
    with pytest.raises(InputError, match="is one of"):
        read_csv_files(file, **{option: "furlong"})


def test_a_unit_that_one_column_says_is_not_that_of_the_others(file):
    with pytest.raises(InputError, match="unit of y and z"):
        read_csv_files(write(file, "t,x_mm,y,z", 1, 2, 3))


def test_a_mark_at_the_beginning_is_no_part_of_the_first_name(file):
    text = write(file, "t,x_m,y_m,z_m", 1, 2, 3).read_text()
    file.write_text(text, encoding="utf-8-sig")  # as Excel writes it
    np.testing.assert_allclose(read_csv_files(file).times[0], CLOCK)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "no table of numbers"),
        ("t,x_m,y_m,z_m\n", "fewer than two lines"),
        ("t,x_m,y_m,z_m\n0,1,2,3\n", "fewer than two lines"),
    ],
)
def test_what_holds_no_motion_is_refused(text, words, file):
    file.write_text(text)
    with pytest.raises(InputError, match=words):
        read_csv_files(file, time_unit="s")


def test_a_quaternion_that_is_no_number_is_refused(file):
    write(file, "t,x_m,y_m,z_m,qx,qy,qz,qw", 0, 0, 0, 0, 0, 0, "nan")
    with pytest.raises(InputError, match=r"length nan at sample 0.*cut such samples out"):
        read_csv_files(file)
