"""Behavior of the arm station with every arm: compliance, tracking, insertion, gripping."""

import dataclasses

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.geometry import AddContactMaterial, AddRigidHydroelasticProperties, Box, ProximityProperties
from pydrake.math import RigidTransform
from pydrake.multibody.math import SpatialForce
from pydrake.multibody.plant import CoulombFriction, ExternallyAppliedSpatialForce
from pydrake.multibody.tree import SpatialInertia
from pydrake.systems.analysis import Simulator

from guiderail.diagrams.envs.make import make_env
from guiderail.diagrams.envs.recording import drive_along
from guiderail.diagrams.stations.arm import MID_TURN_POSE, ArmControllerPlant, ArmStation
from guiderail.diagrams.stations.station import Impedance
from guiderail.diagrams.tasks.bnc_connector.task import BncWorkcell
from guiderail.models.common.errors import InputError
from guiderail.models.common.transforms import MM
from guiderail.models.objects.bnc_connector.demonstrations import insert_and_lock
from guiderail.models.robots.robot import find_robot
from guiderail.systems.support.drake_multibody import pose_to_transform

WORKCELL = BncWorkcell()
ROBOTS = ("iiwa14", "panda", "ur5e")
STIFFNESS = np.array([1500.0, 1500.0, 1500.0, 30.0, 30.0, 30.0])  # of the station, force first


class Held:
    """Arm station with its jack far away, which holds a pose while a wrench acts on its tool."""

    def __init__(self, robot, pose, *, impedance=None):
        self.station = ArmStation(WORKCELL, impedance or Impedance(), robot=robot)
        self.plant, self.arm = self.station.plant, self.station.arm
        self.simulator = Simulator(self.station)
        self.context = self.simulator.get_mutable_context()
        self.plant_context = self.plant.GetMyMutableContextFromRoot(self.context)
        WORKCELL.set_fixture_offset(self.plant, self.plant_context, RigidTransform([0.0, 0.0, -0.5]))
        self.push(np.zeros(6))
        self.desired = self.station.get_desired_pose_input_port().FixValue(self.context, pose)
        self.station.set_pose(self.context, pose)
        self.simulator.Initialize()

    def push(self, wrench):
        applied = ExternallyAppliedSpatialForce()
        applied.body_index = self.plant.GetBodyByName("tool_center").index()
        applied.p_BoBq_B = np.zeros(3)
        applied.F_Bq_W = SpatialForce(tau=np.array(wrench[3:], dtype=float), f=np.array(wrench[:3], dtype=float))
        self.plant.get_applied_spatial_force_input_port().FixValue(self.plant_context, Value([applied]))

    def advance(self, seconds):
        self.simulator.AdvanceTo(self.context.get_time() + seconds)

    def X_TP(self):
        return self.arm.tool_center.CalcPose(self.plant_context, self.arm.target)

    def put(self, q):
        """Put the arm at rest in a posture, which it holds."""
        self.plant.SetPositions(self.plant_context, self.arm.model, q)
        pose = self.station.get_pose_output_port().Eval(self.station.GetMyContextFromRoot(self.context))
        self.desired.GetMutableData().set_value(pose)
        return pose.copy()

    @property
    def speeds(self):
        return np.abs(self.plant.GetVelocities(self.plant_context, self.arm.model))


def displacement(before, after):
    turn = (after.rotation() @ before.rotation().inverse()).ToAngleAxis()
    return np.concatenate([after.translation() - before.translation(), turn.angle() * turn.axis()])


@pytest.mark.parametrize("robot", ROBOTS)
def test_arm_inserts_and_locks_at_the_nominal_pose(robot):
    times, motion = insert_and_lock()
    driven, recording = drive_along(ArmStation(WORKCELL, robot=robot), times, motion)
    X = WORKCELL.workpiece_in_target(driven.station.plant, driven.plant_context)
    assert WORKCELL.is_locked(X)
    assert np.abs(X.translation()).max() < 0.3 * MM
    assert recording["contact_force"].max() < 15.0
    assert not recording["saturation"].any()
    # In the first second, before contact, the tracking error is small.
    assert np.abs(recording["pose"] - recording["desired_pose"])[:50, :3].max() < 1.5 * MM


