"""Station whose ports of poses and wrenches are rigid transforms and spatial forces."""

import numpy as np
from pydrake.systems.framework import Context, DiagramBuilder

from guiderail.diagrams.stations.station import Station
from guiderail.diagrams.wiring import add_system
from guiderail.models.common.errors import InputError
from guiderail.models.common.transforms import POSE_SIZE
from guiderail.systems.conversions import PoseFromTransform, SpatialForceFromWrench, TransformFromPose
from guiderail.systems.support.declarations import input_getter, output_getter


class TransformStation(Station):
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
        super().__init__()
        if station.pose_size != POSE_SIZE:
            raise InputError(
                f"a rigid transform has {POSE_SIZE} coordinates, and poses of this station have {station.pose_size}: "
                "connect its vector ports"
            )
        for name in ("plant", "scene_graph"):
            if hasattr(station, name):
                setattr(self, name, getattr(station, name))
        self.control_period, self.wraps_angles, self._inner = station.control_period, station.wraps_angles, station
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

    def set_pose(self, context: Context, pose: np.ndarray) -> None:
        """Put the robot at rest with its tool center at `pose`, (6,); `context` is the root context."""
        self._inner.set_pose(context, pose)
