"""Messages of ROS 2 as Cyclone DDS types, for programs without a ROS installation.

ROS 2 calls the type `pkg/msg/Name` on the bus `pkg::msg::dds_::Name_`, and the topic `/name` `rt/name`.
"""

# mypy: disable-error-code="type-arg, assignment"
# Cyclone DDS reads the annotations at run time; its `sequence` is not generic for type checkers.
# Annotations are types, not texts, because Cyclone DDS reads them: no `from __future__ import annotations` here.

from dataclasses import dataclass, field

from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import float64, int32, int64, sequence, uint32, uint64


@dataclass
class Time(IdlStruct, typename="builtin_interfaces::msg::dds_::Time_"):
    """Time stamp."""

    sec: int32 = 0
    nanosec: uint32 = 0


@dataclass
class Duration(IdlStruct, typename="builtin_interfaces::msg::dds_::Duration_"):
    """Duration."""

    sec: int32 = 0
    nanosec: uint32 = 0


@dataclass
class Header(IdlStruct, typename="std_msgs::msg::dds_::Header_"):
    """Time stamp and frame of a message."""

    stamp: Time = field(default_factory=Time)
    frame_id: str = ""


@dataclass
class JointState(IdlStruct, typename="sensor_msgs::msg::dds_::JointState_"):
    """State of joints by name."""

    header: Header = field(default_factory=Header)
    name: sequence[str] = field(default_factory=list)
    position: sequence[float64] = field(default_factory=list)
    velocity: sequence[float64] = field(default_factory=list)
    effort: sequence[float64] = field(default_factory=list)


@dataclass
class Vector3(IdlStruct, typename="geometry_msgs::msg::dds_::Vector3_"):
    """Vector."""

    x: float64 = 0.0
    y: float64 = 0.0
    z: float64 = 0.0


@dataclass
class Point(IdlStruct, typename="geometry_msgs::msg::dds_::Point_"):
    """Position."""

    x: float64 = 0.0
    y: float64 = 0.0
    z: float64 = 0.0


@dataclass
class Quaternion(IdlStruct, typename="geometry_msgs::msg::dds_::Quaternion_"):
    """Orientation."""

    x: float64 = 0.0
    y: float64 = 0.0
    z: float64 = 0.0
    w: float64 = 1.0


@dataclass
class Pose(IdlStruct, typename="geometry_msgs::msg::dds_::Pose_"):
    """Pose."""

    position: Point = field(default_factory=Point)
    orientation: Quaternion = field(default_factory=Quaternion)


@dataclass
class PoseStamped(IdlStruct, typename="geometry_msgs::msg::dds_::PoseStamped_"):
    """Pose with time and frame."""

    header: Header = field(default_factory=Header)
    pose: Pose = field(default_factory=Pose)


@dataclass
class Wrench(IdlStruct, typename="geometry_msgs::msg::dds_::Wrench_"):
    """Force and torque."""

    force: Vector3 = field(default_factory=Vector3)
    torque: Vector3 = field(default_factory=Vector3)


@dataclass
class WrenchStamped(IdlStruct, typename="geometry_msgs::msg::dds_::WrenchStamped_"):
    """Force and torque with time and frame."""

    header: Header = field(default_factory=Header)
    wrench: Wrench = field(default_factory=Wrench)


@dataclass
class SwitchControllerRequest(IdlStruct, typename="controller_manager_msgs::srv::dds_::SwitchController_Request_"):
    """Request to switch controllers (ROS 2 Jazzy), after the header of rmw_cyclonedds: writer and number."""

    guid: uint64 = 0
    number: int64 = 0
    activate_controllers: sequence[str] = field(default_factory=list)
    deactivate_controllers: sequence[str] = field(default_factory=list)
    strictness: int32 = 2  # strict: all of the request or nothing
    activate_asap: bool = True
    timeout: Duration = field(default_factory=Duration)


@dataclass
class SwitchControllerResponse(IdlStruct, typename="controller_manager_msgs::srv::dds_::SwitchController_Response_"):
    """Response of the controller manager, after the header of the request."""

    guid: uint64 = 0
    number: int64 = 0
    ok: bool = False
    message: str = ""
