"""Bags of ROS 1 and ROS 2, and MCAP files with ROS 2 messages, read and written with rosbags."""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from guiderail.models.common.errors import InputError, brief, import_extra
from guiderail.models.common.files import in_order
from guiderail.models.common.transforms import POSE_NAMES
from guiderail.models.primitives import Demonstrations
from guiderail.models.primitives.io import MAX_LINES
from guiderail.tools.files import atomic_folder
from guiderail_data.formats.recorded import (
    NO_FRAMES,
    Frames,
    Recorded,
    choose_signal,
    describe_frames,
    describe_time_shift,
    plain_frame,
    poses_in_target,
    rotations_of,
)

# Nested attributes of a message that contain its pose, by message type.
POSES = {
    "geometry_msgs/msg/PoseStamped": ("pose",),
    "geometry_msgs/msg/Pose": (),
    "geometry_msgs/msg/PoseWithCovarianceStamped": ("pose", "pose"),
    "geometry_msgs/msg/TransformStamped": ("transform",),
    "nav_msgs/msg/Odometry": ("pose", "pose"),
    "iiwa_msgs/msg/CartesianPose": ("pose_stamped", "pose"),
    "franka_msgs/msg/FrankaRobotState": ("o_t_ee", "pose"),
}
JOINTS = "sensor_msgs/msg/JointState"
TOPIC = "/demonstration/commanded_pose"
DATA = "std_msgs/msg/Float64MultiArray"
_NANO = 1e-9
_MAX_TIME = 9e9  # largest time of a bag [s], which counts nanoseconds in 63 bits


def find_bags(path: Path) -> list[Path]:
    """Return the bag at a path, or all bags in the folder that are not hidden, sorted by name.

    A folder is a bag if it has a `metadata.yaml`, and a file if its name ends in .mcap or, of ROS 1, in .bag.
    """
    if _is_bag(path):
        return [path]
    entries = [entry for entry in path.iterdir() if not entry.name.startswith(".")] if path.is_dir() else []
    return in_order(filter(_is_bag, entries))


def _is_bag(path: Path) -> bool:
    return (path.suffix in (".mcap", ".bag") and path.is_file()) or (path / "metadata.yaml").is_file()


def read_bags(path: Path, topic: str | None, target: Sequence[float] | None) -> Recorded:
    """Return one motion per bag; see `choose_signal` for `topic`, and `poses_in_target` for `target`.

    Raises:
        InputError: If a bag cannot be read, or no single topic can be chosen. Also if a topic has several publishers,
            fewer than two messages, more than `MAX_LINES`, or messages of different sizes, labels, joints or frames.
            Also if an array has no labels and `topic` is None; if `target` is given for a topic without poses; or if
            the outputs or frames of two bags differ.
        MissingExtraError: If rosbags is not installed.
    """
    recorded = Recorded([], [], ())
    for bag in find_bags(path):
        like = recorded.outputs[0] if recorded.outputs else None
        times, outputs, names, frames, assumptions = _read_bag(bag, topic, target, like)
        if sorted(names) == sorted(recorded.names):  # the order of joints may differ
            names, outputs = recorded.names, outputs[:, [names.index(name) for name in recorded.names]]
        if recorded.names and frames != recorded.frames:
            raise InputError(
                f"{bag} has poses of {describe_frames(*frames)}, and the previous bag of "
                f"{describe_frames(*recorded.frames)}: record the same frames in all bags"
            )
        if recorded.names and names != recorded.names:
            raise InputError(
                f"{bag} has the outputs {', '.join(names)}, and the previous bag {', '.join(recorded.names)}: "
                "record the same outputs in all bags"
            )
        recorded.times.append(times)
        recorded.outputs.append(outputs)
        recorded.names, recorded.frames = names, frames
        recorded.assumptions += [text for text in assumptions if text not in recorded.assumptions]
    return recorded


