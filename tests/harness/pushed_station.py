"""Station that holds a pose in free space while a wrench acts on its tool."""

import numpy as np
from pydrake.common.value import Value
from pydrake.math import RigidTransform
from pydrake.multibody.math import SpatialForce
from pydrake.multibody.plant import ExternallyAppliedSpatialForce
from pydrake.systems.analysis import Simulator


def push_robot(env, displacement):
    """Displace the robot of an environment, as a push by an operator between two control steps would."""
    station = env.diagram.diagram.GetSubsystemByName("station")
    context = env.simulator.get_mutable_context()
    pose = station.get_pose_output_port().Eval(station.GetMyContextFromRoot(context))
    station.set_pose(context, pose + displacement)


class PushedStation:
    """Simulated station with the connector's jack 0.5 m below its nominal pose.

    Attributes:
        desired_pose: Fixed value of the station's desired pose, (6,).
    """

    def __init__(self, station, workcell, pose):
        self.station, self.plant = station, station.plant
        self.simulator = Simulator(station)
        self.context = self.simulator.get_mutable_context()
        self.plant_context = self.plant.GetMyMutableContextFromRoot(self.context)
        workcell.set_fixture_offset(self.plant, self.plant_context, RigidTransform([0.0, 0.0, -0.5]))
        self.push(np.zeros(6))
        self.desired_pose = station.get_desired_pose_input_port().FixValue(self.context, pose)
        station.set_pose(self.context, pose)
        self.simulator.Initialize()

    def push(self, wrench):
        """Apply a force [N] and a torque [Nm], (6,) in the world frame, to the tool center until the next call."""
        applied = ExternallyAppliedSpatialForce()
        applied.body_index = self.plant.GetBodyByName("tool_center").index()
        applied.p_BoBq_B = np.zeros(3)
        applied.F_Bq_W = SpatialForce(tau=np.array(wrench[3:], dtype=float), f=np.array(wrench[:3], dtype=float))
        self.plant.get_applied_spatial_force_input_port().FixValue(self.plant_context, Value([applied]))

    def advance(self, seconds):
        self.simulator.AdvanceTo(self.context.get_time() + seconds)

    @property
    def max_speed(self):
        """Largest joint speed [m/s] or [rad/s]."""
        return np.abs(self.plant.GetVelocities(self.plant_context)).max()
