"""Mounting of robots and end effectors in a plant: refusals, model files, and rigid models for a controller."""

import dataclasses
import re

import numpy as np
import pytest
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.analysis import Simulator

from guiderail.models.common.errors import InputError
from guiderail.models.common.parsing import add_models
from guiderail.models.robots.mounting import SLIP, add_end_effector, add_joint_friction, add_robot, lighten_rotors
from guiderail.models.robots.robot import find_end_effector, find_robot

UR5E = find_robot("ur5e")
GRIPPER = find_end_effector("parallel_gripper")


def mount(end_effector, robot=UR5E, **options):
    """Return a finalized plant, the arm and the end effector."""
    plant = MultibodyPlant(0.005)
    arm = add_robot(plant, robot)
    tool = add_end_effector(plant, robot, arm, end_effector, **options)
    plant.Finalize()
    return plant, arm, tool


def test_add_robot_returns_actuators_in_the_order_of_joints():
    plant, arm, _ = mount(find_end_effector("connector_tool"))
    assert [actuator.joint().name() for actuator in arm.actuators] == list(UR5E.joints)
    q = np.arange(6) / 10
    context = plant.CreateDefaultContext()
    plant.SetPositions(context, arm.model, q)
    assert [plant.GetJointByName(name).GetOnePosition(context) for name in UR5E.joints] == list(q)


TRANSMISSION = r"(?s)<transmission.*?</transmission>"


def reverse_transmissions(text):
    transmissions = re.findall(TRANSMISSION, text)
    return re.sub(TRANSMISSION, lambda _: transmissions.pop(), text)


def edit(pattern, by=""):
    """Return a function that replaces the matches of a regular expression in a text."""
    return lambda text: re.sub(pattern, by, text)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (edit(r' effort="[\d.]+"'), "shoulder_pan_joint' needs a finite effort limit"),
        (edit(r' lower="[^"]*" upper="[^"]*"'), "shoulder_pan_joint' needs finite position limits"),
        (edit(r'lower="[^"]*" upper="[^"]*"', 'lower="0" upper="0"'), "pan_joint' needs finite position limits"),
        (edit(r' velocity="[^"]*"'), "shoulder_pan_joint' needs a positive, finite velocity limit"),
        (edit(r'velocity="[^"]*"', 'velocity="0"'), "shoulder_pan_joint' needs a positive, finite velocity limit"),
        (
            edit(r"(?s)<inertial>.*?</inertial>"),
            "robot 'local': the link that joint 'ur5e_shoulder_pan_joint' moves needs a mass",
        ),
        (
            edit(r'lower="([^"]*)" upper="([^"]*)"', r'lower="\2" upper="\1"'),
            "robot 'local': the lower position limit of joint 'ur5e_shoulder_pan_joint' in .* is above the upper one",
        ),
        (edit(r"<drake:rotor_inertia[^>]*/>"), "shoulder_pan_joint' needs a transmission with rotor inertia"),
        (edit(r'gear_ratio value="\d+"', 'gear_ratio value="0"'), "rotor inertia and gear ratio"),
        (
            reverse_transmissions,
            "joints and the transmissions in its model file must both be .* and ur5e_wrist_3_joint, ur5e_wrist_2",
        ),
    ],
)
def test_add_robot_refuses_incomplete_joints(tmp_path, change, reason):
    model = tmp_path / "arm.urdf"
    model.write_text(change(UR5E.model.read_text()))
    with pytest.raises(InputError, match=reason):
        add_robot(MultibodyPlant(0.0), dataclasses.replace(UR5E, name="local", model=model))


def test_add_models_names_the_joint_of_crossed_limits(tmp_path):
    limit = "<axis><xyz>0 0 1</xyz><limit><lower>1</lower><upper>-1</upper></limit></axis>"
    joint = f"<joint name='hinge' type='revolute'><parent>world</parent><child>link</child>{limit}</joint>"
    file = tmp_path / "arm.sdf"
    file.write_text(f"<sdf version='1.9'><model name='arm'><link name='link'/>{joint}</model></sdf>")
    with pytest.raises(InputError, match=r"limit of joint 'hinge' in .*arm\.sdf is above the upper"):
        add_models(MultibodyPlant(0.0), file)


