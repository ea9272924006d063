"""CSV recordings: units in the names of columns, delimiters, and refused tables."""

import re
from itertools import permutations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

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


def test_error_names_every_missing_unit_at_once(file):
    file.write_text("t,x,y,z,roll,pitch,yaw\n0,1,2,3,0,0,0\n0.1,1,2,3,0,0,0\n")
    with pytest.raises(
        InputError, match="nor whether roll is in degrees: give --unit m or mm, and --angles deg or rad"
    ):
        read_csv_files(file)


@pytest.mark.parametrize("delimiter", [",", ", ", ";", "\t", " "])
def test_delimiter_is_detected(delimiter, file):
    lines = [("t", "x_m", "y_m", "z_m", "note"), *((0.1 * n, 1, 2, 3, 4 if delimiter == " " else "") for n in range(3))]
    file.write_text("\n\n".join(delimiter.join(map(str, line)) for line in lines))
    np.testing.assert_array_equal(read_csv_files(file).outputs[0], [[1, 2, 3]] * 3)


@pytest.mark.parametrize(
    ("header", "options", "message"),
    [
        # a column that contradicts an option
        ("t,x_mm,y_mm,z_mm", {"unit": "m"}, "which contradicts --.* m: leave --.* out"),
        ("t,x_mm,y_mm,z_m", {"unit": "m"}, "which contradicts --.* m: leave --.* out"),
        ("t,x_mm,y,z", {"unit": "m"}, "which contradicts --.* m: leave --.* out"),
        ("t_s,x_m,y_m,z_m", {"time_unit": "ms"}, "which contradicts --.* ms: leave --.* out"),
        ("t,x_m,y_m,z_m,roll_rad,pitch_deg,yaw_rad", {"angles": "rad"}, "which contradicts --.* rad: leave --.* out"),
        # columns of which the reader cannot choose one
        ("t,x [m],y [m],z [m],x [mm]", {}, r"x \[m\] and x \[mm\], and does not state which of them is x"),
        ("t,x (cmd) [m],y [m],z [m],x [m]", {}, r"x \(cmd\) \[m\] and x \[m\]"),
        ("t,x_m,y_m,z_m,y [m]", {}, r"y_m and y \[m\]"),
        ("t,x_m,y_m,z_m,z_m", {}, "z_m and z_m"),
        ("t,time,x_m,y_m,z_m", {}, "t and time, and does not state which of them is time"),
        ("t,is.x_m,is.y_m,is.z_m,set.x_m,set.y_m,set.z_m", {}, "is.x_m and set.x_m"),
        ("t,x_m,y_m,z_m,qx,qx,qy,qz,qw", {}, "qx and qx"),
        ("t,x_m,y_m,z_m,q1,q2,q3,q4,q4", {}, "q4 and q4"),
        ("t,x_m,y_m,z_m,force,force", {}, "force and force"),
        # unknown units
        ("time [min],x_m,y_m,z_m", {}, r"time \[min\], whose unit is not one of s, ms, us, ns"),
        ("t,x [in],y [in],z [in]", {}, r"x \[in\], whose unit is not one of m, cm, mm"),
        ("t,x [in],y [in],z [in]", {"unit": "m"}, r"x \[in\], whose unit is not one of"),
        ("t,x [m],y (foo),z [m]", {}, r"y \(foo\), whose unit is not one of"),
        ("t,x_m,y_m,z_m,roll [gon],pitch [deg],yaw [deg]", {}, r"roll \[gon\], whose unit is not one of deg, rad"),
    ],
)
def test_ambiguous_names_and_units_of_columns_are_refused(header, options, message, file):
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


@pytest.mark.parametrize("header", ["t [s],x_m,y_m,z_m", "t,x_m,y_m,z_m,roll_rad,pitch_rad,yaw_rad"])
@pytest.mark.parametrize("option", ["unit", "time_unit", "quaternion", "angles"])
def test_option_is_validated_also_when_unused(option, header, file):
    write(file, header, *range(header.count(",")))
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
    result = read_csv_files(write(file, "t [s],x_m,y_m,z_m,a,b", *range(5)))
    assert result.assumptions == ["there is no orientation", "a and b are left out"]
    many = ",".join(f"f{n}" for n in range(20))
    result = read_csv_files(write(file, f"t [s],x_m,y_m,z_m,roll_rad,pitch_rad,yaw_rad,{many}", *range(26)))
    assert result.assumptions[-1] == "f0, f1, f2, f3, f4, f5, f6, f7 and 12 more are left out"
    result = read_csv_files(write(file, "t [s],x_m,y_m,z_m,force", *range(4)))
    assert result.assumptions[-1] == "force is left out"


def test_columns_of_other_quantities_are_left_out(file):
    result = read_csv_files(write(file, "t [s],x_m,y_m,z_m,fx,fy,fz,gripper_width", *range(7)))
    assert result.assumptions == ["there is no orientation", "fx, fy, fz and gripper_width are left out"]