def _read_bag(
    bag: Path, topic: str | None, target: Sequence[float] | None, like: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray, tuple[str, ...], Frames, list[str]]:
    highlevel = import_extra("rosbags.highlevel")
    from rosbags.typesys import Stores, get_typestore

    try:
        reader = highlevel.AnyReader([bag], default_typestore=get_typestore(Stores.ROS2_HUMBLE))
        reader.open()
    except Exception as error:  # the reader raises many types for damaged bags
        raise InputError(f"{bag} cannot be read as a bag: {brief(str(error))}") from error
    try:
        kinds = {connection.topic: connection.msgtype for connection in reader.connections}
        candidates = [name for name, kind in kinds.items() if kind in POSES or kind in (JOINTS, DATA)]
        chosen, assumptions = choose_signal(sorted(candidates), topic, str(bag), "--signal")
        connections = [connection for connection in reader.connections if connection.topic == chosen]
        if len(connections) > 1:
            raise InputError(
                f"{bag} has {len(connections)} publishers on {chosen}, whose messages would be mixed: "
                "record one of them"
            )
        received = islice(reader.messages(connections), MAX_LINES + 1)
        rows = [(stamp, reader.deserialize(raw, kinds[chosen])) for _, stamp, raw in received]
    except InputError:
        raise
    except Exception as error:  # the reader raises many types for damaged messages
        raise InputError(f"{bag} holds a message that cannot be read: {brief(str(error))}") from error
    finally:
        reader.close()
    if len(rows) > MAX_LINES:
        raise InputError(f"{bag} has more than {MAX_LINES} messages on {chosen}: record a shorter motion")
    if len(rows) < 2:
        raise InputError(f"{bag} has {len(rows)} messages on {chosen}: a motion needs at least two")
    times, remarks = _message_times(rows)
    assumptions += remarks
    messages = [message for _, message in rows]
    if target is not None and kinds[chosen] in (DATA, JOINTS):
        raise InputError(f"{chosen} of {bag} does not state which numbers are a pose: leave --target out")
    if kinds[chosen] == DATA:
        names, values = _labeled(messages, f"on {chosen} of {bag}", topic is not None, assumptions)
        return times, values, names, NO_FRAMES, assumptions
    if kinds[chosen] == JOINTS:
        assumptions.append("joints are revolute, so that their positions are in radians")
        names = tuple(f"{name} [rad]" for name in messages[0].name)
        return times, _joint_positions(messages, f"on {chosen} of {bag}"), names, NO_FRAMES, assumptions
    poses = [reduce(getattr, POSES[kinds[chosen]], message) for message in messages]
    points = [getattr(pose, "position", None) or pose.translation for pose in poses]
    positions = np.array([(p.x, p.y, p.z) for p in points])
    orientations = [getattr(pose, "orientation", None) or pose.rotation for pose in poses]
    rotations = rotations_of(np.array([(q.x, q.y, q.z, q.w) for q in orientations]), str(bag))
    frames = _frames(messages, POSES[kinds[chosen]], f"on {chosen} of {bag}")
    frame = f"the frame {frames[0]!r}" if frames[0] else "the frame of the recording"
    assumptions.append("positions are in meters, and quaternions follow the names of their fields (REP 103)")
    if target is None:
        assumptions.append(
            f"poses stay in {frame}: to convert them, give the pose of the task's target in it as --target"
        )
    else:
        assumptions.append(f"--target is a pose in {frame}")
    return times, poses_in_target(positions, rotations, target, like), POSE_NAMES, frames, assumptions


def _labeled(
    messages: Sequence[Any], where: str, is_named: bool, assumptions: list[str]
) -> tuple[tuple[str, ...], np.ndarray]:
    """Return the names and values (N, O) of arrays; arrays without labels are refused unless the user named the topic.

    A number of values does not state what they are: six may be a pose, joint positions, velocities or a wrench.
    """
    names = _array_names(messages[0])
    for number, message in enumerate(messages):
        if len(message.data) != len(names):
            raise InputError(
                f"message {number} {where} has {len(message.data)} numbers instead of {len(names)}: record the same "
                "number in every message, one for each label"
            )
        if _array_names(message) != names:
            raise InputError(f"message {number} {where} has other labels than message 0: record one signal")
    if all(not dimension.label for dimension in messages[0].layout.dim):
        if not is_named:
            raise InputError(
                f"the {len(names)} numbers {where} have no labels and do not state what they are, such as a pose, "
                "joint positions or velocities: record a PoseStamped or a JointState, label the array's layout, or "
                "name the topic with --signal to import plain numbers"
            )
        assumptions.append(f"the numbers {where} have no labels: they are plain outputs without a unit")
    return names, np.array([message.data for message in messages])


def _array_names(message: Any) -> tuple[str, ...]:
    """Return the names of an array's numbers: the labels of dimensions of size 1, as `write_mcap` writes them.

    With a single longer dimension, or without dimensions, the names are its label, or "output", and an index.
    """
    dimensions = message.layout.dim
    if len(dimensions) > 1 or (dimensions and dimensions[0].size == len(message.data) == 1):
        return tuple(dimension.label or f"output {number}" for number, dimension in enumerate(dimensions))
    label, size = (dimensions[0].label, dimensions[0].size) if dimensions else ("", len(message.data))
    return tuple(f"{label or 'output'} {number}" for number in range(size))