def test_lighten_rotors_scales_the_rotor_inertia():
    plant = MultibodyPlant(0.0)
    robot = find_robot("panda")
    arm = add_robot(plant, robot)
    before = [actuator.default_reflected_inertia() for actuator in arm.actuators]
    assert before == pytest.approx([0.6057] * 2 + [0.4625] * 2 + [0.2055] * 3, rel=1e-3)
    lighten_rotors(robot, arm)
    after = [actuator.default_reflected_inertia() for actuator in arm.actuators]
    assert after == pytest.approx([0.25 * inertia for inertia in before])


@pytest.mark.parametrize("time_step", [0.005, 0.001])
def test_joint_friction_holds_up_to_its_torque_and_then_resists_with_it(time_step):
    robot, friction = find_robot("iiwa14"), 0.7

    def speed(torque, has_friction=True):
        """Return the speed of the last joint after 20 ms, at first at rest [rad/s]."""
        plant = MultibodyPlant(time_step)
        arm = add_robot(plant, robot)
        lighten_rotors(robot, arm)
        if has_friction:
            add_joint_friction(plant, arm.actuators, friction)
        plant.mutable_gravity_field().set_gravity_vector([0.0, 0.0, 0.0])
        plant.Finalize()
        simulator = Simulator(plant)
        context = simulator.get_mutable_context()
        torques = np.zeros(plant.num_actuators())
        torques[6] = torque
        plant.get_actuation_input_port(arm.model).FixValue(context, torques)
        if has_friction:
            plant.get_desired_state_input_port(arm.model).FixValue(context, np.zeros(2 * len(torques)))
        simulator.AdvanceTo(0.02)
        return plant.GetVelocities(context)[6]

    assert 0.0 < speed(0.9 * friction) < SLIP
    for sign in (1.0, -1.0):
        assert speed(3.0 * sign * friction) == pytest.approx(speed(2.0 * sign * friction, has_friction=False), rel=0.01)


def test_add_end_effector_as_rigid_adds_one_body():
    plant, _, tool = mount(GRIPPER)
    rigid_plant, _, rigid = mount(GRIPPER, as_rigid=True)
    assert rigid_plant.num_positions() == 6
    assert not rigid.actuators
    context, rigid_context = plant.CreateDefaultContext(), rigid_plant.CreateDefaultContext()
    bodies = [body.index() for body in tool.bodies]
    M = plant.CalcSpatialInertia(context, tool.bodies[0].body_frame(), bodies)
    rigid_M = rigid.bodies[0].CalcSpatialInertiaInBodyFrame(rigid_context)
    np.testing.assert_allclose(rigid_M.CopyToFullMatrix6(), M.CopyToFullMatrix6(), atol=1e-12)
    np.testing.assert_allclose(
        rigid.tool_center.CalcPoseInWorld(rigid_context).GetAsMatrix4(),
        tool.tool_center.CalcPoseInWorld(context).GetAsMatrix4(),
        atol=1e-12,
    )
    # Both fingers are open; the right finger mimics the left one.
    np.testing.assert_allclose(plant.GetPositions(context, tool.model), [0.04, 0.04])


DIRECTIVES = """
directives:
- add_model:
    name: stand
    file: package://laboratory/stand.urdf
- add_weld:
    parent: world
    child: stand::post
- add_model:
    name: arm
    file: package://laboratory/ur5e.urdf
- add_weld:
    parent: stand::top
    child: arm::ur5e_base
"""
STAND = """
<robot name="stand">
  <link name="post"/>
  <link name="top"/>
  <joint name="height" type="fixed"><parent link="post"/><child link="top"/><origin xyz="0 0 0.4"/></joint>
</robot>
"""