@pytest.mark.parametrize("robot", ROBOTS)
def test_static_displacement_equals_compliance_times_wrench(robot):
    held = Held(robot, np.array([-0.10, 0.12, 0.15, 1.2, 0.2, -0.3]))
    before = held.X_TP()
    wrench = np.array([6.0, -4.0, 8.0, 0.3, -0.2, 0.4])
    held.push(wrench)
    held.advance(4.0)
    moved, expected = displacement(before, held.X_TP()), wrench / STIFFNESS
    assert np.linalg.norm(moved[:3] - expected[:3]) < 0.02 * np.linalg.norm(expected[:3])
    assert np.linalg.norm(moved[3:] - expected[3:]) < 0.02 * np.linalg.norm(expected[3:])


@pytest.mark.parametrize("robot", ROBOTS)
def test_arm_rests_after_a_push_at_the_plant_time_step(robot):
    """With a tenth of the damping, where a controller that is too slow would oscillate."""
    held = Held(robot, MID_TURN_POSE, impedance=Impedance(damping_ratio=0.1))
    before = held.X_TP()
    held.push([15.0, -10.0, 12.0, 0.5, -0.5, 0.5])
    held.advance(0.3)
    held.push(np.zeros(6))
    swings = []
    for _ in range(40):
        held.advance(0.1)
        swings.append(held.speeds.max())
    assert max(swings[:5]) > 0.05
    assert max(swings[-5:]) < 0.02 * max(swings[:5])
    assert np.abs(displacement(before, held.X_TP())).max() < 1e-3


@pytest.mark.parametrize("robot", ROBOTS)
def test_quarter_turn_is_centered_in_the_last_joints_range(robot):
    known = ArmControllerPlant(WORKCELL, robot)
    lower, upper = known.plant.GetPositionLowerLimits()[-1], known.plant.GetPositionUpperLimits()[-1]
    last = [known.solve(MID_TURN_POSE + [0, 0, 0, turn, 0, 0], known.posture)[-1] for turn in (-np.pi / 4, np.pi / 4)]
    assert abs(known.posture[-1] - 0.5 * (lower + upper)) < np.deg2rad(15.0)
    # A redundant arm also moves its elbow, so its last joint turns less.
    assert np.deg2rad(70.0) < abs(last[1] - last[0]) < np.deg2rad(91.0)
    assert min(min(last) - lower, upper - max(last)) > np.deg2rad(90.0)


# Aligned wrist axes, and a stretched arm, where an arm of six joints loses a direction.
WRIST, ELBOW = np.array([-0.24, -1.4, 1.85, -2.0, 0.0, 0.0]), np.array([-0.24, -1.4, 0.0, -2.0, -1.57, 0.0])


@pytest.mark.parametrize("singular", [WRIST, ELBOW])
def test_six_joint_arm_rests_in_a_singular_posture(singular):
    held = Held("ur5e", MID_TURN_POSE)
    held.put(singular)
    held.push([8.0, 5.0, -6.0, 0.3, 0.3, -0.3])
    speeds = []
    for _ in range(20):
        held.advance(0.05)
        speeds.append(held.speeds.max())
    held.push(np.zeros(6))
    held.advance(6.0)
    assert max(speeds) < 2.0
    assert held.speeds.max() < 0.03


def test_torques_are_smooth_at_the_end_of_the_workspace():
    """With a command 20 cm outside of the workspace, torques change little from step to step.

    With the plain inverse of the inertia at the tool they jump by more than 10 Nm, back and forth.
    """
    held = Held("ur5e", MID_TURN_POSE)
    nearly = np.array([-0.24, -1.4, 0.3, -2.0, -1.57, 0.0])
    start = held.put(nearly)
    controller = held.station.GetSubsystemByName("controller")
    torque = controller.get_generalized_force_output_port()
    context = controller.GetMyContextFromRoot(held.context)
    torques = []
    for step in range(600):
        away = min(1.0, step / 200) * np.array([0.1, 0.0, 0.15, 0.0, 0.0, 0.0])
        held.desired.GetMutableData().set_value(start + away)
        held.advance(0.01)
        torques.append(torque.Eval(context).copy())
    assert np.abs(np.diff(torques, axis=0)).max() < 2.0
    assert held.speeds.max() < 0.05


