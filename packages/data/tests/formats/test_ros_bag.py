"""ROS bags: joints, poses, arrays and time stamps of messages, refused bags, and export."""

from functools import cache

import numpy as np
import pytest

from guiderail.models.common.errors import InputError
from guiderail.models.primitives import Demonstrations
from guiderail_data.formats.ros_bag import read_bags, write_mcap

pytest.importorskip("rosbags")
JOINTS = "sensor_msgs/msg/JointState"
POSE = "geometry_msgs/msg/Pose"
ARRAY = "std_msgs/msg/Float64MultiArray"


@cache
def typestore():
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_HUMBLE)


def write(path, kind, make, values, topic="/topic"):
    """Write a bag with a message for each of `values`; return its path.

    `make` returns a message from the message types by short name and a value.
    """
    from rosbags.rosbag2 import Writer

    store = typestore()
    types = {name.split("/")[-1]: message_type for name, message_type in store.types.items()}
    with Writer(path, version=8) as writer:
        connection = writer.add_connection(topic, kind, typestore=store)
        for n, value in enumerate(values):
            writer.write(connection, 10_000_000 * n, store.serialize_cdr(make(types, value), kind))
    return path


def test_bag_of_ros_1_is_read(tmp_path):
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    types, kind = store.types, "geometry_msgs/msg/PoseStamped"
    with Writer(tmp_path / "shown.bag") as writer:
        connection = writer.add_connection("/tool", kind, typestore=store)
        for n in range(3):
            time = types["builtin_interfaces/msg/Time"](sec=1, nanosec=20_000_000 * n)
            header = types["std_msgs/msg/Header"](seq=n, stamp=time, frame_id="base")
            point = types["geometry_msgs/msg/Point"](x=0.1 * n, y=0.0, z=0.4)
            turn = types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0)
            message = types[kind](header=header, pose=types["geometry_msgs/msg/Pose"](position=point, orientation=turn))
            writer.write(connection, 10**9 + 20_000_000 * n, store.serialize_ros1(message, kind))
    recorded = read_bags(tmp_path / "shown.bag", None, None)
    np.testing.assert_allclose(recorded.outputs[0][:, :3], [[0.0, 0, 0.4], [0.1, 0, 0.4], [0.2, 0, 0.4]])
    np.testing.assert_allclose(recorded.times[0], [0.0, 0.02, 0.04])


def joints(types, values):
    names, positions = values
    header = types["Header"](stamp=types["Time"](sec=0, nanosec=0), frame_id="")
    empty = np.array([])
    return types["JointState"](
        header=header, name=list(names), position=np.array(positions, dtype=float), velocity=empty, effort=empty
    )


def pose(types, w):
    return types["Pose"](
        position=types["Point"](x=0.0, y=0.0, z=0.0), orientation=types["Quaternion"](x=0.0, y=0.0, z=0.0, w=w)
    )


def array(types, values):
    layout = types["MultiArrayLayout"](dim=[], data_offset=0)
    return types["Float64MultiArray"](layout=layout, data=np.array(values, dtype=float))


def test_joint_order_may_differ_between_messages(tmp_path):
    orders = [("abc", (1, 2, 3)), ("cab", (3, 1, 2)), ("bca", (2, 3, 1)), ("abc", (1, 2, 3))]
    result = read_bags(write(tmp_path / "bag", JOINTS, joints, orders), None, None)
    assert result.names == ("a [rad]", "b [rad]", "c [rad]")
    np.testing.assert_array_equal(result.outputs[0], [[1, 2, 3]] * 4)


def test_hidden_file_next_to_bags_is_not_read(tmp_path):
    write(tmp_path / "0", JOINTS, joints, [("abc", (1, 2, 3))] * 2)
    (tmp_path / "._1.mcap").write_bytes(b"\x00\x05\x16\x07")
    assert len(read_bags(tmp_path, None, None).times) == 1


def test_joint_order_may_differ_between_bags(tmp_path):
    for name, order in (("0", ("abc", (1, 2, 3))), ("1", ("cab", (3, 1, 2)))):
        write(tmp_path / name, JOINTS, joints, [order] * 2)
    result = read_bags(tmp_path, None, None)
    assert result.names == ("a [rad]", "b [rad]", "c [rad]")
    np.testing.assert_array_equal(result.outputs, [[[1, 2, 3]] * 2] * 2)


CHANGED = "message 1 on /topic of .* has the joints g, and message 0 a, b: record each device"


