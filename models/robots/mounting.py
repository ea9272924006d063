"""Mounting of a robot and its end effector in a plant."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
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

SLIP = 1e-3  # speed above which a joint's friction is constant [rad/s]


@dataclass(frozen=True)
class MountedRobot:
    """Robot in a plant."""

    model: ModelInstanceIndex  # model instance of its joints
    base: Frame  # base frame
    flange: Frame  # frame to which a tool is mounted
    actuators: list[JointActuator]  # actuators in the order of its joints


@dataclass(frozen=True)
class MountedEndEffector:
    """End effector on a robot's flange in a plant."""

    wrist: WeldJoint  # joint to the flange, at which a wrist sensor measures
    tool_center: Frame  # frame P of the tool center
    bodies: list[RigidBody]  # all bodies; the first is the child of `wrist`
    model: ModelInstanceIndex  # model instance
    # Actuators in the order of its joints; empty for a rigid tool, or a gripper added as a rigid body.
    actuators: list[JointActuator]


def add_robot(plant: MultibodyPlant, robot: Robot) -> MountedRobot:
    """Add a robot; its base is welded to the world's origin, unless the model file mounts it.

    Raises:
        InputError: If the model file is missing, cannot be read, or does not match the robot's data.
    """
    label = f"robot {robot.name!r}"
    models = _read(plant, robot.model, label)
    find = partial(_find, plant, models, label, robot.model)
    joints = [find("joint", name) for name in robot.joints]
    model = joints[0].model_instance()
    if any(joint.model_instance() != model for joint in joints):
        raise InputError(f"{label}: all its joints must belong to one model instance")
    base = find("frame", robot.base_frame)
    if not any(plant.get_joint(i).child_body().index() == base.body().index() for i in plant.GetJointIndices()):
        plant.WeldFrames(plant.world_frame(), base)
    actuators = _list_actuators(plant, joints, label)
    _check_joints(plant, robot, joints, actuators, label)
    return MountedRobot(model, base, find("frame", robot.flange_frame), actuators)


def add_end_effector(
    plant: MultibodyPlant, robot: Robot, mounted: MountedRobot, end_effector: EndEffector, *, as_rigid: bool = False
) -> MountedEndEffector:
    """Mount an end effector to a robot's flange.

    Args:
        plant: Plant with the robot, not finalized.
        robot: Robot, whose `tool_turn` defines the orientation of the mount.
        mounted: Robot in the plant.
        end_effector: End effector to mount.
        as_rigid: If True, add the opened gripper as one rigid body, for a controller's plant; no effect on a rigid
            tool.
    """
    X_FlangeMount = RigidTransform(RotationMatrix.MakeZRotation(robot.tool_turn), [0.0, 0.0, 0.0])
    X_FlangeMount = X_FlangeMount @ end_effector.X_FlangeMount
    if as_rigid and end_effector.is_gripper:
        return _add_rigid_copy(plant, mounted, end_effector, X_FlangeMount)
    mount, tool_center, bodies, joints = _add_opened(plant, end_effector)
    wrist = plant.WeldFrames(mounted.flange, mount, X_FlangeMount)
    actuators = _list_actuators(plant, joints, f"end effector {end_effector.name!r}")
    return MountedEndEffector(wrist, tool_center, bodies, mount.model_instance(), actuators)


def lighten_rotors(robot: Robot, mounted: MountedRobot) -> None:
    """Reduce the rotor inertias to the apparent inertias under joint torque control."""
    for actuator in mounted.actuators:
        actuator.set_default_rotor_inertia(robot.apparent_rotor_inertia * actuator.default_rotor_inertia())


def add_drives(actuators: Sequence[JointActuator], drives: JointDrives) -> None:
    """Add a spring to the desired position and a damper to each joint; the plant integrates both implicitly."""
    for actuator, stiffness, damping in zip(actuators, drives.stiffness, drives.damping, strict=True):
        actuator.set_controller_gains(PdControllerGains(p=stiffness, d=damping))


def add_joint_friction(plant: MultibodyPlant, actuators: Sequence[JointActuator], torque: float) -> None:
    """Add Coulomb friction of at most `torque` [Nm] to the joint of each actuator; below `SLIP` it is viscous.

    The friction is a further actuator of the joint, whose effort limit is `torque`. It damps the joint, and the plant
    integrates it implicitly: held for a time step, friction would make a light wrist oscillate.
    """
    for actuator in actuators:
        friction = plant.AddJointActuator(f"{actuator.name()}_friction", actuator.joint(), torque)
        friction.set_controller_gains(PdControllerGains(p=0.0, d=torque / SLIP))
        # Drake uses the reflected inertia of a joint's last actuator only.
        friction.set_default_rotor_inertia(actuator.default_rotor_inertia())
        friction.set_default_gear_ratio(actuator.default_gear_ratio())


def _read(plant: MultibodyPlant, file: Path, label: str) -> list[ModelInstanceIndex]:
    if not Path(file).is_file():
        raise InputError(f"{label}: there is no model file {file}")
    try:
        return add_models(plant, file)
    except InputError as error:
        raise InputError(f"{label}: {error}") from error


