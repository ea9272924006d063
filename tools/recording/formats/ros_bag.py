"""ROS 2 bags, and MCAP files with ROS 2 messages, read and written by rosbags."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from guiderail.models.errors import InputError, brief
from guiderail.models.primitives import Demonstrations
from guiderail.tools.recording.formats.recorded import POSE_NAMES, Recorded, choose_signal, poses_in_target

# Where a pose is in a message of each type that robots commonly publish.
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


def _rosbags() -> Any:
    try:
        import rosbags.highlevel as highlevel
    except ImportError:
        raise InputError("bags need rosbags, which is not installed: pip install 'guiderail[bags]'") from None
    return highlevel


def find_bags(path: Path) -> list[Path]:
    """The bags at a path: itself, or those in the folder, sorted by name."""
    if path.suffix == ".mcap" or (path / "metadata.yaml").is_file():
        return [path]
    return sorted(one for one in path.iterdir() if one.suffix == ".mcap" or (one / "metadata.yaml").is_file())


def read_bags(path: Path, topic: str | None, target: Sequence[float] | None) -> Recorded:
    """One demonstration a bag.

    Args:
        path: a bag, an MCAP file, or a folder of them.
        topic: which is meant; found out unless given.
        target: see `poses_in_target`.

    Raises:
        InputError: if there is none, or it does not say what is meant.
    """
    found = Recorded([], [], ())
    for bag in find_bags(path):
        times, outputs, names, assumed = _read_bag(bag, topic, target, found.outputs[0] if found.outputs else None)
        if found.names and names != found.names:
            raise InputError(f"{bag} has {', '.join(names)}, the bag before {', '.join(found.names)}: record the same")
        found.times.append(times)
        found.outputs.append(outputs)
        found.names = names
        found.assumed += [one for one in assumed if one not in found.assumed]
    return found


def _read_bag(
    bag: Path, topic: str | None, target: Sequence[float] | None, like: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray, tuple[str, ...], list[str]]:
    highlevel = _rosbags()
    from rosbags.typesys import Stores, get_typestore

    try:
        reader = highlevel.AnyReader([bag], default_typestore=get_typestore(Stores.ROS2_HUMBLE))
        reader.open()
    except Exception as error:  # whatever a damaged bag makes its reader raise
        raise InputError(f"{bag} can't be read as a bag: {brief(str(error))}") from error
    try:
        kinds = {one.topic: one.msgtype for one in reader.connections}
        known = [name for name, kind in kinds.items() if kind in POSES or kind in (JOINTS, DATA)]
        chosen, assumed = choose_signal(sorted(known), topic, str(bag), "--signal")
        connections = [one for one in reader.connections if one.topic == chosen]
        if len(connections) > 1:
            raise InputError(
                f"{bag} has {len(connections)} publishers on {chosen}, whose motions would be mixed: record one of them"
            )
        rows = [(stamp, reader.deserialize(raw, kinds[chosen])) for _, stamp, raw in reader.messages(connections)]
    except InputError:
        raise
    except Exception as error:  # as above, of a message
        raise InputError(f"{bag} holds a message that can't be read: {brief(str(error))}") from error
    finally:
        reader.close()
    if len(rows) < 2:
        raise InputError(f"{bag} has {len(rows)} messages on {chosen}: a motion needs at least two")
    times, of_time = _clock(rows)
    assumed += of_time
    messages = [message for _, message in rows]
    if kinds[chosen] == DATA:
        names = tuple(dimension.label for dimension in messages[0].layout.dim) or POSE_NAMES
        return times, np.array([message.data for message in messages]), names, assumed
    if kinds[chosen] == JOINTS:
        names = tuple(f"{name} [rad]" for name in messages[0].name)
        assumed.append("joints are revolute, so that their positions are in radians")
        return times, np.array([message.position for message in messages]), names, assumed
    poses = [_within(message, POSES[kinds[chosen]]) for message in messages]
    positions = np.array([_xyz(pose) for pose in poses])
    turns = [getattr(pose, "orientation", None) or pose.rotation for pose in poses]
    rotations = Rotation.from_quat([(q.x, q.y, q.z, q.w) for q in turns])
    frame = _frame(messages[0], POSES[kinds[chosen]])
    assumed.append("positions are in metres and quaternions by their fields' names, as ROS has them (REP 103)")
    if target is None:
        assumed.append(f"poses stay in the frame {frame!r}: --target says where the task's target is in it")
    return times, poses_in_target(positions, rotations, target, like), POSE_NAMES, assumed


def _clock(rows: Sequence[tuple[int, Any]]) -> tuple[np.ndarray, list[str]]:
    """Seconds since the first message, by the stamps of whoever measured where there are some."""
    headers: list[Any] = [getattr(message, "header", None) for _, message in rows]
    if all(header is not None for header in headers):
        stamps = np.array([header.stamp.sec * 10**9 + header.stamp.nanosec for header in headers], dtype=np.int64)
        if (np.diff(stamps) > 0).all():
            return (stamps - stamps[0]) * _NANO, []
    received = np.array([stamp for stamp, _ in rows], dtype=np.int64)
    return (received - received[0]) * _NANO, ["time is when the recorder got a message: its stamps say nothing"]


def _within(message: Any, path: Sequence[str]) -> Any:
    for name in path:
        message = getattr(message, name)
    return message


def _xyz(pose: Any) -> tuple[float, float, float]:
    p = getattr(pose, "position", None) or pose.translation
    return p.x, p.y, p.z


def _frame(message: Any, path: Sequence[str]) -> str:
    for holder in (message, _within(message, path[:1])):
        header = getattr(holder, "header", None)
        if header is not None:
            return str(header.frame_id)
    return "of the recording"


def write_mcap(path: Path, demonstrations: Demonstrations) -> list[str]:
    """A folder of ROS 2 bags in MCAP, one a demonstration, as arrays of doubles with named dimensions."""
    _rosbags()
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    layout, dimension, array = (
        store.types[f"std_msgs/msg/{name}"] for name in ("MultiArrayLayout", "MultiArrayDimension", "Float64MultiArray")
    )
    dims = [dimension(label=name, size=1, stride=1) for name in demonstrations.names]
    path.mkdir(parents=True)
    for number, (times, outputs) in enumerate(zip(demonstrations.times, demonstrations.outputs, strict=True)):
        with Writer(path / f"demonstration_{number}", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
            connection = writer.add_connection(TOPIC, DATA, typestore=store)
            for t, y in zip(times, outputs, strict=True):
                message = array(layout=layout(dim=dims, data_offset=0), data=y)
                writer.write(connection, round(t / _NANO), store.serialize_cdr(message, DATA))
    return [f"{TOPIC} holds the outputs as {DATA}, named in its layout; its time is the bag's, to the nanosecond"]
