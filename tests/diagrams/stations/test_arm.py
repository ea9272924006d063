"""Behavior of the arm station with every arm: compliance, tracking, insertion, gripping."""

import dataclasses

import numpy as np
import pytest
from pushed_station import PushedStation
from pydrake.geometry import AddContactMaterial, AddRigidHydroelasticProperties, Box, ProximityProperties
from pydrake.math import RigidTransform
from pydrake.multibody.plant import CoulombFriction
from pydrake.multibody.tree import SpatialInertia
from pydrake.systems.analysis import Simulator

from guiderail.diagrams.envs.make import make_env
from guiderail.diagrams.envs.recording import drive_along
from guiderail.diagrams.stations.arm import MID_TURN_POSE, ArmControllerPlant, ArmStation
from guiderail.diagrams.stations.station import Impedance
from guiderail.diagrams.tasks.bnc_connector import BncWorkcell
from guiderail.models.common.errors import InputError
from guiderail.models.common.transforms import MM
from guiderail.models.robots.robot import find_robot
from guiderail.systems.support.drake_multibody import pose_to_transform
from oracles.connector import insert_and_lock

WORKCELL = BncWorkcell()
ROBOTS = ("iiwa14", "panda", "ur5e")
STIFFNESS = np.array([1500.0, 1500.0, 1500.0, 30.0, 30.0, 30.0])  # of the station: x, y, z [N/m], rotations [Nm/rad]


class PushedArm(PushedStation):
    """Arm station that holds a pose while a wrench acts on its tool."""

    def __init__(self, robot, pose, *, impedance=None):
        super().__init__(ArmStation(WORKCELL, impedance or Impedance(), robot=robot), WORKCELL, pose)

    def X_TP(self):
        arm = self.station.arm
        return arm.tool_center.CalcPose(self.plant_context, arm.target)

    def set_positions(self, q):
        """Put the arm at rest at joint positions [rad], command the tool's pose there, and return this pose, (6,)."""
        self.plant.SetPositions(self.plant_context, self.station.arm.model, q)
        pose = self.station.get_pose_output_port().Eval(self.station.GetMyContextFromRoot(self.context))
        self.desired_pose.GetMutableData().set_value(pose)
        return pose.copy()


def displacement(before, after):
    """Return translation [m] and rotation vector [rad] from one pose to another, (6,)."""
    rotation = (after.rotation() @ before.rotation().inverse()).ToAngleAxis()
    return np.concatenate([after.translation() - before.translation(), rotation.angle() * rotation.axis()])


@pytest.mark.parametrize("robot", ROBOTS)
def test_arm_inserts_and_locks_at_the_nominal_pose(robot):
    times, motion = insert_and_lock()
    driven, recording = drive_along(ArmStation(WORKCELL, robot=robot), times, motion)
    X = WORKCELL.workpiece_in_target(driven.station.plant, driven.plant_context)
    assert WORKCELL.is_locked(X)
    assert np.abs(X.translation()).max() < 0.3 * MM
    assert recording["impedance_force"].max() < 15.0
    assert not recording["saturation"].any()
    # In the first second, the plug moves in free space.
    assert np.abs(recording["pose"] - recording["desired_pose"])[:50, :3].max() < 1.5 * MM


@pytest.mark.parametrize("robot", ROBOTS)
def test_static_displacement_equals_compliance_times_wrench(robot):
    arm = PushedArm(robot, np.array([-0.10, 0.12, 0.15, 1.2, 0.2, -0.3]))
    before = arm.X_TP()
    wrench = np.array([6.0, -4.0, 8.0, 0.3, -0.2, 0.4])
    arm.push(wrench)
    arm.advance(2.0)
    measured, expected = displacement(before, arm.X_TP()), wrench / STIFFNESS
    assert np.linalg.norm(measured[:3] - expected[:3]) < 0.02 * np.linalg.norm(expected[:3])
    assert np.linalg.norm(measured[3:] - expected[3:]) < 0.02 * np.linalg.norm(expected[3:])


@pytest.mark.parametrize("robot", ROBOTS)
def test_arm_rests_after_a_push_at_the_plant_time_step(robot):
    """At a tenth of the critical damping, a controller with too long a period would oscillate without end."""
    arm = PushedArm(robot, MID_TURN_POSE, impedance=Impedance(damping_ratio=0.1))
    before = arm.X_TP()
    arm.push([15.0, -10.0, 12.0, 0.5, -0.5, 0.5])
    arm.advance(0.3)
    arm.push(np.zeros(6))
    speeds = []
    for _ in range(40):
        arm.advance(0.1)
        speeds.append(arm.max_speed)
    assert max(speeds[:5]) > 0.05
    assert max(speeds[-5:]) < 0.02 * max(speeds[:5])
    assert np.abs(displacement(before, arm.X_TP())).max() < 1e-3


