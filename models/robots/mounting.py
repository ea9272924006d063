"""A robot and its end effector in a plant."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

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
from guiderail.models.common.parsing import add_model, add_models
from guiderail.models.robots.robot import EndEffector, JointDrives, Robot


@dataclass(frozen=True)
class MountedRobot:
    """A robot in some plant.

    Attributes:
        model: of its joints, whose positions, velocities and actuation are the plant's of this instance.
        flange: where a tool is bolted on.
        actuators: in the order of its joints.
    """

    model: ModelInstanceIndex
    flange: Frame
    actuators: list[JointActuator]


@dataclass(frozen=True)
class MountedEndEffector:
    """An end effector on some robot's flange.

    Attributes:
        wrist: by which it is bolted on; a wrist sensor measures there.
        tool_centre: P.
        bodies: all of it, the first is the child of `wrist`.
        model: its model instance.
        actuators: in the order of its joints; none of a rigid tool, or of a gripper that was added as one.
    """

    wrist: WeldJoint
    tool_centre: Frame
    bodies: list[RigidBody]
    model: ModelInstanceIndex
    actuators: list[JointActuator]


def add_robot(plant: MultibodyPlant, robot: Robot) -> MountedRobot:
    """Adds a robot with its base at the world's origin.

    Raises:
        InputError: if its model file is missing, can't be read, or has not what the robot's data say.
    """
    models = _read(plant, robot.model, f"robot {robot.name!r}")
    joints = [_joint(plant, models, name, robot) for name in robot.joints]
    model = joints[0].model_instance()
    if any(joint.model_instance() != model for joint in joints):
        raise InputError(f"robot {robot.name!r}: its joints must all be of one model instance")
    base = _frame(plant, models, robot.base_frame, robot)
    if not any(plant.get_joint(i).child_body().index() == base.body().index() for i in plant.GetJointIndices()):
        plant.WeldFrames(plant.world_frame(), base)
    return MountedRobot(
        model=model,
        flange=_frame(plant, models, robot.flange_frame, robot),
        actuators=_actuators(plant, joints, f"robot {robot.name!r}"),
    )


def add_end_effector(
    plant: MultibodyPlant, robot: Robot, mounted: MountedRobot, end_effector: EndEffector, *, as_rigid: bool = False
) -> MountedEndEffector:
    """Bolts an end effector to a robot's flange.

    Args:
        plant: with the robot, not finalized.
        robot: says how the flange is turned.
        mounted: the robot in the plant.
        end_effector: what is bolted on.
        as_rigid: a gripper is added as one body, open: to a controller, what it carries is a mass.

    Raises:
        InputError: if its model file is missing, can't be read, or has not what its data say.
    """
    X_FlangeMount = RigidTransform(RotationMatrix.MakeZRotation(robot.tool_turn), [0.0, 0.0, 0.0])
    X_FlangeMount = X_FlangeMount @ end_effector.X_FlangeMount
    who = f"end effector {end_effector.name!r}"
    if as_rigid and end_effector.is_gripper:
        return _add_rigid_copy(plant, mounted, end_effector, X_FlangeMount)
    (model,) = _read(plant, end_effector.model, who, only_one=True)
    _expect(plant, model, end_effector)
    wrist = plant.WeldFrames(mounted.flange, plant.GetFrameByName(end_effector.mount_frame, model), X_FlangeMount)
    joints = [plant.GetJointByName(name, model) for name in end_effector.joints]
    _open(plant, model, end_effector)
    return MountedEndEffector(
        wrist=wrist,
        tool_centre=plant.GetFrameByName(end_effector.tool_centre, model),
        bodies=[plant.GetBodyByName(name, model) for name in end_effector.bodies],
        model=model,
        actuators=_actuators(plant, joints, who),
    )


def lighten_rotors(robot: Robot, mounted: MountedRobot) -> None:
    """Makes the rotors appear as light as control by torque makes them."""
    for actuator in mounted.actuators:
        actuator.set_default_rotor_inertia(robot.apparent_rotor_inertia * actuator.default_rotor_inertia())


def add_drives(actuators: Sequence[JointActuator], drives: JointDrives) -> None:
    """Gives each joint a spring to its desired position and a damper, which the plant solves implicitly."""
    for actuator, stiffness, damping in zip(actuators, drives.stiffness, drives.damping, strict=True):
        actuator.set_controller_gains(PdControllerGains(p=stiffness, d=damping))


def _read(plant: MultibodyPlant, file: Path, who: str, *, only_one: bool = False) -> list[ModelInstanceIndex]:
    if not Path(file).is_file():
        raise InputError(f"{who}: there is no model file {file}")
    try:
        models = add_models(plant, file)
    except RuntimeError as error:
        raise InputError(f"{who}: {file} can't be read as a model: {error}") from error
    if only_one and len(models) != 1:
        raise InputError(f"{who}: {file} must hold one model, not {len(models)}")
    return models


def _frame(plant: MultibodyPlant, models: Sequence[ModelInstanceIndex], name: str, robot: Robot) -> Frame:
    for model in models:
        if plant.HasFrameNamed(name, model):
            return plant.GetFrameByName(name, model)
    raise InputError(f"robot {robot.name!r}: {robot.model.name} has no frame {name!r}")


def _joint(plant: MultibodyPlant, models: Sequence[ModelInstanceIndex], name: str, robot: Robot) -> Joint:
    for model in models:
        if plant.HasJointNamed(name, model):
            return plant.GetJointByName(name, model)
    raise InputError(f"robot {robot.name!r}: {robot.model.name} has no joint {name!r}")


def _actuators(plant: MultibodyPlant, joints: Sequence[Joint], who: str) -> list[JointActuator]:
    """Of the joints, which must be all that their model actuates, in the model's order."""
    if not joints:
        return []
    everywhere = [plant.get_joint_actuator(index) for index in plant.GetJointActuatorIndices()]
    actuators = [actuator for actuator in everywhere if actuator.model_instance() == joints[0].model_instance()]
    actuated = [actuator.joint().name() for actuator in actuators]
    names = [joint.name() for joint in joints]
    for name in names:
        if name not in actuated:
            raise InputError(f"{who}: joint {name!r} has no actuator: give its model file a transmission")
    if names != actuated:
        raise InputError(f"{who}: name all joints that its model file actuates, in its order: {', '.join(actuated)}")
    return actuators