TRUE = Rotation.from_euler("ZYX", [0.4, -0.3, 0.2])
POSITION = (0.5, -0.1, 0.3)  # [m]
QUATERNIONS = [
    "q{}", "q_{}", "quat_{}", "quaternion.{}", "o{}", "orientation_{}", "orientation.{}", "pose.orientation.{}",
    "pose.pose.orientation.{}", "field.pose.orientation.{}", "/tool/pose/orientation/{}", "transform.rotation.{}",
]  # fmt: skip


@pytest.mark.parametrize("layout", QUATERNIONS)
@pytest.mark.parametrize("scale", [1.0, 1e3])
def test_quaternion_is_read_in_the_order_of_its_names(layout, scale, file):
    unit = "m" if scale == 1.0 else "mm"
    values = dict(zip("xyzw", TRUE.as_quat().tolist(), strict=True))
    for order in permutations("xyzw"):
        header = f"t,x_{unit},y_{unit},z_{unit}," + ",".join(layout.format(axis) for axis in order)
        row = [scale * value for value in POSITION] + [values[axis] for axis in order]
        result = read_csv_files(write(file, header, *row))
        np.testing.assert_allclose(result.outputs[0][0], [*POSITION, 0.4, -0.3, 0.2], atol=1e-12)


@pytest.mark.parametrize("layout", QUATERNIONS)
@pytest.mark.parametrize("missing", "xyzw")
def test_incomplete_quaternion_is_refused_by_name(layout, missing, file):
    names = [layout.format(axis) for axis in "xyzw" if axis != missing]
    write(file, "t,x_m,y_m,z_m," + ",".join(names), *range(6))
    with pytest.raises(InputError, match="not the whole of an orientation") as error:
        read_csv_files(file)
    assert all(name in str(error.value) for name in names)


@pytest.mark.parametrize(
    "names",
    [
        "yaw", "roll,yaw", "heading", "w", "W,P,R", "A,B", "euler_x,euler_y,euler_z", "r11,r12,r13", "phi,theta,psi",
        "quat[0],quat[1]", "axis_angle_x", "angle_deg", "O_T_EE_0",
    ],
)  # fmt: skip
def test_unknown_orientation_is_never_dropped(names, file):
    write(file, f"t,x_m,y_m,z_m,{names}", *range(4 + names.count(",")))
    with pytest.raises(InputError, match=f"has {re.escape(names.split(',')[0])}.* not the whole of an orientation"):
        read_csv_files(file)


@pytest.mark.parametrize(
    ("names", "values"),
    [
        ("rx,ry,rz", TRUE.as_rotvec()),
        ("tcp.rx,tcp.ry,tcp.rz", TRUE.as_rotvec()),
        ("rx [rad],ry [rad],rz [rad]", TRUE.as_rotvec()),
        ("A,B,C", TRUE.as_euler("ZYX", degrees=True)),
        ("A [deg],B [deg],C [deg]", TRUE.as_euler("ZYX", degrees=True)),
        ("A_rad,B_rad,C_rad", TRUE.as_euler("ZYX")),
        ("Rz [deg],Ry [deg],Rx [deg]", TRUE.as_euler("ZYX", degrees=True)),
        ("roll_deg,pitch_deg,yaw_deg", TRUE.as_euler("xyz", degrees=True)),
        ("roll [rad],pitch [rad],yaw [rad]", TRUE.as_euler("xyz")),
    ],
)
@pytest.mark.parametrize(("unit", "scale"), [("m", 1.0), ("cm", 1e2), ("mm", 1e3)])
def test_three_angles_are_read_in_any_order_of_columns(names, values, unit, scale, file):
    pairs = list(zip(names.split(","), values.tolist(), strict=True))
    for order in permutations(pairs):
        header = f"t,X [{unit}],Y [{unit}],Z [{unit}]," + ",".join(name for name, _ in order)
        row = [scale * value for value in POSITION] + [value for _, value in order]
        result = read_csv_files(write(file, header, *row))
        np.testing.assert_allclose(result.outputs[0][0], [*POSITION, 0.4, -0.3, 0.2], atol=1e-12)


ORIENTATION = "has no orientation in a known|not the whole of an orientation"
FIXED_AXES = "name the columns roll, pitch and yaw if they are angles about fixed axes"
TWO_MESSAGES = "a.position.x,a.position.y,a.position.z,b.orientation.x,b.orientation.y,b.orientation.z,b.orientation.w"


