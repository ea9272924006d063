"""An arm under a Cartesian impedance, with a tool: which arm and which tool are data."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydantic import Field
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import FixedOffsetFrame, Frame, JointActuator, ModelInstanceIndex, RigidBody, WeldJoint
from pydrake.systems.framework import Context, DiagramBuilder, InputPort, OutputPort
from pydrake.systems.primitives import MatrixGain

from guiderail.diagrams.stations.impedance_control import add_impedance_control
from guiderail.diagrams.stations.registry import register_station
from guiderail.diagrams.stations.station import (
    CONTROL_PERIOD,
    PLANT_PERIOD,
    POSE_SIZE,
    ContactOptions,
    Impedance,
    Station,
    add_workcell_plant,
    add_wrench_sensor,
    check_pose,
    export_simulation_ports,
)
from guiderail.diagrams.stations.workcell import Workcell
from guiderail.models.common.errors import InputError
from guiderail.models.common.poses import pose_to_transform
from guiderail.models.robots.inverse_kinematics import solve_inverse_kinematics
from guiderail.models.robots.mounting import add_drives, add_end_effector, add_robot, lighten_rotors
from guiderail.models.robots.robot import (
    DEFAULT_END_EFFECTOR,
    DEFAULT_ROBOT,
    EndEffector,
    Robot,
    find_end_effector,
    find_robot,
)
from guiderail.systems.gripper_command import GripperCommand

# Half way through a quarter turn of what is held, from 90 degrees to 0.
MID_TURN_POSE = np.array([0.0, 0.0, 0.0, np.pi / 4, 0.0, 0.0])


@dataclass(frozen=True)
class ArmModel:
    """The arm, its tool and what it holds, in some plant.

    Attributes:
        model: of the arm's joints.
        target: T.
        tool_centre: P.
        wrist: by which the tool is bolted to the flange.
        tool: the bodies behind the wrist, the first at the wrist.
        tool_model: of the tool's joints, if it has any.
        gripper: the actuators of the tool's joints.
    """

    model: ModelInstanceIndex
    target: Frame
    tool_centre: Frame
    wrist: WeldJoint
    tool: list[RigidBody]
    tool_model: ModelInstanceIndex
    gripper: list[JointActuator]


def add_arm(
    plant: MultibodyPlant,
    workcell: Workcell,
    robot: Robot | str = DEFAULT_ROBOT,
    end_effector: EndEffector | str = DEFAULT_END_EFFECTOR,
    *,
    as_rigid: bool = False,
) -> ArmModel:
    """Adds the arm at the world's origin, the tool, and the workpiece in it.

    Args:
        plant: not finalized.
        workcell: what is held, and where the target is.
        robot: which arm, or its name.
        end_effector: which tool, or its name.
        as_rigid: a gripper is one body, open, as a controller knows it.
    """
    robot, end_effector = find_robot(robot), find_end_effector(end_effector)
    arm = add_robot(plant, robot)
    lighten_rotors(robot, arm)
    tool = add_end_effector(plant, robot, arm, end_effector, as_rigid=as_rigid)
    if tool.actuators and end_effector.drives is not None:
        add_drives(tool.actuators, end_effector.drives)
    workpiece = workcell.add_workpiece(plant, tool.tool_centre)
    target = plant.AddFrame(FixedOffsetFrame("target", plant.world_frame(), workcell.X_WT))
    return ArmModel(
        arm.model, target, tool.tool_centre, tool.wrist, [*tool.bodies, workpiece], tool.model, tool.actuators
    )


def controller_model(
    workcell: Workcell,
    robot: Robot | str = DEFAULT_ROBOT,
    end_effector: EndEffector | str = DEFAULT_END_EFFECTOR,
) -> tuple[MultibodyPlant, ArmModel]:
    """The arm alone, as its controller knows it: without the fixture, without offsets, without joints of the tool.

    Raises:
        InputError: if the robot's model moves by other joints than the arm's.
    """
    robot = find_robot(robot)
    plant = MultibodyPlant(0.0)
    arm = add_arm(plant, workcell, robot, end_effector, as_rigid=True)
    plant.Finalize()
    starts = [plant.GetJointByName(name, arm.model).position_start() for name in robot.joints]
    if starts != list(range(plant.num_positions())):
        raise InputError(
            f"robot {robot.name!r}: its model must move by the joints that are named, from the base to the flange, and "
            "by no others: make an end effector of what else moves"
        )
    return plant, arm


class ArmControllerPlant:
    """The arm as its controller knows it, and what follows from that alone.

    Attributes:
        plant: the arm, its tool and the workpiece; no fixture, no offsets.
        arm: in that plant.
        posture: halfway through the workpiece's quarter turn, so that a null space that returns to it pulls either way
            alike, (n,).
    """

    def __init__(
        self,
        workcell: Workcell,
        robot: Robot | str = DEFAULT_ROBOT,
        end_effector: EndEffector | str = DEFAULT_END_EFFECTOR,
    ):
        """
        Args:
            workcell: what is held, and where the target is.
            robot: which arm, or its name.
            end_effector: which tool, or its name.
        """
        self.plant, self.arm = controller_model(workcell, robot, end_effector)
        self.posture = self.solve(MID_TURN_POSE, np.array(find_robot(robot).home))

    @property
    def target(self) -> Frame:
        """T."""
        return self.arm.target

    @property
    def tool_centre(self) -> Frame:
        """P."""
        return self.arm.tool_centre

    def solve(self, pose: np.ndarray, posture: np.ndarray) -> np.ndarray:
        """The joint positions (n,) nearest to `posture`, (n,), with the tool centre at `pose`, (6,)."""
        arm = self.arm
        return solve_inverse_kinematics(self.plant, arm.target, arm.tool_centre, pose_to_transform(pose), posture)

    def place(self, plant: MultibodyPlant, model: ModelInstanceIndex, context: Context, pose: np.ndarray) -> None:
        """Puts an arm of a station's plant at rest with its tool centre at `pose`, (6,); `context` is the root's."""
        plant_context = plant.GetMyMutableContextFromRoot(context)
        plant.SetPositions(plant_context, model, self.solve(check_pose(pose, POSE_SIZE), self.posture))
        plant.SetVelocities(plant_context, model, np.zeros(plant.num_velocities(model)))


def add_gripper_control(
    builder: DiagramBuilder, plant: MultibodyPlant, arm: ArmModel, end_effector: EndEffector, period: float
) -> tuple[InputPort, OutputPort]:
    """Adds what drives the joints of a gripper; returns their desired positions and their measured state."""
    joints = [actuator.joint() for actuator in arm.gripper]
    command = builder.AddNamedSystem(
        "gripper_command",
        GripperCommand(
            np.concatenate([joint.position_lower_limits() for joint in joints]),
            np.concatenate([joint.position_upper_limits() for joint in joints]),
            np.array([end_effector.opening[joint.name()] for joint in joints]),
            period=period,
        ),
    )
    # Joints that mimic others are in the model's state too.
    num_positions, first = plant.num_positions(arm.tool_model), _first_position(plant, arm.tool_model)
    actuated = np.zeros((2 * len(joints), plant.num_multibody_states(arm.tool_model)))
    for row, joint in enumerate(joints):
        column = joint.position_start() - first
        actuated[row, column] = actuated[len(joints) + row, num_positions + column] = 1.0
    state = builder.AddNamedSystem("gripper_state", MatrixGain(actuated))
    builder.Connect(command.get_desired_state_output_port(), plant.get_desired_state_input_port(arm.tool_model))
    builder.Connect(plant.get_state_output_port(arm.tool_model), state.get_input_port())
    return command.get_position_input_port(), state.get_output_port()


class ArmOptions(ContactOptions):
    """Of an arm's station."""

    robot: str = Field(DEFAULT_ROBOT, description="which arm")
    end_effector: str = Field(DEFAULT_END_EFFECTOR, description="which tool")