def _expect(plant: MultibodyPlant, model: ModelInstanceIndex, end_effector: EndEffector) -> None:
    """Refuses data of names that the model file has not."""
    for kind, names, is_there in (
        ("frame", (end_effector.mount_frame, end_effector.tool_centre), plant.HasFrameNamed),
        ("body", end_effector.bodies, plant.HasBodyNamed),
        ("joint", (*end_effector.joints, *end_effector.opening), plant.HasJointNamed),
    ):
        for name in names:
            if not is_there(name, model):
                file = end_effector.model.name
                raise InputError(f"end effector {end_effector.name!r}: {file} has no {kind} {name!r}")


def _open(plant: MultibodyPlant, model: ModelInstanceIndex, end_effector: EndEffector) -> None:
    for name, position in end_effector.opening.items():
        plant.GetJointByName(name, model).set_default_positions([position])


def _add_rigid_copy(
    plant: MultibodyPlant, mounted: MountedRobot, end_effector: EndEffector, X_FlangeMount: RigidTransform
) -> MountedEndEffector:
    """One body with the inertia of the open gripper."""
    alone = MultibodyPlant(time_step=1e-3)  # a joint that mimics another is known to discrete plants only
    alone.set_discrete_contact_approximation(DiscreteContactApproximation.kLagged)
    model = add_model(alone, end_effector.model)
    _expect(alone, model, end_effector)
    mount = alone.GetFrameByName(end_effector.mount_frame, model)
    alone.WeldFrames(alone.world_frame(), mount)
    _open(alone, model, end_effector)
    alone.Finalize()
    context = alone.CreateDefaultContext()
    bodies = [alone.GetBodyByName(name, model).index() for name in end_effector.bodies]
    M = alone.CalcSpatialInertia(context, mount, bodies)
    X_MountP = alone.GetFrameByName(end_effector.tool_centre, model).CalcPose(context, mount)

    instance = plant.AddModelInstance(end_effector.name)
    body = plant.AddRigidBody(end_effector.bodies[0], instance, M)
    wrist = plant.WeldFrames(mounted.flange, body.body_frame(), X_FlangeMount)
    tool_centre = plant.AddFrame(FixedOffsetFrame(end_effector.tool_centre, body.body_frame(), X_MountP, instance))
    return MountedEndEffector(wrist, tool_centre, [body], instance, [])
