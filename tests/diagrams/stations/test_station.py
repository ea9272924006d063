"""Arguments that every simulated station refuses, and stations of joints."""

import numpy as np
import pytest
from pydrake.geometry import Box, Sphere
from pydrake.math import RigidTransform
from pydrake.multibody.plant import CoulombFriction
from pydrake.multibody.tree import JointActuatorIndex, PdControllerGains, PrismaticJoint, SpatialInertia
from pydrake.systems.analysis import Simulator

from guiderail.diagrams.envs.config import EnvConfig
from guiderail.diagrams.envs.make import make_station
from guiderail.diagrams.stations.arm import ArmStation
from guiderail.diagrams.stations.gantry import GantryStation
from guiderail.diagrams.stations.station import JointStation
from guiderail.diagrams.tasks.bnc_connector import BncWorkcell
from guiderail.models.common.errors import InputError

STATIONS = [("NarrowPassage", "plane"), ("Pouring", "pouring"), ("BncConnector", "gantry"), ("BncConnector", "arm")]


@pytest.mark.parametrize(("task", "name"), STATIONS)
def test_set_pose_raises_when_the_pose_is_not_finite(task, name):
    station = make_station(EnvConfig.resolve(task, {"station": name}))
    context = station.CreateDefaultContext()
    zero = np.zeros(station.pose_size)
    invalid = [np.r_[np.nan, zero[1:]], np.r_[zero[1:], -np.inf], zero[1:], [*zero, 0.0], ["a"] * len(zero), None]
    for pose in invalid:
        with pytest.raises(InputError, match=f"pose must be {station.pose_size} finite numbers, not"):
            station.set_pose(context, pose)


@pytest.mark.parametrize("station", [ArmStation, GantryStation])
@pytest.mark.parametrize("time_step", [0.0, -0.01, np.nan])
def test_station_raises_when_the_time_step_is_not_positive(station, time_step):
    with pytest.raises(InputError, match="whole multiple"):
        station(BncWorkcell(), time_step=time_step)


class Slider(JointStation):
    """Ball on one sliding joint in front of a wall at 0.1 m."""

    def add_robot(self, plant, workcell):
        robot, friction = plant.AddModelInstance("robot"), CoulombFriction()
        ball = plant.AddRigidBody("ball", robot, SpatialInertia.SolidSphereWithMass(0.1, 0.02))
        joint = plant.AddJoint(PrismaticJoint("x", plant.world_frame(), ball.body_frame(), [1.0, 0.0, 0.0]))
        plant.AddJointActuator("x", joint)
        if workcell["has_gains"]:
            plant.get_joint_actuator(JointActuatorIndex(0)).set_controller_gains(PdControllerGains(p=100.0, d=10.0))
        plant.RegisterCollisionGeometry(ball, RigidTransform(), Sphere(0.02), "ball", friction)
        X_WWall = RigidTransform([0.17, 0.0, 0.0])
        plant.RegisterCollisionGeometry(plant.world_body(), X_WWall, Box(0.1, 1.0, 1.0), "wall", friction)
        return robot if workcell["returns_robot"] else None


def test_joint_station_measures_the_force_against_a_wall():
    station = Slider({"has_gains": True, "returns_robot": True})
    simulator = Simulator(station)
    context = simulator.get_mutable_context()
    station.get_command_time_input_port().FixValue(context, [0.0])
    for command, force in ((0.05, 0.0), (0.2, 100.0 * 0.1)):
        station.get_desired_pose_input_port().FixValue(context, [command])
        simulator.AdvanceTo(context.get_time() + 1.0)
        assert station.get_contact_force_output_port().Eval(context)[0] == pytest.approx(force, abs=0.1)
        assert station.get_wrench_output_port().Eval(context)[0] == pytest.approx(-force, abs=0.1)


@pytest.mark.parametrize(
    ("has_gains", "returns_robot", "message"),
    [
        (False, True, r"each joint of Slider needs an actuator with PD gains: set_controller_gains"),
        (True, False, "add_robot of Slider must return the robot's model, not None"),
    ],
)
def test_joint_station_refuses_an_incomplete_robot(has_gains, returns_robot, message):
    with pytest.raises(InputError, match=message):
        Slider({"has_gains": has_gains, "returns_robot": returns_robot})