@register_station("arm", world="workcell", options=ArmOptions)
class ArmStation(Station):
    """The arm, its controller and the workcell.

    Its rotors' reflected inertia makes the arm slower than the rails to follow, and stable under a controller that is
    as slow as the plant's step. A station whose end effector is a gripper has two ports more:

    ==================  =========  ====================================================================================
    port                size       meaning
    ==================  =========  ====================================================================================
    `gripper_position`  n          input, optional: where the gripper's actuated joints shall be; it stays open without
    `gripper_state`     2n         output: their positions and velocities
    ==================  =========  ====================================================================================

    A gripper's limit of force is its actuators'. To the controller and to the wrench sensor it is a rigid tool, open.
    """

    wraps_angles = True

    def __init__(
        self,
        workcell: Workcell,
        impedance: Impedance = Impedance(),  # noqa: B008 (frozen)
        time_step: float | None = None,
        wrench_time_constant: float = 0.01,
        *,
        robot: Robot | str = DEFAULT_ROBOT,
        end_effector: EndEffector | str = DEFAULT_END_EFFECTOR,
    ):
        """
        Args:
            workcell: what stands in the world and what is held.
            impedance: at the tool centre.
            time_step: of the plant and of the controller [s]; half a rails' plant's for a gripper, whose fingers would
                sink into what they hold, and the rails' plant's for other tools, unless given.
            wrench_time_constant: of the wrench sensor's low-pass filter [s].
            robot: which arm, or its name: see `robot_names()`.
            end_effector: which tool, or its name: see `end_effector_names()`.
        """
        super().__init__()
        builder = DiagramBuilder()
        end_effector = find_end_effector(end_effector)
        if time_step is None:
            time_step = PLANT_PERIOD / 2 if end_effector.opening else PLANT_PERIOD
        self._controller_plant = ArmControllerPlant(workcell, robot, end_effector)
        self.plant, self.scene_graph, self.arm = add_workcell_plant(
            builder, workcell, time_step, lambda plant: add_arm(plant, workcell, robot, end_effector)
        )
        plant, arm = self.plant, self.arm
        wrench = add_wrench_sensor(builder, plant, workcell, arm.wrist, arm.tool, arm.tool_centre, wrench_time_constant)
        torque = add_impedance_control(
            builder,
            self._controller_plant,
            impedance,
            CONTROL_PERIOD,
            state=plant.get_state_output_port(arm.model),
            wrench=wrench,
        )
        builder.Connect(torque, plant.get_actuation_input_port(arm.model))
        if arm.gripper:
            position, state = add_gripper_control(builder, plant, arm, end_effector, time_step)
            builder.ExportInput(position, "gripper_position")
            builder.ExportOutput(state, "gripper_state")
        export_simulation_ports(builder, plant, self.scene_graph)
        builder.BuildInto(self)

    def get_gripper_position_input_port(self) -> InputPort:
        """Where the gripper's actuated joints shall be, (n,); only of a station with a gripper."""
        return self.GetInputPort("gripper_position")

    def get_gripper_state_output_port(self) -> OutputPort:
        """Positions and velocities of the gripper's actuated joints, (2n,); only of a station with a gripper."""
        return self.GetOutputPort("gripper_state")

    def set_pose(self, context: Context, pose: np.ndarray) -> None:
        """Puts the arm at rest with its tool centre at `pose`, (6,); `context` is the root context."""
        self._controller_plant.place(self.plant, self.arm.model, context, pose)

    def set_payload(self, context: Context, mass: float) -> None:
        """Adds a mass [kg] to the tool that neither controller nor sensor knows of; `context` is the root context."""
        own, tool = self.plant.GetMyMutableContextFromRoot(context), self.arm.tool[0]
        tool.SetMass(own, tool.default_mass() + mass)


def _first_position(plant: MultibodyPlant, model: ModelInstanceIndex) -> int:
    """Where a model's positions begin in the plant's."""
    joints = [plant.get_joint(index) for index in plant.GetJointIndices(model)]
    return min(joint.position_start() for joint in joints if joint.num_positions() > 0)