def test_add_robot_accepts_model_directives(tmp_path):
    """The directives weld the base of the arm to a stand of 0.4 m."""
    (tmp_path / "package.xml").write_text("<package><name>laboratory</name></package>")
    (tmp_path / "stand.urdf").write_text(STAND)
    (tmp_path / "ur5e.urdf").write_text(UR5E.model.read_text())
    (tmp_path / "cell.dmd.yaml").write_text(DIRECTIVES)
    robot_on_stand = dataclasses.replace(UR5E, name="on a stand", model=tmp_path / "cell.dmd.yaml")
    heights = []
    for robot in (UR5E, robot_on_stand):
        plant = MultibodyPlant(0.0)
        arm = add_robot(plant, robot)
        plant.Finalize()
        assert plant.num_positions() == 6
        heights.append(arm.flange.CalcPoseInWorld(plant.CreateDefaultContext()).translation()[2])
    assert heights[1] == pytest.approx(heights[0] + 0.4)


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        ({"home": (9.0, *UR5E.home[1:])}, "home of joint 'ur5e_shoulder_pan_joint' must be from .* not 9"),
        ({"level_posture": (*UR5E.home[:5], -7.0)}, "level_posture of joint 'ur5e_wrist_3_joint'"),
        ({"base_frame": "foot"}, "has no frame 'foot'"),
        ({"flange_frame": "hand"}, "has no frame 'hand'"),
        ({"joints": (*UR5E.joints[:5], "wrist")}, "has no joint 'wrist'"),
        ({"joints": (*UR5E.joints[:4], UR5E.joints[5], UR5E.joints[4])}, "in the order from base to"),
    ],
)
def test_add_robot_refuses_data_that_contradict_the_model(fields, reason):
    with pytest.raises(InputError, match=reason):
        add_robot(MultibodyPlant(0.0), dataclasses.replace(UR5E, **fields))


def test_add_robot_refuses_missing_and_invalid_models(tmp_path):
    for text, reason in (
        (None, "no model file"),
        ("<robot", "robot 'ur5e': .* can't be read"),
        (UR5E.model.read_text().split("<transmission")[0] + "</robot>", "give its model file a transmission"),
    ):
        file = tmp_path / "robot.urdf"
        if text is not None:
            file.write_text(text)
        with pytest.raises(InputError, match=reason):
            add_robot(MultibodyPlant(0.0), dataclasses.replace(UR5E, model=file))


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        ({"mount_frame": "flange"}, "has no frame 'flange'"),
        ({"tool_center": "tip"}, "has no frame 'tip'"),
        ({"bodies": ("gripper_body", "thumb")}, "has no body 'thumb'"),
        ({"opening": {"left_finger_joint": 0.0, "thumb_joint": 0.0}}, "has no joint 'thumb_joint'"),
    ],
)
@pytest.mark.parametrize("as_rigid", [False, True])
def test_add_end_effector_refuses_data_that_the_model_lacks(fields, reason, as_rigid):
    with pytest.raises(InputError, match=reason):
        mount(dataclasses.replace(GRIPPER, **fields), as_rigid=as_rigid)


@pytest.mark.parametrize("as_rigid", [False, True])
def test_add_end_effector_refuses_files_without_one_model(as_rigid, tmp_path):
    file = tmp_path / "two.dmd.yaml"
    label = "end effector 'parallel_gripper'"
    with pytest.raises(InputError, match=f"{label}: there is no model file"):
        mount(dataclasses.replace(GRIPPER, model=file), as_rigid=as_rigid)
    models = (f"- add_model: {{name: {name}, file: 'file://{GRIPPER.model}'}}\n" for name in ("one", "two"))
    file.write_text("directives:\n" + "".join(models))
    with pytest.raises(InputError, match=f"{label}: .* must contain one model, not 2"):
        mount(dataclasses.replace(GRIPPER, model=file), as_rigid=as_rigid)