def _joint_positions(messages: Sequence[Any], where: str) -> np.ndarray:
    """Return positions (N, J) in the order of the first message's names; the order may differ between messages.

    A message with other joints is refused, not skipped, because the first message may be from the wrong device.
    """
    expected = list(messages[0].name)
    if len(set(expected)) < len(expected):
        raise InputError(f"message 0 {where} has a joint twice ({', '.join(expected)}): rename one")
    rows = []
    for number, message in enumerate(messages):
        names = list(message.name)
        if len(message.position) != len(names):
            raise InputError(
                f"message {number} {where} has {len(message.position)} positions for {len(names)} joints: record a "
                "position of each joint"
            )
        if sorted(names) != sorted(expected):
            raise InputError(
                f"message {number} {where} has the joints {', '.join(names)}, and message 0 {', '.join(expected)}: "
                "record each device on a topic of its own"
            )
        rows.append(np.asarray(message.position)[[names.index(name) for name in expected]])
    return np.array(rows)


def _message_times(rows: Sequence[tuple[int, Any]]) -> tuple[np.ndarray, list[str]]:
    """Return the time of each message since the first message (N,) [s], with remarks.

    Times are the stamps in the headers if they increase, otherwise the times of receipt.
    """
    headers: list[Any] = [getattr(message, "header", None) for _, message in rows]
    if all(header is not None for header in headers):
        stamps = np.array([header.stamp.sec * 10**9 + header.stamp.nanosec for header in headers], dtype=np.int64)
        if (np.diff(stamps) > 0).all():
            return (stamps - stamps[0]) * _NANO, []
    received = np.array([stamp for stamp, _ in rows], dtype=np.int64)
    return (received - received[0]) * _NANO, [
        "time is when the recorder received a message, because the messages have no stamps that increase"
    ]


def _frames(messages: Sequence[Any], path: Sequence[str], where: str) -> Frames:
    """Return the frame of the poses and the frame that they move; poses in several frames are refused.

    `path` has the nested attributes of a message that contain the pose. A frame that a message does not state is "".
    """
    frames = NO_FRAMES
    for number, message in enumerate(messages):
        holders = (message, reduce(getattr, path[:1], message))
        names = (getattr(getattr(holder, "header", None), "frame_id", "") for holder in holders)
        found = plain_frame(next(filter(None, names), "")), plain_frame(getattr(message, "child_frame_id", ""))
        if number and found != frames:
            raise InputError(
                f"message {number} {where} has a pose of {describe_frames(*found)}, and message 0 of "
                f"{describe_frames(*frames)}: record each frame on a topic of its own"
            )
        frames = found
    return frames


def write_mcap(path: Path, demonstrations: Demonstrations) -> list[str]:
    """Write a folder with one ROS 2 bag in MCAP per demonstration; return remarks.

    Each message has the outputs (O,) of one sample; the labels of its layout are the names of the outputs. The folder
    must be new or empty.

    Raises:
        InputError: If a bag cannot represent the demonstrations' times, or the folder cannot be written.
        MissingExtraError: If rosbags is not installed.
    """
    import_extra("rosbags")
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    layout, dimension, array = (
        store.types[f"std_msgs/msg/{name}"] for name in ("MultiArrayLayout", "MultiArrayDimension", "Float64MultiArray")
    )
    dims = [dimension(label=name, size=1, stride=1) for name in demonstrations.names]
    stamps, notes = _stamps(demonstrations)
    with atomic_folder(path) as folder:
        for number, (clock, outputs) in enumerate(zip(stamps, demonstrations.outputs, strict=True)):
            with Writer(folder / f"demonstration_{number}", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
                connection = writer.add_connection(TOPIC, DATA, typestore=store)
                for stamp, y in zip(clock.tolist(), outputs, strict=True):
                    message = array(layout=layout(dim=dims, data_offset=0), data=y)
                    writer.write(connection, stamp, store.serialize_cdr(message, DATA))
    return [
        f"{TOPIC} holds the outputs as {DATA}, with their names in its layout; the time of a sample is that of its "
        "message in the bag, rounded to nanoseconds",
        *notes,
    ]


def _stamps(demonstrations: Demonstrations) -> tuple[list[np.ndarray], list[str]]:
    """Return the times of each demonstration (N_m,) [ns], with remarks.

    If a time is negative, all demonstrations are shifted to start at zero.
    """
    times, notes = list(demonstrations.times), []
    if min(t[0] for t in times) < 0.0:
        times, notes = [t - t[0] for t in times], describe_time_shift(demonstrations)
    stamps = []
    for number, t in enumerate(times):
        if t[-1] > _MAX_TIME:
            raise InputError(
                f"demonstration {number} ends at {t[-1]:g} s, and the largest time of a bag is {_MAX_TIME:g} s: "
                "subtract an offset"
            )
        stamps.append(np.rint(t / _NANO).astype(np.int64))
        if (np.diff(stamps[-1]) <= 0).any():
            raise InputError(f"demonstration {number} has samples less than a nanosecond apart: give --rate")
    return stamps, notes