@pytest.mark.parametrize("robot", ROBOTS)
def test_quarter_turn_is_centered_in_the_last_joint_range(robot):
    model = ArmControllerPlant(WORKCELL, robot)
    lower, upper = model.plant.GetPositionLowerLimits()[-1], model.plant.GetPositionUpperLimits()[-1]
    ends = [MID_TURN_POSE + [0, 0, 0, yaw, 0, 0] for yaw in (-np.pi / 4, np.pi / 4)]
    last_joint = [model.solve(pose, model.posture)[-1] for pose in ends]
    assert abs(model.posture[-1] - 0.5 * (lower + upper)) < np.deg2rad(15.0)
    # A redundant arm also moves its elbow, so its last joint turns by less than 90°.
    assert np.deg2rad(70.0) < abs(last_joint[1] - last_joint[0]) < np.deg2rad(91.0)
    assert min(min(last_joint) - lower, upper - max(last_joint)) > np.deg2rad(90.0)


# Singular joint positions [rad] of the UR5e: parallel wrist axes, and a stretched elbow.
WRIST, ELBOW = np.array([-0.24, -1.4, 1.85, -2.0, 0.0, 0.0]), np.array([-0.24, -1.4, 0.0, -2.0, -1.57, 0.0])


@pytest.mark.parametrize("singular", [WRIST, ELBOW], ids=["wrist", "elbow"])
def test_six_joint_arm_rests_in_a_singular_posture(singular):
    arm = PushedArm("ur5e", MID_TURN_POSE)
    arm.set_positions(singular)
    arm.push([8.0, 5.0, -6.0, 0.3, 0.3, -0.3])
    speeds = []
    for _ in range(20):
        arm.advance(0.05)
        speeds.append(arm.max_speed)
    arm.push(np.zeros(6))
    arm.advance(6.0)
    assert max(speeds) < 2.0
    assert arm.max_speed < 0.03


def test_torques_are_smooth_at_the_workspace_boundary():
    """The desired pose leaves the workspace within 2 s and stays outside.

    If the controller inverted the inertia at the tool without damping, torques would alternate by more than 10 Nm.
    """
    arm = PushedArm("ur5e", MID_TURN_POSE)
    almost_stretched = np.array([-0.24, -1.4, 0.3, -2.0, -1.57, 0.0])
    start = arm.set_positions(almost_stretched)
    controller = arm.station.GetSubsystemByName("controller")
    torque = controller.get_generalized_force_output_port()
    context = controller.GetMyContextFromRoot(arm.context)
    torques = []
    for step in range(600):
        offset = min(1.0, step / 200) * np.array([0.1, 0.0, 0.15, 0.0, 0.0, 0.0])
        arm.desired_pose.GetMutableData().set_value(start + offset)
        arm.advance(0.01)
        torques.append(torque.Eval(context).copy())
    assert np.abs(np.diff(torques, axis=0)).max() < 2.0
    assert arm.max_speed < 0.05


@pytest.mark.parametrize("robot", ROBOTS)
def test_arm_has_two_input_ports_and_set_pose_is_exact(robot):
    station = ArmStation(WORKCELL, robot=robot)
    assert [station.get_input_port(i).get_name() for i in range(station.num_input_ports())] == [
        "desired_pose",
        "command_time",
    ]
    context = station.CreateDefaultContext()
    rng = np.random.default_rng(0)
    for _ in range(10):
        pose = rng.uniform(-1, 1, 6) * [0.05, 0.05, 0.05, 0.7, 0.2, 0.2] + [0, 0, 0.05, np.pi / 4, 0, 0]
        station.set_pose(context, pose)
        np.testing.assert_allclose(station.get_pose_output_port().Eval(context), pose, atol=1e-9)


def test_environment_selects_robot_by_name():
    env = make_env("GridClamp", station="arm", robot="ur5e")
    assert env.diagram.diagram.GetSubsystemByName("station").plant.HasBodyNamed("ur5e_forearm")
    with pytest.raises(InputError, match="did you mean ur5e"):
        make_env("GridClamp", station="arm", robot="ur5")
    with pytest.raises(InputError, match="no option 'robot' here: it is an option of station='arm'"):
        make_env("GridClamp", robot="panda")


def test_station_raises_when_a_joint_is_not_named():
    without_last_joint = dataclasses.replace(
        find_robot("iiwa14"), joints=find_robot("iiwa14").joints[:6], home=(0.0,) * 6, drives=None, level_posture=None
    )
    with pytest.raises(InputError, match="iiwa_joint_7"):
        ArmStation(WORKCELL, robot=without_last_joint)


