"""Import and export of demonstrations: equal numbers, chosen signals, target frames and refused files."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from guiderail.models.common.errors import InputError
from guiderail.models.primitives import Demonstrations
from guiderail_data.convert import export_demonstrations, import_recording
from guiderail_data.validate import fit_bounds

NAMES = ("x [m]", "y [m]", "z [m]", "Rz [rad]", "Ry [rad]", "Rx [rad]")


def make_demonstrations(count=3, steps=40, period=0.02):
    rng = np.random.default_rng(0)
    times = [period * np.arange(steps + m) for m in range(count)]
    outputs = [0.2 * np.cumsum(rng.standard_normal((len(t), 6)), axis=0) / len(t) for t in times]
    return Demonstrations(times, outputs, NAMES)


@pytest.fixture
def file(tmp_path):
    make_demonstrations().save(tmp_path / "demonstrations.npz")
    return tmp_path / "demonstrations.npz"


@pytest.mark.parametrize(("kind", "tolerance", "library"), [("lerobot", 1e-6, "pyarrow"), ("mcap", 1e-15, "rosbags")])
def test_export_and_import_return_the_demonstrations(kind, tolerance, library, file, tmp_path):
    pytest.importorskip(library)
    export_demonstrations(file, tmp_path / kind, kind)
    signal = "action" if kind == "lerobot" else None
    result = import_recording(tmp_path / kind, tmp_path / "back.npz", signal=signal)
    loaded, expected = Demonstrations.load(tmp_path / "back.npz"), make_demonstrations()
    assert result["demonstrations"] == 3
    assert loaded.names == expected.names
    np.testing.assert_allclose(
        np.concatenate(loaded.times), np.concatenate(expected.times), rtol=0, atol=max(tolerance, 1e-9)
    )
    for values, expected_values in zip(loaded.outputs, expected.outputs, strict=True):
        np.testing.assert_allclose(values, expected_values, rtol=0, atol=tolerance)


def test_lerobot_dataset_has_the_layout_of_version_3(file, tmp_path):
    import pyarrow.parquet as parquet

    export_demonstrations(file, tmp_path / "set", "lerobot")
    info = json.loads((tmp_path / "set/meta/info.json").read_text())
    assert (info["codebase_version"], info["fps"], info["total_episodes"], info["total_frames"]) == ("v3.0", 50, 3, 123)
    table = parquet.read_table(tmp_path / "set/data/chunk-000/file-000.parquet")
    assert set(table.column_names) == set(info["features"])
    episodes = parquet.read_table(tmp_path / "set/meta/episodes/chunk-000/file-000.parquet").to_pydict()
    assert episodes["dataset_from_index"] == [0, 40, 81]
    assert episodes["dataset_to_index"] == [40, 81, 123]
    tasks = parquet.read_table(tmp_path / "set/meta/tasks.parquet").to_pandas()
    assert list(tasks["task_index"]) == [0]


def test_import_reads_the_commanded_feature_by_default(file, tmp_path):
    export_demonstrations(file, tmp_path / "set", "lerobot")
    result = import_recording(tmp_path / "set", tmp_path / "back.csv")
    assert "action is the commanded motion" in result["assumed"]


def test_lerobot_export_requires_a_rate_for_uneven_times(tmp_path):
    t = np.array([0.0, 0.1, 0.3])
    Demonstrations(t, [np.ones((3, 1))]).save(tmp_path / "uneven.npz")
    with pytest.raises(InputError, match="--rate"):
        export_demonstrations(tmp_path / "uneven.npz", tmp_path / "set", "lerobot")
    export_demonstrations(tmp_path / "uneven.npz", tmp_path / "set", "lerobot", rate=10)


# Topic of the pose of the end effector, and its frame, in the ROS packages of two arms.
LAYOUTS = {
    "/franka_robot_state_broadcaster/current_pose": "fr3_link0",  # franka_ros2
    "/iiwa/command/CartesianPose": "iiwa_link_0",  # iiwa_stack
}


def write_bag(path, topics, stamped=True, second_kind=None):
    """Write a bag with five poses on each topic, whose frame is the topic's value in `topics`.

    The time stamps of the messages are 10 ms apart, the times of the recorder 11 ms. With `second_kind`, a second
    publisher of this message type is on each topic.
    """
    from rosbags.rosbag2 import Writer
    from rosbags.typesys import Stores, get_typestore

    store, kind = get_typestore(Stores.ROS2_HUMBLE), "geometry_msgs/msg/PoseStamped"
    types = {name.split("/")[-1]: message_type for name, message_type in store.types.items()}
    with Writer(path, version=8) as writer:
        for topic, frame in topics.items():
            connection = writer.add_connection(topic, kind, typestore=store)
            if second_kind is not None:
                writer.add_connection(topic, second_kind, typestore=store)
            for n in range(5):
                stamp = types["Time"](sec=10 if stamped else 0, nanosec=10_000_000 * n if stamped else 0)
                x, y, z, w = Rotation.from_euler("z", 10.0 * n, degrees=True).as_quat()
                pose = types["Pose"](
                    position=types["Point"](x=0.5 + 0.01 * n, y=0.1, z=0.3),
                    orientation=types["Quaternion"](x=x, y=y, z=z, w=w),
                )
                message = types["PoseStamped"](header=types["Header"](stamp=stamp, frame_id=frame), pose=pose)
                writer.write(connection, 20_000_000_000 + 11_000_000 * n, store.serialize_cdr(message, kind))


@pytest.mark.parametrize(("topic", "frame"), LAYOUTS.items())
def test_import_reads_the_bag_of_an_arm(topic, frame, tmp_path):
    pytest.importorskip("rosbags")
    write_bag(tmp_path / "bag", {topic: frame})
    result = import_recording(tmp_path / "bag", tmp_path / "poses.npz")
    assert f"poses stay in the frame '{frame}': " in result["assumed"]
    poses = Demonstrations.load(tmp_path / "poses.npz")
    np.testing.assert_allclose(poses.times[0], 0.01 * np.arange(5), atol=1e-9)
    np.testing.assert_allclose(poses.outputs[0][3], [0.53, 0.1, 0.3, np.deg2rad(30), 0, 0], atol=1e-12)

    import_recording(tmp_path / "bag", tmp_path / "in_target.npz", target=(0.5, 0.1, 0.2, 0, 0, 90))
    moved = Demonstrations.load(tmp_path / "in_target.npz").outputs[0]
    np.testing.assert_allclose(moved[2], [0, -0.02, 0.1, np.deg2rad(-70), 0, 0], atol=1e-12)


def test_import_reads_an_export_whose_folder_ends_in_mcap(tmp_path):
    pytest.importorskip("rosbags")
    t = 0.1 * np.arange(5)
    exported = Demonstrations([t] * 2, [np.outer(t, [1.0, m]) for m in range(2)], ["x [m]", "y [m]"])
    exported.save(tmp_path / "exported.npz")
    export_demonstrations(tmp_path / "exported.npz", tmp_path / "a.mcap", "mcap")
    import_recording(tmp_path / "a.mcap", tmp_path / "back.npz")
    back = Demonstrations.load(tmp_path / "back.npz")
    assert back.names == exported.names
    np.testing.assert_array_equal(back.outputs, exported.outputs)
    (tmp_path / "empty.mcap").mkdir()
    with pytest.raises(InputError, match="is not a LeRobot dataset, a bag"):
        import_recording(tmp_path / "empty.mcap", tmp_path / "none.npz")


@pytest.mark.parametrize(
    ("name", "remedy"), [("a.db3", "metadata.yaml"), ("a.hdf5", "to a CSV file"), ("a.npy", "x_m")]
)
def test_import_of_another_format_states_a_remedy(name, remedy, tmp_path):
    (tmp_path / name).write_bytes(b"0")
    with pytest.raises(InputError, match=remedy):
        import_recording(tmp_path / name, tmp_path / "out.npz")


def test_import_refuses_two_measured_poses_without_signal(tmp_path):
    pytest.importorskip("rosbags")
    write_bag(tmp_path / "bag", {"/a/pose": "base", "/b/pose": "base"})
    with pytest.raises(InputError, match=r"/a/pose, /b/pose, and does not state which.*--signal"):
        import_recording(tmp_path / "bag", tmp_path / "x.npz")
    assert import_recording(tmp_path / "bag", tmp_path / "x.npz", signal="/b/pose")["samples"] == [5]


def test_import_uses_recorder_time_without_stamps(tmp_path):
    pytest.importorskip("rosbags")
    write_bag(tmp_path / "bag", {"/a/pose": "base"}, stamped=False)
    assert "when the recorder received" in import_recording(tmp_path / "bag", tmp_path / "x.npz")["assumed"]
    np.testing.assert_allclose(Demonstrations.load(tmp_path / "x.npz").times[0], 0.011 * np.arange(5), atol=1e-9)


def write_table(path, header, rows):
    path.write_text("\n".join([header, *(",".join(map(str, row)) for row in rows)]) + "\n")


def test_csv_import_needs_no_option_when_columns_are_named(tmp_path):
    rows = [(n * 10, 1 + n, 2, 3, 0, 0, np.sin(0.1 * n), np.cos(0.1 * n)) for n in range(4)]
    write_table(tmp_path / "a.csv", "time_ms,x_mm,y_mm,z_mm,qx,qy,qz,qw", rows)
    import_recording(tmp_path / "a.csv", tmp_path / "a.npz")
    loaded = Demonstrations.load(tmp_path / "a.npz")
    np.testing.assert_allclose(loaded.times[0], 0.01 * np.arange(4))
    np.testing.assert_allclose(loaded.outputs[0][3], [0.004, 0.002, 0.003, 0.6, 0, 0], atol=1e-12)


def import_tables(folder):
    """Write three recordings, and import them into a file in the same folder; return this file."""
    for number in range(3):
        rows = [(n * 10, 1 + n, number, 3, 0, 0, np.sin(0.1 * n), np.cos(0.1 * n)) for n in range(20)]
        write_table(folder / f"a_{number}.csv", "time_ms,x_mm,y_mm,z_mm,qx,qy,qz,qw", rows)
    assert import_recording(folder, folder / "imported.csv")["demonstrations"] == 3
    return folder / "imported.csv"


def test_csv_import_reads_an_imported_file(tmp_path):
    imported = import_tables(tmp_path)
    assert import_recording(imported, tmp_path / "back.csv")["assumed"] == "nothing"
    assert (tmp_path / "back.csv").read_bytes() == imported.read_bytes()
    with pytest.raises(InputError, match=r"imported.csv holds demonstrations, .* leave --time-unit out"):
        import_recording(imported, tmp_path / "x.csv", time_unit="s")


def test_csv_import_transforms_an_imported_file(tmp_path):
    imported, target = import_tables(tmp_path), (0.001, 0.002, 0.0, 10.0, 20.0, 30.0)
    import_recording(imported, tmp_path / "moved.npz", target=target)
    imported.unlink()
    import_recording(tmp_path, tmp_path / "expected.npz", target=target)
    moved, expected = (Demonstrations.load(tmp_path / f"{name}.npz") for name in ("moved", "expected"))
    np.testing.assert_allclose(moved.outputs, expected.outputs, atol=1e-12)
    Demonstrations(moved.times, [y[:, :2] for y in moved.outputs], ["x [m]", "y [m]"]).save(tmp_path / "plane.csv")
    with pytest.raises(InputError, match=r"plane.csv has the outputs x \[m\] and y \[m\], and --target needs"):
        import_recording(tmp_path / "plane.csv", tmp_path / "x.npz", target=target)


def test_csv_import_refuses_an_imported_file_in_its_folder(tmp_path):
    import_tables(tmp_path)
    with pytest.raises(InputError, match=r"imported.csv holds demonstrations, next to recordings such as a_0.csv"):
        import_recording(tmp_path, tmp_path / "again.csv")
    assert not (tmp_path / "again.csv").exists()


@pytest.mark.parametrize(
    ("header", "row", "message", "remedy"),
    [
        ("t,x,y,z", (0.01, 1, 2, 3), "unit of x, y and z", {"unit": "mm"}),
        ("timestamp,x_m,y_m,z_m", (8, 1, 2, 3), "unit of timestamp", {"time_unit": "ms"}),
        ("t,x_m,y_m,z_m,q1,q2,q3,q4", (0.01, 1, 2, 3, 1, 0, 0, 0), "which is its scalar", {"quaternion": "wxyz"}),
        ("t,x_m,y_m,z_m,roll,pitch,yaw", (0.01, 1, 2, 3, 0, 0, 1), "is in degrees", {"angles": "deg"}),
    ],
)
def test_csv_import_names_the_missing_option(header, row, message, remedy, tmp_path):
    rows = [(n * row[0], row[1] + n, *row[2:]) for n in range(4)]
    write_table(tmp_path / "a.csv", header, rows)
    with pytest.raises(InputError, match=message):
        import_recording(tmp_path / "a.csv", tmp_path / "a.npz")
    import_recording(tmp_path / "a.csv", tmp_path / "a.npz", **remedy)
    angle = {"angles": np.deg2rad(1)}.get(next(iter(remedy)), 0.0)
    outputs = Demonstrations.load(tmp_path / "a.npz").outputs[0]
    if outputs.shape[1] == 6:
        assert outputs[0, 3] == pytest.approx(angle)


def test_csv_import_leaves_numbered_joint_positions_out(tmp_path):
    joints = ",".join(f"q{n}" for n in range(1, 8))
    rows = [(0.01 * n, n, 0, 0, 0, 0, 1, *range(7)) for n in range(4)]
    write_table(tmp_path / "a.csv", f"t,x_m,y_m,z_m,roll_rad,pitch_rad,yaw_rad,{joints}", rows)
    import_recording(tmp_path / "a.csv", tmp_path / "a.npz")
    assert Demonstrations.load(tmp_path / "a.npz").outputs[0][0, 3] == pytest.approx(1.0)


def test_import_refuses_a_source_that_is_no_recording(tmp_path):
    for source, message in ((tmp_path / "none", "there is no"), (tmp_path, "is not a LeRobot dataset")):
        with pytest.raises(InputError, match=message):
            import_recording(source, tmp_path / "a.npz")
    (tmp_path / "bad.mcap").write_bytes(b"nothing")
    pytest.importorskip("rosbags")
    with pytest.raises(InputError, match="cannot be read as a bag"):
        import_recording(tmp_path / "bad.mcap", tmp_path / "a.npz")


def test_import_adds_full_turns_for_angles_near_180_degrees(tmp_path):
    for name, degrees in (("a", 175), ("b", -175), ("c", 178)):
        rows = [(0.01 * n, 0, 0, 0, 0, 0, np.deg2rad(degrees + n)) for n in range(4)]
        write_table(tmp_path / f"{name}.csv", "t,x_m,y_m,z_m,roll_rad,pitch_rad,yaw_rad", rows)
    import_recording(tmp_path, tmp_path / "poses.npz")
    starts = [np.rad2deg(output[0, 3]) for output in Demonstrations.load(tmp_path / "poses.npz").outputs]
    assert starts == pytest.approx([175, 185, 178])


def test_lerobot_feature_of_one_number_is_an_output(tmp_path):
    import pyarrow.parquet as parquet

    t = 0.1 * np.arange(5)
    Demonstrations([t], [t[:, None]]).save(tmp_path / "scalar.npz")
    export_demonstrations(tmp_path / "scalar.npz", tmp_path / "set", "lerobot")
    (data,) = (tmp_path / "set" / "data").rglob("*.parquet")
    table = parquet.read_table(data)
    flat = table["action"].combine_chunks().flatten()  # the layout of LeRobot
    parquet.write_table(table.set_column(table.column_names.index("action"), "action", flat), data)
    import_recording(tmp_path / "set", tmp_path / "back.npz", signal="action")
    np.testing.assert_allclose(Demonstrations.load(tmp_path / "back.npz").outputs[0][:, 0], t, atol=1e-6)


def test_import_refuses_two_publishers_on_a_topic(tmp_path):
    pytest.importorskip("rosbags")
    write_bag(tmp_path / "bag", {"/a/pose": "base"}, second_kind="geometry_msgs/msg/Pose")
    with pytest.raises(InputError, match="2 publishers on /a/pose"):
        import_recording(tmp_path / "bag", tmp_path / "x.npz")


def test_fit_bounds_refuses_a_missing_folder(file, tmp_path):
    with pytest.raises(InputError, match="there is no folder"):
        fit_bounds(file, out=tmp_path / "none" / "bounds.yaml")


@pytest.mark.parametrize("kind", ["lerobot", "mcap"])
def test_failed_export_can_be_repeated(kind, file, tmp_path, monkeypatch):
    pytest.importorskip("rosbags")
    out = tmp_path / "out"

    def fail(*_, **__):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as broken:
        # The last functions of both exports.
        broken.setattr("guiderail_data.formats.lerobot._statistics", fail)
        broken.setattr("rosbags.rosbag2.Writer.close", fail)
        with pytest.raises(InputError, match="No space left"):
            export_demonstrations(file, out, kind)
    assert [path.name for path in tmp_path.iterdir()] == [file.name]
    export_demonstrations(file, out, kind)


@pytest.mark.parametrize("kind", ["lerobot", "mcap"])
def test_output_path_is_checked_before_the_input_is_read(kind, file, tmp_path):
    (tmp_path / "damaged.csv").write_text("nothing")
    for path in (file / "set", file / "new" / "set"):
        with pytest.raises(InputError, match="cannot be written"):
            export_demonstrations(tmp_path / "damaged.csv", path, kind)
        with pytest.raises(InputError, match="cannot be written"):
            import_recording(tmp_path / "damaged.csv", path.with_suffix(".npz"))


def test_export_notes_a_shifted_start_when_resampled(tmp_path):
    t = 0.1 * np.arange(5)
    Demonstrations([t - 0.2], [t[:, None]]).save(tmp_path / "early.npz")
    result = export_demonstrations(tmp_path / "early.npz", tmp_path / "set", "lerobot", rate=20)
    assert result["note"].count("first samples were at -0.2 s") == 1


@pytest.mark.parametrize(
    ("rate", "message"),
    [
        (1e15, "give a lower one"),
        (1e308, "give a lower one"),
        (30.0, "--rate 30 leaves one .* 0.03 s: give a higher one"),
    ],
)
def test_import_refuses_a_rate_out_of_range(rate, message, tmp_path):
    write_table(tmp_path / "a.csv", "t,x_m,y_m,z_m", [(0.01 * n, n, 2, 3) for n in range(4)])
    with pytest.raises(InputError, match=message):
        import_recording(tmp_path / "a.csv", tmp_path / "a.npz", rate=rate)


def test_import_refuses_demonstrations_with_too_many_numbers(tmp_path, monkeypatch):
    write_table(tmp_path / "a.csv", "t,x_m,y_m,z_m", [(0.01 * n, n, 2, 3) for n in range(4)])
    monkeypatch.setattr("guiderail_data.convert.MAX_NUMBERS", 15)
    with pytest.raises(InputError, match=r"16 numbers.*--rate"):
        import_recording(tmp_path / "a.csv", tmp_path / "a.npz")
    assert not (tmp_path / "a.npz").exists()


@pytest.mark.parametrize("kind", ["lerobot", "mcap"])
def test_import_refuses_csv_options_for_other_formats(kind, file, tmp_path):
    export_demonstrations(file, tmp_path / "set", kind)
    with pytest.raises(InputError, match="leave --unit out: it is stated in"):
        import_recording(tmp_path / "set", tmp_path / "back.npz", unit="mm")
    assert not (tmp_path / "back.npz").exists()


def test_csv_import_refuses_a_signal(tmp_path):
    write_table(tmp_path / "a.csv", "t,x_m,y_m,z_m", [(0.01 * n, n, 2, 3) for n in range(4)])
    with pytest.raises(InputError, match="leave --signal out"):
        import_recording(tmp_path / "a.csv", tmp_path / "a.npz", signal="foo")


@pytest.mark.parametrize("kind", ["lerobot", "mcap"])
def test_twelve_demonstrations_keep_their_order(kind, tmp_path):
    t = 0.1 * np.arange(6)
    Demonstrations([t] * 12, [np.full((6, 1), float(k)) for k in range(12)]).save(tmp_path / "many.npz")
    export_demonstrations(tmp_path / "many.npz", tmp_path / "set", kind)
    import_recording(tmp_path / "set", tmp_path / "back.npz")
    second = Demonstrations.load(tmp_path / "back.npz")
    assert [output[0, 0] for output in second.outputs] == list(range(12))
