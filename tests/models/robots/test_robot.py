"""Data of robots and end effectors: registry, refusals, and comparison with published values."""

import dataclasses
import re

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant

from guiderail.models.common.errors import InputError
from guiderail.models.common.registry import Registry
from guiderail.models.robots.mounting import add_robot
from guiderail.models.robots.robot import (
    JointDrives,
    end_effector_names,
    find_end_effector,
    find_robot,
    register_robot,
    robot_names,
)

ROBOTS = ("iiwa14", "panda", "ur5e")


class Arm:
    """Plant of a robot without a tool."""

    def __init__(self, name):
        self.robot = find_robot(name)
        self.plant = MultibodyPlant(0.0)
        self.mounted = add_robot(self.plant, self.robot)
        self.plant.Finalize()
        self.context = self.plant.CreateDefaultContext()

    def flange(self, q):
        self.plant.SetPositions(self.context, q)
        return self.mounted.flange.CalcPoseInWorld(self.context)


@pytest.fixture(scope="module", params=ROBOTS)
def arm(request):
    return Arm(request.param)


def test_registry_contains_the_robots_of_the_package():
    assert tuple(robot_names()) == ROBOTS
    assert end_effector_names() == ["connector_tool", "parallel_gripper"]
    assert find_robot("panda") is find_robot(find_robot("panda"))


@pytest.mark.parametrize(("name", "suggestion"), [("iiwa", "iiwa14"), ("Panda", "panda"), ("ur5", "ur5e")])
def test_find_robot_suggests_the_nearest_name(name, suggestion):
    with pytest.raises(InputError, match=f"no robot '{name}': did you mean {suggestion}"):
        find_robot(name)


def test_find_end_effector_suggests_the_nearest_name():
    with pytest.raises(InputError, match="no end effector 'gripper': did you mean parallel_gripper"):
        find_end_effector("gripper")


@pytest.mark.parametrize("robot", [None, type("Arm", (), {"name": "arm"})])
def test_register_robot_refuses_other_objects(robot):
    with pytest.raises(InputError, match="a robot is registered as a Robot object, not"):
        register_robot(robot)


def test_register_robot_refuses_a_second_robot_of_a_name():
    with pytest.raises(InputError, match="panda"):
        register_robot(dataclasses.replace(find_robot("panda"), title="another"))


def test_entry_point_of_an_installed_package_adds_a_robot(tmp_path, monkeypatch):
    (tmp_path / "laboratory.py").write_text(
        "import dataclasses\n"
        "from guiderail.models.robots.robot import find_robot\n"
        "TWIN = dataclasses.replace(find_robot('ur5e'), name='twin')\n"
    )
    information = tmp_path / "laboratory-1.0.dist-info"
    information.mkdir()
    (information / "METADATA").write_text("Metadata-Version: 2.1\nName: laboratory\nVersion: 1.0\n")
    (information / "entry_points.txt").write_text("[guiderail]\nrobot:twin = laboratory:TWIN\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    robots = Registry("robot", plugin="robot")
    assert {*robots.names()} == {"twin", *ROBOTS}
    assert robots.get("twin").num_joints == 6


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        ({"joints": ("a", "b")}, "six joints or more"),
        ({"joints": ("a",) * 6}, "each once"),
        ({"apparent_rotor_inertia": 0.0}, "apparent_rotor_inertia"),
        ({"apparent_rotor_inertia": 1.5}, "apparent_rotor_inertia"),
    ],
)
def test_robot_refuses_invalid_data(fields, reason):
    with pytest.raises(InputError, match=reason):
        dataclasses.replace(find_robot("ur5e"), **fields)


@pytest.mark.parametrize(
    ("fields", "reason"), [({"opening": {}}, "opening"), ({"opening": {"left_finger_joint": np.inf}}, "opening")]
)
def test_end_effector_refuses_invalid_data(fields, reason):
    with pytest.raises(InputError, match=reason):
        dataclasses.replace(find_end_effector("parallel_gripper"), **fields)


def test_drives_are_critically_damped():
    (damping,) = JointDrives((400.0,), (0.25,)).damping
    assert np.roots([0.25, damping, 400.0]) == pytest.approx([-40.0, -40.0])


# Denavit-Hartenberg parameters a [m], d [m] and α [rad] of each joint. In Craig's convention, a and α are applied
# before the joint's rotation.
CRAIG = {
    "panda": [
        (0.0, 0.333, 0.0),
        (0.0, 0.0, -np.pi / 2),
        (0.0, 0.316, np.pi / 2),
        (0.0825, 0.0, np.pi / 2),
        (-0.0825, 0.384, -np.pi / 2),
        (0.0, 0.0, np.pi / 2),
        (0.088, 0.0, np.pi / 2),
    ]
}
CLASSIC = {
    "ur5e": [
        (0.0, 0.1625, np.pi / 2),
        (-0.425, 0.0, 0.0),
        (-0.3922, 0.0, 0.0),
        (0.0, 0.1333, np.pi / 2),
        (0.0, 0.0997, -np.pi / 2),
        (0.0, 0.0996, 0.0),
    ]
}


