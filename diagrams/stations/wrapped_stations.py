"""Stations around an inner station: with continuous angles, or with ports of rigid transforms and spatial forces."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from pydrake.systems.framework import Context, DiagramBuilder

from guiderail.diagrams.stations.station import Station
from guiderail.diagrams.wiring import add_system
from guiderail.models.control.motion_constraints import StateConstraints
from guiderail.systems.poses import ContinuousPose, PoseFromTransform, SpatialForceFromWrench, TransformFromPose
from guiderail.systems.support.declarations import input_getter, output_getter


class WrappedStation(Station):
    """Station around an inner station.

    Names that `Station` does not define are those of the inner station. What `Station` defines, such as methods and
    `wraps_angles`, is replaced here or has the default of `Station`. Subclasses use `_inner`.
    """

    def __init__(self, station: Station):
        """Construct the station; a subclass adds the given `station` to its builder."""
        super().__init__()
        self._inner, self.control_period = station, station.control_period

    def __getattr__(self, name: str) -> Any:
        """Return an attribute of the inner station, such as `plant` or `arm`."""
        if name == "_inner":
            raise AttributeError(name)
        return getattr(self._inner, name)

    @property
    def nominal_period(self) -> float:
        """Time between commands of the inner station [s]."""
        return self._inner.nominal_period

    def set_pose(self, context: Context, pose: np.ndarray) -> None:
        """Put the robot at rest with its true tool center at `pose`, (6,); `context` is the root context."""
        self._inner.set_pose(context, pose)

    def set_contact(self, context: Context, friction: float, modulus: float) -> None:
        """Multiply the friction and modulus of all contacts by factors until the next reset."""
        self._inner.set_contact(context, friction, modulus)

    def joint_range(self, margin: float) -> StateConstraints:
        """Return the constraints of the inner station's joints."""
        return self._inner.joint_range(margin)

    def disturb(self, context: Context, rng: np.random.Generator) -> Mapping[str, Any]:
        """Sample the inner station's disturbances at a reset, and return them by name."""
        return self._inner.disturb(context, rng)


class ContinuousStation(WrappedStation):
    """A station with the ports of an inner station, whose `pose` continues beyond ±π (`ContinuousPose`)."""

    def __init__(self, station: Station, near: np.ndarray):
        """Construct the station; the given `station` becomes its subsystem.

        `near` is the pose (6,) of which the first measured pose is the nearest equivalent, such as the first mean of a
        reference.

        Raises:
            InputError: If `near` is not a finite pose.
        """
        super().__init__(station)
        builder = DiagramBuilder()
        builder.AddNamedSystem("station", station)
        measured = ContinuousPose(near, station.control_period)
        add_system(builder, "continuous_pose", measured, pose=station.get_pose_output_port())
        for port in map(station.get_input_port, range(station.num_input_ports())):
            builder.ExportInput(port, port.get_name())
        for port in map(station.get_output_port, range(station.num_output_ports())):
            is_pose = port.get_name() == "pose"
            builder.ExportOutput(measured.get_continuous_pose_output_port() if is_pose else port, port.get_name())
        builder.BuildInto(self)


class TransformStation(WrappedStation):
    """A station with abstract ports, for diagrams whose signals are Drake's transforms and forces.

    It has the ports of the inner station, except that ``desired_transform``, an abstract `RigidTransform` X_TP,
    replaces ``desired_pose``. Additional outputs are ``transform``, the measured X_TP, and ``spatial_force``, the
    `SpatialForce` of the surroundings on the tool at P in the axes of T.
    """

    def __init__(self, station: Station):
        """Construct the station; the given `station` becomes its subsystem.

        Raises:
            InputError: If the poses of the station are not those of a body in space.
        """
        super().__init__(station)
        self.wraps_angles = station.wraps_angles
        builder = DiagramBuilder()
        builder.AddNamedSystem("station", station)
        for port in map(station.get_input_port, range(station.num_input_ports())):
            if port.get_name() != "desired_pose":
                builder.ExportInput(port, port.get_name())
        for port in map(station.get_output_port, range(station.num_output_ports())):
            builder.ExportOutput(port, port.get_name())
        desired = builder.AddNamedSystem("desired_pose", PoseFromTransform())
        builder.Connect(desired.get_pose_output_port(), station.get_desired_pose_input_port())
        builder.ExportInput(desired.get_transform_input_port(), "desired_transform")
        pose = add_system(builder, "transform", TransformFromPose(), pose=station.get_pose_output_port())
        builder.ExportOutput(pose.get_transform_output_port(), "transform")
        force = add_system(builder, "spatial_force", SpatialForceFromWrench(), wrench=station.get_wrench_output_port())
        builder.ExportOutput(force.get_spatial_force_output_port(), "spatial_force")
        builder.BuildInto(self)

    get_desired_transform_input_port = input_getter("desired_transform", "desired transform X_TP")
    get_transform_output_port = output_getter("transform", "measured transform X_TP")
    get_spatial_force_output_port = output_getter("spatial_force", "spatial force of the surroundings on the tool")