def _find(
    plant: MultibodyPlant, models: Sequence[ModelInstanceIndex], label: str, file: Path, kind: str, name: str
) -> Any:
    """Return the frame, body or joint called `name`; `kind` is "frame", "body" or "joint"."""
    has_name = getattr(plant, f"Has{kind.title()}Named")
    for model in models:
        if has_name(name, model):
            return getattr(plant, f"Get{kind.title()}ByName")(name, model)
    raise InputError(f"{label}: {file.name} has no {kind} {name!r}")


def _add_opened(plant: MultibodyPlant, end_effector: EndEffector) -> tuple[Frame, Frame, list[RigidBody], list[Joint]]:
    """Add the model of an opened end effector; return mount, tool center, bodies and actuated joints."""
    label = f"end effector {end_effector.name!r}"
    models = _read(plant, end_effector.model, label)
    if len(models) != 1:
        raise InputError(f"{label}: {end_effector.model} must contain one model, not {len(models)}")
    find = partial(_find, plant, models, label, end_effector.model)
    mount, tool_center = (find("frame", name) for name in (end_effector.mount_frame, end_effector.tool_center))
    bodies = [find("body", name) for name in end_effector.bodies]
    joints = [find("joint", name) for name in end_effector.joints]
    for name, position in end_effector.opening.items():
        find("joint", name).set_default_positions([position])
    return mount, tool_center, bodies, joints


def _list_actuators(plant: MultibodyPlant, joints: Sequence[Joint], label: str) -> list[JointActuator]:
    """Return the actuators of the joints; these must be all actuated joints of their model, in the model's order."""
    if not joints:
        return []
    actuators = [
        actuator
        for actuator in map(plant.get_joint_actuator, plant.GetJointActuatorIndices())
        if actuator.model_instance() == joints[0].model_instance()
    ]
    actuated = [actuator.joint().name() for actuator in actuators]
    names = [joint.name() for joint in joints]
    for name in names:
        if name not in actuated:
            raise InputError(f"{label}: joint {name!r} has no actuator: give its model file a transmission")
    if names != actuated and sorted(names) == sorted(actuated):
        raise InputError(
            f"{label}: its joints and the transmissions in its model file must both be in the order from base to "
            f"flange, not {', '.join(names)} and {', '.join(actuated)}"
        )
    if names != actuated:
        raise InputError(f"{label}: name all joints that its model file actuates, in its order: {', '.join(actuated)}")
    return actuators


def _check_joints(
    plant: MultibodyPlant, robot: Robot, joints: Sequence[Joint], actuators: Sequence[JointActuator], label: str
) -> None:
    """Raise an `InputError` unless limits, masses and drives are complete and postures are within the limits."""
    for index, (joint, actuator) in enumerate(zip(joints, actuators, strict=True)):
        lower, upper = joint.position_lower_limits().item(), joint.position_upper_limits().item()
        if not -math.inf < lower < upper < math.inf:
            raise InputError(
                f"{label}: joint {joint.name()!r} needs finite position limits in the model file, the lower one below "
                "the upper one"
            )
        if not 0.0 < joint.velocity_upper_limits().item() < math.inf:
            raise InputError(
                f"{label}: joint {joint.name()!r} needs a positive, finite velocity limit in the model file"
            )
        if not sum(body.default_mass() for body in plant.GetBodiesWeldedTo(joint.child_body())) > 0.0:
            raise InputError(f"{label}: the link that joint {joint.name()!r} moves needs a mass in the model file")
        if not 0.0 < actuator.effort_limit() < math.inf:
            raise InputError(f"{label}: joint {joint.name()!r} needs a finite effort limit in the model file")
        if not actuator.default_reflected_inertia() > 0.0:
            raise InputError(
                f"{label}: joint {joint.name()!r} needs a transmission with rotor inertia and gear ratio in the model "
                "file, because an impedance controller is unstable without reflected inertia"
            )
        for what, posture in (("home", robot.home), ("level_posture", robot.level_posture)):
            if posture is not None and not lower <= posture[index] <= upper:
                raise InputError(
                    f"{label}: {what} of joint {joint.name()!r} must be from {lower:g} to {upper:g}, "
                    f"its limits in the model file, not {posture[index]:g}"
                )


def _add_rigid_copy(
    plant: MultibodyPlant, mounted: MountedRobot, end_effector: EndEffector, X_FlangeMount: RigidTransform
) -> MountedEndEffector:
    """Add one body with the inertia of the open gripper."""
    gripper_plant = MultibodyPlant(time_step=1e-3)  # only discrete plants support mimic joints
    gripper_plant.set_discrete_contact_approximation(DiscreteContactApproximation.kLagged)
    mount, gripper_center, bodies, _ = _add_opened(gripper_plant, end_effector)
    gripper_plant.WeldFrames(gripper_plant.world_frame(), mount)
    gripper_plant.Finalize()
    context = gripper_plant.CreateDefaultContext()
    M = gripper_plant.CalcSpatialInertia(context, mount, [body.index() for body in bodies])
    X_MountP = gripper_center.CalcPose(context, mount)

    instance = plant.AddModelInstance(end_effector.name)
    body = plant.AddRigidBody(end_effector.bodies[0], instance, M)
    wrist = plant.WeldFrames(mounted.flange, body.body_frame(), X_FlangeMount)
    tool_center = plant.AddFrame(FixedOffsetFrame(end_effector.tool_center, body.body_frame(), X_MountP, instance))
    return MountedEndEffector(wrist, tool_center, [body], instance, [])
