"""Mounting of a robot and its end effector in a plant."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import DiscreteContactApproximation, MultibodyPlant
from pydrake.multibody.tree import (
    FixedOffsetFrame,
    Frame,
    Joint,
    JointActuator,
    ModelInstanceIndex,
    PdControllerGains,
    RigidBody,
    WeldJoint,
)

from guiderail.models.common.errors import InputError
from guiderail.models.common.parsing import add_models
from guiderail.models.robots.robot import EndEffector, JointDrives, Robot


@dataclass(frozen=True)
class MountedRobot:
    """Robot in a plant."""

    model: ModelInstanceIndex  # model instance of its joints
    flange: Frame  # frame to which a tool is mounted
    actuators: list[JointActuator]  # actuators in the order of its joints


@dataclass(frozen=True)
class MountedEndEffector:
    """End effector on a robot's flange."""

    wrist: WeldJoint  # joint to the flange, at which a wrist sensor measures
    tool_center: Frame  # frame P of the tool center
    bodies: list[RigidBody]  # all bodies; the first is the child of `wrist`
    model: ModelInstanceIndex  # model instance
    # Actuators in the order of its joints; empty for a rigid tool, or a gripper added as a rigid body.
    actuators: list[JointActuator]


def add_robot(plant: MultibodyPlant, robot: Robot) -> MountedRobot:
    """Add a robot with its base at the world's origin.

    Raises:
        InputError: If its model file is missing, can't be read, or does not match the robot's data.
    """
    models = _read(plant, robot.model, f"robot {robot.name!r}")
    joints = [_find(plant, models, "joint", name, robot) for name in robot.joints]
    model = joints[0].model_instance()
    if any(joint.model_instance() != model for joint in joints):
        raise InputError(f"robot {robot.name!r}: its joints must all be of one model instance")
    base = _find(plant, models, "frame", robot.base_frame, robot)
    if not any(plant.get_joint(i).child_body().index() == base.body().index() for i in plant.GetJointIndices()):
        plant.WeldFrames(plant.world_frame(), base)
    return MountedRobot(
        model=model,
        flange=_find(plant, models, "frame", robot.flange_frame, robot),
        actuators=_list_actuators(plant, joints, f"robot {robot.name!r}"),
    )


def add_end_effector(
    plant: MultibodyPlant, robot: Robot, mounted: MountedRobot, end_effector: EndEffector, *, as_rigid: bool = False
) -> MountedEndEffector:
    """Mount an end effector to a robot's flange.

    Args:
        plant: Plant with the robot, not finalized.
        robot: Robot, whose `tool_turn` defines the orientation of the mount.
        mounted: The robot in the plant.
        end_effector: End effector to mount.
        as_rigid: Add an open gripper as one rigid body, for a controller's plant.

    Raises:
        InputError: If its model file is missing, can't be read, or does not match its data.
    """
    X_FlangeMount = RigidTransform(RotationMatrix.MakeZRotation(robot.tool_turn), [0.0, 0.0, 0.0])
    X_FlangeMount = X_FlangeMount @ end_effector.X_FlangeMount
    label = f"end effector {end_effector.name!r}"
    if as_rigid and end_effector.is_gripper:
        return _add_rigid_copy(plant, mounted, end_effector, X_FlangeMount)
    (model,) = _read(plant, end_effector.model, label, only_one=True)
    _check_names(plant, model, end_effector)
    wrist = plant.WeldFrames(mounted.flange, plant.GetFrameByName(end_effector.mount_frame, model), X_FlangeMount)
    joints = [plant.GetJointByName(name, model) for name in end_effector.joints]
    _set_opening(plant, model, end_effector)
    return MountedEndEffector(
        wrist=wrist,
        tool_center=plant.GetFrameByName(end_effector.tool_center, model),
        bodies=[plant.GetBodyByName(name, model) for name in end_effector.bodies],
        model=model,
        actuators=_list_actuators(plant, joints, label),
    )


def lighten_rotors(robot: Robot, mounted: MountedRobot) -> None:
    """Reduce the rotor inertias to the apparent inertias under joint torque control."""
    for actuator in mounted.actuators:
        actuator.set_default_rotor_inertia(robot.apparent_rotor_inertia * actuator.default_rotor_inertia())


def add_drives(actuators: Sequence[JointActuator], drives: JointDrives) -> None:
    """Give each joint a spring to its desired position and a damper; the plant integrates both implicitly."""
    for actuator, stiffness, damping in zip(actuators, drives.stiffness, drives.damping, strict=True):
        actuator.set_controller_gains(PdControllerGains(p=stiffness, d=damping))