@pytest.mark.parametrize(
    ("names", "row", "message"),
    [
        ("x_mm,y,z", (1, 2, 3), "unit of y and z"),  # the unit of a column is not used for others
        *(("x_m,y_m,z_m", (0, number, 2), "not a table of numbers") for number in ("1_0", "\u0661", "\uff11")),
        *(
            ("x_m,y_m,z_m,qx,qy,qz,qw", (*6 * [0], length), rf"length {length} at sample 0.*cut such samples out")
            for length in ("nan", 3)
        ),
        *(
            (f"x_m,y_m,z_m,{names}", range(3 + len(names.split(","))), ORIENTATION)
            for names in ("a,b,c", "h0,h1,h2", "foo_a,foo_b,foo_c,foo_d", "i,j,k,w", "alpha,beta,gamma")
        ),
        ("x_m,y_m,z_m,p,u,v,s,c", (1, 2, 3, 7, *TRUE.as_quat()), "u, v, s and c could be one"),
        *(
            (f"x_m,y_m,z_m,{names}", (0, 0, 0, 90, 0, 0), FIXED_AXES)
            for names in ("rx_deg,ry_deg,rz_deg", "rx [deg],ry [deg],rz [deg]", "rx,ry,rz")
        ),
        (TWO_MESSAGES, (0, 0, 0, 0, 0, 0, 1), r"a\.position\.x and b\.orientation\.x, of two messages"),
    ],
)
def test_columns_that_may_have_another_meaning_are_refused(names, row, message, file):
    with pytest.raises(InputError, match=message):
        read_csv_files(write(file, f"t [s],{names}", *row))


RECORDERS = {  # header and time of a sample of common recorders, each with a pose in meters
    "rostopic echo -p": (
        "%time,field.header.seq,field.header.stamp,field.header.frame_id,field.pose.position.{},field.pose.orientation.{}",
        lambda n: f"{10**18 + n * 10**7},{n},{10**18 + n * 10**7},base",
    ),
    "ros2 topic echo --csv with names": (
        "sec,nanosec,frame_id,pose.position.{},pose.orientation.{}",
        lambda n: f"{1 + n // 100},{n % 100 * 10**7},base",
    ),
    "PlotJuggler": (
        "__time,/tool/header/stamp/sec,/tool/header/stamp/nanosec,/tool/pose/position/{},/tool/pose/orientation/{}",
        lambda n: f"{1.7e9 + 0.01 * n},{1 + n // 100},{n % 100 * 10**7}",
    ),
}


@pytest.mark.parametrize("recorder", RECORDERS)
def test_recorder_of_poses_is_read_without_options(recorder, file):
    header, stamp = RECORDERS[recorder]
    start, position, orientation = header.rsplit(",", 2)
    names = [start, *(position.format(axis) for axis in "xyz"), *(orientation.format(axis) for axis in "xyzw")]
    pose = ",".join(str(value) for value in (*POSITION, *TRUE.as_quat()))
    file.write_text("\n".join([",".join(names), *(f"{stamp(n)},{pose}" for n in range(150))]))
    result = read_csv_files(file)
    np.testing.assert_allclose(np.diff(result.times[0][:99]), 0.01, atol=1e-6)
    np.testing.assert_allclose(result.outputs[0], np.tile([*POSITION, 0.4, -0.3, 0.2], (150, 1)), atol=1e-12)
    assert any("is a field of a ROS message, in meters" in text for text in result.assumptions)


def test_tool_pose_of_rtde_is_read(file):
    header = "timestamp [s]," + ",".join(f"{kind}_{n}" for kind in ("actual_q", "actual_TCP_pose") for n in range(6))
    result = read_csv_files(write(file, header, *range(6), *POSITION, *TRUE.as_rotvec()))
    np.testing.assert_allclose(result.outputs[0][0], [*POSITION, 0.4, -0.3, 0.2], atol=1e-12)
    both = header + "," + ",".join(f"target_TCP_pose_{n}" for n in range(6))
    with pytest.raises(InputError, match="keep the columns of one of them"):
        read_csv_files(write(file, both, *range(18)))


def test_table_without_names_is_refused_with_the_line_to_add(file):
    file.write_text("".join(f"1,{n}0000000,base,0.5,0,0.3,0,0,0,1\n" for n in range(5)))
    with pytest.raises(InputError, match=r"sec,nanosec,frame_id,pose\.position\.x"):
        read_csv_files(file)


@pytest.mark.parametrize("name", ["frame_id", "field.header.frame_id", "header.frame_id", "child_frame_id"])
@pytest.mark.parametrize("is_within", [True, False])
def test_frames_of_files_must_be_equal(name, is_within, file):
    lines = [f"{0.01 * n},{frame},{n},0,0" for n, frame in enumerate(["base"] * 3 + ["world"] * 3)]
    parts = [lines] if is_within else [lines[:3], lines[3:]]
    for number, part in enumerate(parts):
        file.with_name(f"{number}.csv").write_text("\n".join([f"t,{name},x_m,y_m,z_m", *part]))
    with pytest.raises(InputError, match=r"(?s)(base.*world|world.*base)"):
        read_csv_files(file.parent)


def test_lines_without_a_position_are_left_out(file):
    rows = [f"{0.01 * n},{n},0,0,1" if n % 2 else f"{0.01 * n},,,,1" for n in range(8)]
    file.write_text("\n".join(["t,x_m,y_m,z_m,force", *rows]))
    result = read_csv_files(file)
    np.testing.assert_array_equal(result.outputs[0][:, 0], [1, 3, 5, 7])
    assert "4 lines without a position are left out" in result.assumptions