@pytest.mark.parametrize(
    ("kind", "make", "values", "message"),
    [
        (JOINTS, joints, [("ab", (1, 2)), ("g", (5,)), ("ab", (1, 2))], CHANGED),
        (JOINTS, joints, [("ab", (1, 2)), ("ag", (1, 5)), ("ab", (1, 2))], "has the joints a, g, and message 0 a, b"),
        (JOINTS, joints, [("ab", (1, 2)), ("ab", ()), ("ab", (1, 2))], "has 0 positions for 2 joints"),
        (JOINTS, joints, [("aba", (1, 2, 3))] * 2, r"message 0 on /topic of .* has a joint twice \(a, b, a\)"),
        *((POSE, pose, [1.0, w, 1.0], r"at sample 1, .*cut such samples out \(1 of 3\)") for w in (0.0, 0.5, np.nan)),
        (ARRAY, array, [range(6), range(5)], r"message 1 on /topic .* has 5 numbers instead of 6"),
    ],
)
def test_bag_is_refused_when_a_message_is_invalid(kind, make, values, message, tmp_path):
    with pytest.raises(InputError, match=message):
        read_bags(write(tmp_path / "bag", kind, make, values), None, None)


def test_array_outputs_are_named_after_its_dimension(tmp_path):
    def labeled_array(types, label):
        dimension = types["MultiArrayDimension"](label=label, size=3, stride=3)
        layout = types["MultiArrayLayout"](dim=[dimension], data_offset=0)
        return types["Float64MultiArray"](layout=layout, data=np.arange(3.0))

    result = read_bags(write(tmp_path / "bag", ARRAY, labeled_array, ["force", "force"]), None, None)
    assert result.names == ("force 0", "force 1", "force 2")
    np.testing.assert_array_equal(result.outputs[0], [[0, 1, 2]] * 2)
    unnamed = read_bags(write(tmp_path / "unnamed", ARRAY, labeled_array, ["", ""]), "/topic", None)
    assert unnamed.names == ("output 0", "output 1", "output 2")


@pytest.mark.parametrize(("kind", "make", "value"), [(ARRAY, array, range(6)), (JOINTS, joints, ("ab", (1, 2)))])
def test_target_is_refused_without_poses(kind, make, value, tmp_path):
    with pytest.raises(InputError, match=r"/topic of .* does not state which numbers are a pose: leave --target out"):
        read_bags(write(tmp_path / "bag", kind, make, [value] * 2), None, (0.0,) * 6)


def test_recorder_time_is_used_when_messages_have_no_stamps(tmp_path):
    result = read_bags(write(tmp_path / "bag", POSE, pose, [1.0] * 3), None, None)
    np.testing.assert_allclose(result.times[0], [0.0, 0.01, 0.02])
    assert any("the messages have no stamps that increase" in text for text in result.assumptions)


def test_assumption_names_no_frame_without_a_header(tmp_path):
    result = read_bags(write(tmp_path / "bag", POSE, pose, [1.0] * 2), None, None)
    assert any(text.startswith("poses stay in the frame of the recording: ") for text in result.assumptions)


def test_bag_export_shifts_negative_time(tmp_path):
    t = 0.1 * np.arange(5)
    notes = write_mcap(tmp_path / "bags", Demonstrations([t - 0.2, t + 0.3], [t[:, None]] * 2))
    assert "first samples were at -0.2 to 0.3 s" in notes[-1]
    loaded = read_bags(tmp_path / "bags", None, None)
    np.testing.assert_allclose(loaded.times, [t, t], atol=1e-9)
    np.testing.assert_array_equal(loaded.outputs, [t[:, None]] * 2)


@pytest.mark.parametrize(
    ("times", "message"), [([0.0, 1e10], "ends at 1e\\+10 s"), ([0.0, 1e-12], "less than a nanosecond apart")]
)
def test_bag_export_refuses_time_out_of_range(times, message, tmp_path):
    with pytest.raises(InputError, match=message):
        write_mcap(tmp_path / "bags", Demonstrations([np.array(times)], [np.ones((2, 1))]))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "topic", ["/forward_position_controller/commands", "/forward_velocity_controller/commands", "/pose"]
)
@pytest.mark.parametrize("size", [1, 3, 6, 7])
def test_array_without_labels_is_refused_unless_named(topic, size, tmp_path):
    bag = write(tmp_path / "bag", ARRAY, array, [np.arange(size) + n for n in range(3)], topic)
    with pytest.raises(InputError, match=r"have no labels|states changes, rates or forces"):
        read_bags(bag, None, None)
    named = read_bags(bag, topic, None)
    assert named.names == tuple(f"output {number}" for number in range(size))
    assert any("plain outputs without a unit" in text for text in named.assumptions)