def _read(plant: MultibodyPlant, file: Path, label: str, *, only_one: bool = False) -> list[ModelInstanceIndex]:
    if not Path(file).is_file():
        raise InputError(f"{label}: there is no model file {file}")
    try:
        models = add_models(plant, file)
    except InputError as error:
        raise InputError(f"{label}: {error}") from error
    if only_one and len(models) != 1:
        raise InputError(f"{label}: {file} must hold one model, not {len(models)}")
    return models


def _find(plant: MultibodyPlant, models: Sequence[ModelInstanceIndex], kind: str, name: str, robot: Robot) -> Any:
    """Return the frame or the joint with a name; `kind` is "frame" or "joint"."""
    has_name = getattr(plant, f"Has{kind.title()}Named")
    for model in models:
        if has_name(name, model):
            return getattr(plant, f"Get{kind.title()}ByName")(name, model)
    raise InputError(f"robot {robot.name!r}: {robot.model.name} has no {kind} {name!r}")


def _list_actuators(plant: MultibodyPlant, joints: Sequence[Joint], label: str) -> list[JointActuator]:
    """Return the actuators of the joints, which must be all actuated joints of their model, in the model's order."""
    if not joints:
        return []
    everywhere = [plant.get_joint_actuator(index) for index in plant.GetJointActuatorIndices()]
    actuators = [actuator for actuator in everywhere if actuator.model_instance() == joints[0].model_instance()]
    actuated = [actuator.joint().name() for actuator in actuators]
    names = [joint.name() for joint in joints]
    for name in names:
        if name not in actuated:
            raise InputError(f"{label}: joint {name!r} has no actuator: give its model file a transmission")
    if names != actuated:
        raise InputError(f"{label}: name all joints that its model file actuates, in its order: {', '.join(actuated)}")
    return actuators


def _check_names(plant: MultibodyPlant, model: ModelInstanceIndex, end_effector: EndEffector) -> None:
    """Raise an InputError if the data of an end effector name an element that its model file does not have."""
    for kind, names, has_name in (
        ("frame", (end_effector.mount_frame, end_effector.tool_center), plant.HasFrameNamed),
        ("body", end_effector.bodies, plant.HasBodyNamed),
        ("joint", (*end_effector.joints, *end_effector.opening), plant.HasJointNamed),
    ):
        for name in names:
            if not has_name(name, model):
                file = end_effector.model.name
                raise InputError(f"end effector {end_effector.name!r}: {file} has no {kind} {name!r}")


def _set_opening(plant: MultibodyPlant, model: ModelInstanceIndex, end_effector: EndEffector) -> None:
    for name, position in end_effector.opening.items():
        plant.GetJointByName(name, model).set_default_positions([position])


def _add_rigid_copy(
    plant: MultibodyPlant, mounted: MountedRobot, end_effector: EndEffector, X_FlangeMount: RigidTransform
) -> MountedEndEffector:
    """Add one body with the inertia of the open gripper."""
    gripper_plant = MultibodyPlant(time_step=1e-3)  # only discrete plants support mimic joints
    gripper_plant.set_discrete_contact_approximation(DiscreteContactApproximation.kLagged)
    (model,) = _read(gripper_plant, end_effector.model, f"end effector {end_effector.name!r}", only_one=True)
    _check_names(gripper_plant, model, end_effector)
    mount = gripper_plant.GetFrameByName(end_effector.mount_frame, model)
    gripper_plant.WeldFrames(gripper_plant.world_frame(), mount)
    _set_opening(gripper_plant, model, end_effector)
    gripper_plant.Finalize()
    context = gripper_plant.CreateDefaultContext()
    bodies = [gripper_plant.GetBodyByName(name, model).index() for name in end_effector.bodies]
    M = gripper_plant.CalcSpatialInertia(context, mount, bodies)
    X_MountP = gripper_plant.GetFrameByName(end_effector.tool_center, model).CalcPose(context, mount)

    instance = plant.AddModelInstance(end_effector.name)
    body = plant.AddRigidBody(end_effector.bodies[0], instance, M)
    wrist = plant.WeldFrames(mounted.flange, body.body_frame(), X_FlangeMount)
    tool_center = plant.AddFrame(FixedOffsetFrame(end_effector.tool_center, body.body_frame(), X_MountP, instance))
    return MountedEndEffector(wrist, tool_center, [body], instance, [])