@pytest.mark.parametrize("robot", ROBOTS)
def test_ports_are_equal_and_reset_is_exact(robot):
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
    assert env.task.diagram.GetSubsystemByName("station").plant.HasBodyNamed("ur5e_forearm")
    with pytest.raises(InputError, match="did you mean ur5e"):
        make_env("GridClamp", station="arm", robot="ur5")
    with pytest.raises(InputError, match="no option 'robot' here: it is an option of station='arm'"):
        make_env("GridClamp", robot="panda")


def test_station_raises_when_the_model_has_other_joints():
    fewer = dataclasses.replace(
        find_robot("iiwa14"), joints=find_robot("iiwa14").joints[:6], home=(0.0,) * 6, drives=None, level_posture=None
    )
    with pytest.raises(InputError, match="iiwa_joint_7"):
        ArmStation(WORKCELL, robot=fewer)


class BlockOnATable:
    """Workcell with a block between the fingers of a gripper."""

    X_WT = RigidTransform([0.5, 0.0, 0.2])
    WEIGHT = 0.2 * 9.81

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
        instance = plant.AddModelInstance("nothing")
        nothing = plant.AddRigidBody("nothing", instance, SpatialInertia.SolidSphereWithMass(1e-3, 0.005))
        plant.WeldFrames(tool_center, nothing.body_frame())
        return nothing

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

    simulator.AdvanceTo(0.2)  # open, because the port is not connected
    assert state.Eval(context)[0] == pytest.approx(0.04, abs=1e-4)
    fingers = station.get_gripper_position_input_port().FixValue(context, [0.0])
    simulator.AdvanceTo(0.7)
    assert state.Eval(context)[0] == pytest.approx(0.02, abs=5e-4)  # width of the block
    force = station.plant.get_net_actuation_output_port(station.arm.tool_model).Eval(plant_context)
    np.testing.assert_allclose(force, [-60.0], atol=1e-6)  # limit of the motor; the drive's is 100 N
    desired.GetMutableData().set_value([0.0, 0.0, 0.1, 0.0, 0.0, 0.0])
    simulator.AdvanceTo(2.2)
    fingers.GetMutableData().set_value([np.nan])  # NaN: it continues to grip
    simulator.AdvanceTo(2.5)
    assert block_height() > 0.28
    wrench = station.get_wrench_output_port().Eval(context)
    assert wrench[2] == pytest.approx(-workcell.WEIGHT, abs=0.05)
    assert np.abs(wrench[:2]).max() < 0.05
    fingers.GetMutableData().set_value([1.0])  # above the upper limit
    simulator.AdvanceTo(3.2)
    assert state.Eval(context)[0] == pytest.approx(0.04, abs=1e-3)
    assert block_height() < 0.21


def test_rigid_tool_has_no_gripper_ports():
    station = ArmStation(WORKCELL)
    assert not station.HasInputPort("gripper_position")
    assert not station.HasOutputPort("gripper_state")


def test_pose_equals_the_transform_in_the_workspace():
    """The tool center has the commanded pose, tilted or not, with a tool that is mounted rotated."""
    known = ArmControllerPlant(WORKCELL, "ur5e")
    context = known.plant.CreateDefaultContext()
    pose = np.array([0.03, -0.02, 0.08, 0.9, 0.15, -0.2])
    known.plant.SetPositions(context, known.solve(pose, known.posture))
    X = known.arm.tool_center.CalcPose(context, known.arm.target)
    np.testing.assert_allclose(X.GetAsMatrix4(), pose_to_transform(pose).GetAsMatrix4(), atol=1e-9)