def test_array_is_refused_when_its_labels_change(tmp_path):
    def labeled(types, labels):
        dims = [types["MultiArrayDimension"](label=label, size=1, stride=1) for label in labels]
        return types["Float64MultiArray"](
            layout=types["MultiArrayLayout"](dim=dims, data_offset=0), data=np.arange(float(len(labels)))
        )

    bag = write(tmp_path / "bag", ARRAY, labeled, ["xyz", "xyz", "zyx"])
    with pytest.raises(InputError, match=r"message 2 on /topic of .* has other labels"):
        read_bags(bag, None, None)


@pytest.mark.parametrize(
    "topic",
    ["/servo/delta_pose", "/cmd_vel", "/tcp/velocity", "/pose_error", "/eeTwist", "/relative/pose", "/ft/wrench"],
)
def test_pose_topic_that_is_called_a_rate_is_refused_unless_named(topic, tmp_path):
    bag = write(tmp_path / "bag", POSE, pose, [1.0] * 3, topic)
    with pytest.raises(InputError, match="name it with --signal to import it as it is"):
        read_bags(bag, None, None)
    assert len(read_bags(bag, topic, None).times) == 1


def in_frame(kind):
    """Return a maker of messages of a kind from their frame and child frame."""

    def make(types, frames):
        frame, child = frames
        header = types["Header"](stamp=types["Time"](sec=0, nanosec=0), frame_id=frame)
        point, rotation = types["Point"](x=0.0, y=0.0, z=0.0), types["Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0)
        plain = types["Pose"](position=point, orientation=rotation)
        if kind == "PoseStamped":
            return types[kind](header=header, pose=plain)
        with_covariance = types["PoseWithCovariance"](pose=plain, covariance=np.zeros(36))
        if kind == "PoseWithCovarianceStamped":
            return types[kind](header=header, pose=with_covariance)
        if kind == "TransformStamped":
            shift = types["Vector3"](x=0.0, y=0.0, z=0.0)
            transform = types["Transform"](translation=shift, rotation=rotation)
            return types[kind](header=header, child_frame_id=child, transform=transform)
        zero = types["Vector3"](x=0.0, y=0.0, z=0.0)
        twist = types["TwistWithCovariance"](twist=types["Twist"](linear=zero, angular=zero), covariance=np.zeros(36))
        return types[kind](header=header, child_frame_id=child, pose=with_covariance, twist=twist)

    return make


KINDS = {
    "PoseStamped": "geometry_msgs/msg/PoseStamped",
    "PoseWithCovarianceStamped": "geometry_msgs/msg/PoseWithCovarianceStamped",
    "TransformStamped": "geometry_msgs/msg/TransformStamped",
    "Odometry": "nav_msgs/msg/Odometry",
}
FRAMES = [("base_link", "tool"), ("world", "tool"), ("", "tool"), ("base_link", "camera")]


# Frames are read from each kind of message, and those of two bags are compared whatever the kind.
@pytest.mark.parametrize(("kind", "is_within"), [*((kind, True) for kind in KINDS), ("Odometry", False)])
@pytest.mark.parametrize("second", range(len(FRAMES)))
def test_poses_in_different_frames_are_refused(kind, second, is_within, tmp_path):
    has_child = kind in ("TransformStamped", "Odometry")
    first, other = ((frame, child if has_child else "") for frame, child in (FRAMES[0], FRAMES[second]))
    sequences = [[first] * 3 + [other] * 3] if is_within else [[first] * 3, [other] * 3]
    for number, sequence in enumerate(sequences):
        write(tmp_path / f"bag_{number}", KINDS[kind], in_frame(kind), sequence)
    if first == other:
        assert read_bags(tmp_path, None, None).frames == first
        return
    differing = next(name or "unnamed" for a, name in zip(first, other, strict=True) if a != name)
    with pytest.raises(InputError, match=differing) as error:
        read_bags(tmp_path, None, None)
    assert "base_link" in str(error.value)


def test_leading_slash_of_a_frame_is_ignored(tmp_path):
    frames = [("/base_link", ""), ("base_link", "")]
    bag = write(tmp_path / "bag", KINDS["PoseStamped"], in_frame("PoseStamped"), frames)
    result = read_bags(bag, None, (0.0,) * 6)
    assert result.frames == ("base_link", "")
    assert "--target is a pose in the frame 'base_link'" in result.assumptions