def dh_transform(a, d, alpha, theta, is_craig):
    """Return the transform of a joint with Denavit-Hartenberg parameters at the angle `theta` [rad]."""
    turn = RigidTransform(RotationMatrix.MakeZRotation(theta), [0.0, 0.0, d])
    twist = RigidTransform(RotationMatrix.MakeXRotation(alpha), [a, 0.0, 0.0])
    return twist @ turn if is_craig else turn @ twist


def test_flange_pose_equals_published_kinematics(arm):
    name = arm.robot.name
    if name == "iiwa14":  # height of the stretched arm in the data sheet [m]
        np.testing.assert_allclose(arm.flange(np.zeros(7)).translation(), [0.0, 0.0, 1.306], atol=1e-9)
        return
    rng = np.random.default_rng(0)
    for _ in range(5):
        q = rng.uniform(-1.5, 1.5, arm.robot.num_joints)
        # The model's base frame of the UR5e is rotated by half a turn about z.
        X = RigidTransform(RotationMatrix.MakeZRotation(np.pi if name == "ur5e" else 0.0), [0.0, 0.0, 0.0])
        for row, theta in zip((CRAIG | CLASSIC)[name], q, strict=True):
            X = X @ dh_transform(*row, theta, is_craig=name in CRAIG)
        if name == "panda":
            X = X @ RigidTransform([0.0, 0.0, 0.107])
        np.testing.assert_allclose(arm.flange(q).GetAsMatrix4(), X.GetAsMatrix4(), atol=1e-9)


PUBLISHED_LIMITS = {
    "iiwa14": (
        np.deg2rad([170, 120, 170, 120, 170, 120, 175]),
        np.deg2rad([85, 85, 100, 75, 130, 135, 135]),
        [320, 320, 176, 176, 110, 40, 40],
    ),
    "panda": ([2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973], [2.175] * 4 + [2.61] * 3, [87] * 4 + [12] * 3),
    "ur5e": ([2 * np.pi] * 6, [np.pi] * 6, [150] * 3 + [28] * 3),
}


def test_joint_limits_equal_published_limits(arm):
    upper, speed, effort = PUBLISHED_LIMITS[arm.robot.name]
    np.testing.assert_allclose(arm.plant.GetPositionUpperLimits(), upper, atol=1e-5)
    np.testing.assert_allclose(arm.plant.GetVelocityUpperLimits(), speed, atol=1e-5)
    np.testing.assert_allclose(arm.plant.GetEffortUpperLimits(), effort)
    if arm.robot.name == "panda":
        lower = [-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973]
        np.testing.assert_allclose(arm.plant.GetPositionLowerLimits(), lower, atol=1e-9)


def test_panda_gravity_equals_the_identified_model():
    """The gravity torques are those of the dynamic coefficients of Gaz et al., at Franka's ready posture.

    The feasible masses and centers of mass computed from these coefficients reproduce the torques to 0.15 Nm.
    """
    arm = Arm("panda")
    arm.plant.SetPositions(arm.context, [0, -np.pi / 4, 0, -3 * np.pi / 4, 0, np.pi / 2, np.pi / 4])
    torque = -arm.plant.CalcGravityGeneralizedForces(arm.context)
    np.testing.assert_allclose(torque, [0.0, -1.7388, -0.6683, 18.5240, 0.7158, 1.6714, 0.0], atol=0.15)


def test_ur5e_gravity_equals_that_of_the_published_masses():
    """At zero, the arm is stretched out, and the shoulder torque is g times the sum of masses times distances."""
    arm = Arm("ur5e")
    arm.plant.SetPositions(arm.context, np.zeros(6))
    masses = np.array([8.058, 2.846, 1.37, 1.3, 0.365])  # [kg]
    distances = np.array([0.2125, 0.425 + 0.2422, 0.8172, 0.8172, 0.8172])  # from the shoulder [m]
    shoulder = -arm.plant.CalcGravityGeneralizedForces(arm.context)[1]
    assert abs(shoulder) == pytest.approx(9.81 * masses @ distances, rel=1e-4)


def test_home_is_regular_within_limits_and_points_down(arm):
    robot, plant = arm.robot, arm.plant
    home = np.array(robot.home)
    lower, upper = plant.GetPositionLowerLimits(), plant.GetPositionUpperLimits()
    assert (home > lower + 0.3).all()
    assert (home < upper - 0.3).all()
    X = arm.flange(home)
    assert X.rotation().matrix()[2, 2] < -0.99
    assert X.translation()[0] > 0.3


def test_tool_turn_aligns_the_tool_with_the_base_at_home(arm):
    """The tool's yaw is within 16 degrees of zero when the last joint is in the middle of its range."""
    robot, plant = arm.robot, arm.plant
    q = np.array(robot.home)
    q[-1] = 0.5 * (plant.GetPositionLowerLimits()[-1] + plant.GetPositionUpperLimits()[-1])
    R = arm.flange(q).rotation() @ RotationMatrix.MakeZRotation(robot.tool_turn)
    assert abs(np.rad2deg(RollPitchYaw(R @ RotationMatrix.MakeXRotation(np.pi)).yaw_angle())) < 16.0


def test_robot_has_a_source_of_its_data(arm):
    assert len(arm.robot.source) > 40


def test_robot_models_reference_no_remote_files(arm):
    text = arm.robot.model.read_text()
    assert not re.search(r"package:|https?:(?!//drake\.mit\.edu)|mesh ", text)