class BlockOnATable:
    """Workcell with a block on a table, between the fingers of a gripper, and without a workpiece on the tool."""

    X_WT = RigidTransform([0.5, 0.0, 0.2])
    WEIGHT = 0.2 * 9.81  # of the block [N]

    def add_fixture(self, plant):
        friction = CoulombFriction(0.5, 0.5)
        plant.RegisterCollisionGeometry(
            plant.world_body(), RigidTransform([0.5, 0.0, 0.155]), Box(0.3, 0.3, 0.05), "table", friction
        )
        self.block = plant.AddRigidBody(
            "block", plant.AddModelInstance("block"), SpatialInertia.SolidBoxWithMass(0.2, 0.04, 0.04, 0.04)
        )
        material = ProximityProperties()
        AddRigidHydroelasticProperties(1.0, material)
        AddContactMaterial(friction=CoulombFriction(0.8, 0.8), properties=material)
        plant.RegisterCollisionGeometry(self.block, RigidTransform(), Box(0.04, 0.04, 0.04), "block", material)
        plant.SetDefaultFloatingBaseBodyPose(self.block, RigidTransform([0.5, 0.0, 0.2]))

    def add_workpiece(self, plant, tool_center):
        instance = plant.AddModelInstance("placeholder")
        placeholder = plant.AddRigidBody("placeholder", instance, SpatialInertia.SolidSphereWithMass(1e-3, 0.005))
        plant.WeldFrames(tool_center, placeholder.body_frame())
        return placeholder

    def filter_contacts(self, plant, scene_graph):
        pass


@pytest.mark.parametrize("robot", ["panda", "ur5e"])
def test_gripper_grips_lifts_and_releases(robot):
    workcell = BlockOnATable()
    station = ArmStation(workcell, robot=robot, end_effector="parallel_gripper")
    simulator = Simulator(station)
    context = simulator.get_mutable_context()
    plant_context = station.plant.GetMyContextFromRoot(context)
    station.set_pose(context, np.zeros(6))
    desired = station.get_desired_pose_input_port().FixValue(context, np.zeros(6))
    state = station.get_gripper_state_output_port()
    simulator.Initialize()
    np.testing.assert_allclose(state.Eval(context), [0.04, 0.0])

    def block_height():
        return workcell.block.EvalPoseInWorld(plant_context).translation()[2]

    simulator.AdvanceTo(0.2)  # open by default, while the input port has no value
    assert state.Eval(context)[0] == pytest.approx(0.04, abs=1e-4)
    fingers = station.get_gripper_position_input_port().FixValue(context, [0.0])
    simulator.AdvanceTo(0.7)
    assert state.Eval(context)[0] == pytest.approx(0.02, abs=5e-4)  # half of the block's width [m]
    force = station.plant.get_net_actuation_output_port(station.arm.tool_model).Eval(plant_context)
    np.testing.assert_allclose(force, [-60.0], atol=1e-6)  # effort limit of the finger's motor [N]
    desired.GetMutableData().set_value([0.0, 0.0, 0.1, 0.0, 0.0, 0.0])
    simulator.AdvanceTo(2.2)
    fingers.GetMutableData().set_value([np.nan])  # NaN leaves the last command unchanged
    simulator.AdvanceTo(2.5)
    assert block_height() > 0.28
    wrench = station.get_wrench_output_port().Eval(context)
    assert wrench[2] == pytest.approx(-workcell.WEIGHT, abs=0.05)
    assert np.abs(wrench[:2]).max() < 0.05
    fingers.GetMutableData().set_value([1.0])  # clipped to the upper limit of 0.04 m
    simulator.AdvanceTo(3.2)
    assert state.Eval(context)[0] == pytest.approx(0.04, abs=1e-3)
    assert block_height() < 0.21


def test_rigid_tool_has_no_gripper_ports():
    station = ArmStation(WORKCELL)
    assert not station.HasInputPort("gripper_position")
    assert not station.HasOutputPort("gripper_state")


def test_inverse_kinematics_reaches_a_tilted_pose():
    """The tool is mounted with a rotation on the flange of the UR5e."""
    model = ArmControllerPlant(WORKCELL, "ur5e")
    context = model.plant.CreateDefaultContext()
    pose = np.array([0.03, -0.02, 0.08, 0.9, 0.15, -0.2])
    model.plant.SetPositions(context, model.solve(pose, model.posture))
    X = model.arm.tool_center.CalcPose(context, model.arm.target)
    np.testing.assert_allclose(X.GetAsMatrix4(), pose_to_transform(pose).GetAsMatrix4(), atol=1e-9)
