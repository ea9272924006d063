"""Arm station: any arm and tool under a Cartesian impedance controller."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import FixedOffsetFrame, Frame, JointActuator, ModelInstanceIndex, RigidBody, WeldJoint
from pydrake.systems.framework import Context, DiagramBuilder, InputPort, OutputPort
from pydrake.systems.primitives import ConstantVectorSource, MatrixGain

from guiderail.diagrams.stations.impedance_control import add_impedance_control
from guiderail.diagrams.stations.options import ArmOptions, JointTorqueAccuracy
from guiderail.diagrams.stations.registry import register_station
from guiderail.diagrams.stations.station import (
    CONTROL_PERIOD,
    PLANT_PERIOD,
    WRENCH_TIME_CONSTANT,
    ControllerPlant,
    Impedance,
    Station,
    add_workcell_plant,
    exact_periods,
    export_simulation_ports,
    plant_period,
)
from guiderail.diagrams.stations.workcell import Workcell
from guiderail.diagrams.wiring import add_system
from guiderail.models.common.errors import InputError
from guiderail.models.robots import DEFAULT_END_EFFECTOR, DEFAULT_ROBOT
from guiderail.models.robots.joint_range import JointRange
from guiderail.models.robots.mounting import add_drives, add_end_effector, add_joint_friction, add_robot, lighten_rotors
from guiderail.models.robots.robot import EndEffector, Robot, find_end_effector, find_robot
from guiderail.systems.gripper_command import GripperCommand
from guiderail.systems.support.declarations import input_getter, output_getter
from guiderail.systems.wrench_sensors import ExternalTorqueSensor, JointTorqueErrors, JointTorqueWrench, WrenchSensor

WRENCH_ESTIMATE_TIME_CONSTANT = 0.05  # filter time constant of a wrench estimated from joint torques [s]
# Pose half way through a quarter turn of the workpiece, from 90 degrees to 0.
MID_TURN_POSE = np.array([0.0, 0.0, 0.0, np.pi / 4, 0.0, 0.0])


@dataclass(frozen=True)
class ArmModel:
    """Arm, tool and workpiece in a plant."""

    model: ModelInstanceIndex  # model instance of the arm's joints
    target: Frame  # target frame T
    tool_center: Frame  # frame of the tool center P
    wrist: WeldJoint  # joint between flange and tool
    tool: list[RigidBody]  # bodies of tool and workpiece, the first at the wrist
    tool_model: ModelInstanceIndex  # model instance of the tool's joints
    gripper: list[JointActuator]  # actuators of the tool's joints


def add_arm(
    plant: MultibodyPlant,
    workcell: Workcell,
    robot: Robot | str = DEFAULT_ROBOT,
    end_effector: EndEffector | str = DEFAULT_END_EFFECTOR,
    *,
    as_rigid: bool = False,
    joint_friction: float = 0.0,
) -> ArmModel:
    """Add arm, tool and workpiece to a plant that is not finalized; the arm's base is at the world's origin.

    `robot` and `end_effector` are objects or names. With `as_rigid`, a gripper is one rigid body in its open state.
    With `joint_friction` [Nm], each joint of the arm has a second actuator; see `add_joint_friction`.
    """
    robot, end_effector = find_robot(robot), find_end_effector(end_effector)
    arm = add_robot(plant, robot)
    lighten_rotors(robot, arm)
    if joint_friction:
        add_joint_friction(plant, arm.actuators, joint_friction)
    tool = add_end_effector(plant, robot, arm, end_effector, as_rigid=as_rigid)
    if tool.actuators and end_effector.drives is not None:
        add_drives(tool.actuators, end_effector.drives)
    workpiece = workcell.add_workpiece(plant, tool.tool_center)
    target = plant.AddFrame(FixedOffsetFrame("target", plant.world_frame(), workcell.X_WT))
    return ArmModel(
        arm.model, target, tool.tool_center, tool.wrist, [*tool.bodies, workpiece], tool.model, tool.actuators
    )


def controller_model(
    workcell: Workcell,
    robot: Robot | str = DEFAULT_ROBOT,
    end_effector: EndEffector | str = DEFAULT_END_EFFECTOR,
) -> tuple[MultibodyPlant, ArmModel]:
    """Return the controller's plant and its arm; the plant has no fixture, no offsets and no joints of the tool.

    Raises:
        InputError: If the joints of the robot's model are not `Robot.joints`, in this order.
    """
    robot = find_robot(robot)
    plant = MultibodyPlant(0.0)
    arm = add_arm(plant, workcell, robot, end_effector, as_rigid=True)
    plant.Finalize()
    starts = [plant.GetJointByName(name, arm.model).position_start() for name in robot.joints]
    if starts != list(range(plant.num_positions())):
        raise InputError(
            f"the joints of robot {robot.name!r}'s model must be those of `Robot.joints`, in order from the base to "
            "the flange: model other moving parts as an end effector"
        )
    return plant, arm


class ArmControllerPlant(ControllerPlant):
    """Model of an arm for its controller.

    The posture is half way through the workpiece's quarter turn, equally far from both ends of the turn.
    """

    def __init__(
        self,
        workcell: Workcell,
        robot: Robot | str = DEFAULT_ROBOT,
        end_effector: EndEffector | str = DEFAULT_END_EFFECTOR,
    ):
        """Construct the model; `robot` and `end_effector` are objects or names."""
        plant, self.arm = controller_model(workcell, robot, end_effector)
        super().__init__(plant, self.arm.target, self.arm.tool_center, np.array(find_robot(robot).home))
        self.posture = self.solve(MID_TURN_POSE, self.posture)


def add_gripper_control(
    builder: DiagramBuilder, plant: MultibodyPlant, arm: ArmModel, end_effector: EndEffector, period: float
) -> tuple[InputPort, OutputPort]:
    """Add the drives of a gripper with n actuated joints, sampled with `period` [s].

    Returns:
        Input port of the desired positions (n,), and output port of positions and velocities (2n,).
    """
    joints = [actuator.joint() for actuator in arm.gripper]
    lower = np.concatenate([joint.position_lower_limits() for joint in joints])
    upper = np.concatenate([joint.position_upper_limits() for joint in joints])
    opening = np.array([end_effector.opening[joint.name()] for joint in joints])
    command = builder.AddNamedSystem("gripper_command", GripperCommand(lower, upper, opening, period=period))
    # The model's state includes joints that mimic other joints.
    num_positions = plant.num_positions(arm.tool_model)
    all_joints = [plant.get_joint(index) for index in plant.GetJointIndices(arm.tool_model)]
    first = min(joint.position_start() for joint in all_joints if joint.num_positions() > 0)
    actuated = np.zeros((2 * len(joints), plant.num_multibody_states(arm.tool_model)))
    for row, joint in enumerate(joints):
        column = joint.position_start() - first
        actuated[row, column] = actuated[len(joints) + row, num_positions + column] = 1.0
    state = add_system(builder, "gripper_state", MatrixGain(actuated), plant.get_state_output_port(arm.tool_model))
    builder.Connect(command.get_desired_state_output_port(), plant.get_desired_state_input_port(arm.tool_model))
    return command.get_position_input_port(), state.get_output_port()


@register_station("arm", workcell_kind="insertion", options=ArmOptions)
class ArmStation(Station):
    """Arm under a Cartesian impedance controller, and a workcell.

    The rotors' reflected inertia makes the arm slower than the gantry. Control of the arm is therefore stable although
    the controller is evaluated once per plant step. With a gripper as the end effector, the station has two more ports:

    ==================  =========  ====================================================================================
    port                size       meaning
    ==================  =========  ====================================================================================
    `gripper_position`  n          input, optional: desired positions of the gripper's actuated joints; open by default
    `gripper_state`     2n         output: positions and velocities of these joints
    ==================  =========  ====================================================================================

    A gripper's force is limited by its actuators. Controller and wrench sensor model it as a rigid, open tool.

    If `joint_torque` is given, `wrench` is estimated from joint torques with errors, as in a `HardwareStation`, and the
    port `exact_wrench` is the exact wrench at the wrist.

    Attributes:
        estimates_wrench: True if the wrench is estimated from joint torques.
    """

    wraps_angles = True

    def __init__(
        self,
        workcell: Workcell,
        impedance: Impedance = Impedance(),  # noqa: B008 (frozen)
        time_step: float | None = None,
        *,
        robot: Robot | str = DEFAULT_ROBOT,
        end_effector: EndEffector | str = DEFAULT_END_EFFECTOR,
        joint_torque: JointTorqueAccuracy | None = None,
        joint_friction: float = 0.0,
        control_period: float = CONTROL_PERIOD,
    ):
        """Construct the station.

        Args:
            workcell: Fixture in the world and held workpiece.
            impedance: Impedance at the tool center.
            time_step: Time step of plant and controller [s]; that of the workcell, or `PLANT_PERIOD` by default, at
                most half of it with a gripper, whose fingers would otherwise penetrate the workpiece.
            robot: The arm, or its name: see `robot_names()`.
            end_effector: The tool, or its name: see `end_effector_names()`.
            joint_torque: Errors of the joint torques from which the wrench is estimated; None for a sensor at the
                wrist.
            joint_friction: Coulomb friction of each joint of the arm [Nm], which the controller does not know.
            control_period: Time between commands [s], a whole multiple of the time step.

        Raises:
            InputError: If the control period is no multiple of the time step.
        """
        super().__init__()
        self.estimates_wrench, self._joint_torque = joint_torque is not None, joint_torque
        builder = DiagramBuilder()
        end_effector = find_end_effector(end_effector)
        if time_step is None:
            time_step = plant_period(workcell, PLANT_PERIOD / 2 if end_effector.opening else PLANT_PERIOD)
        control_period, time_step = exact_periods(control_period, time_step)
        self.control_period = control_period
        self._controller_plant = ArmControllerPlant(workcell, robot, end_effector)
        self.plant, self.scene_graph, self.arm = add_workcell_plant(
            builder,
            workcell,
            time_step,
            lambda plant: add_arm(plant, workcell, robot, end_effector, joint_friction=joint_friction),
        )
        plant, arm = self.plant, self.arm
        sensor = WrenchSensor(
            plant, arm.wrist, arm.tool, arm.tool_center, workcell.X_WT.rotation(), time_step, WRENCH_TIME_CONSTANT
        )
        builder.AddNamedSystem("wrench_sensor", sensor)
        sensor.connect(builder, plant)
        wrench = contact_wrench = sensor.get_wrench_output_port()
        if joint_torque is not None:
            builder.ExportOutput(wrench, "exact_wrench")
            wrench = self._add_wrench_estimate(builder, joint_torque)
        torque = add_impedance_control(
            builder,
            self._controller_plant,
            impedance,
            control_period,
            state=plant.get_state_output_port(arm.model),
            wrench=wrench,
            contact_wrench=contact_wrench,
        )
        if joint_friction:
            n = torque.size()
            torque = add_system(builder, "torque_and_friction", MatrixGain(np.eye(2 * n, n)), torque).get_output_port()
            at_rest = builder.AddNamedSystem("friction_at_rest", ConstantVectorSource(np.zeros(4 * n)))
            builder.Connect(at_rest.get_output_port(), plant.get_desired_state_input_port(arm.model))
        builder.Connect(torque, plant.get_actuation_input_port(arm.model))
        if arm.gripper:
            position, state = add_gripper_control(builder, plant, arm, end_effector, time_step)
            builder.ExportInput(position, "gripper_position")
            builder.ExportOutput(state, "gripper_state")
        export_simulation_ports(builder, plant, self.scene_graph)
        builder.BuildInto(self)

    get_gripper_position_input_port = input_getter(
        "gripper_position", "desired positions of the gripper's actuated joints, (n,), if there is a gripper"
    )
    get_gripper_state_output_port = output_getter(
        "gripper_state", "state of the gripper's actuated joints, (2n,), if there is a gripper"
    )

    def set_pose(self, context: Context, pose: np.ndarray) -> None:
        """Put the arm at rest with its tool center at `pose`, (6,); `context` is the root context."""
        self._controller_plant.place(self.plant, self.arm.model, context, pose)

    def joint_range(self, margin: float) -> JointRange:
        """Return constraints on the joint positions at a commanded pose; see `JointRange`."""
        model = self._controller_plant
        return JointRange(model.plant, model.target, model.tool_center, model.posture, margin)

    def _add_wrench_estimate(self, builder: DiagramBuilder, accuracy: JointTorqueAccuracy) -> OutputPort:
        """Add joint torque sensors and the estimate of the wrench; return its port."""
        model, plant, arm = self._controller_plant, self.plant, self.arm
        period, largest, n = plant.time_step(), model.plant.GetEffortUpperLimits(), model.plant.num_positions()
        noise, drift = accuracy.noise * largest, accuracy.drift * largest
        state = plant.get_state_output_port(arm.model)
        contact_torque = plant.get_generalized_contact_forces_output_port(arm.model)
        self._torque_sensor = sensor = ExternalTorqueSensor(model.plant, model.arm.tool[0], noise, drift, period=period)
        add_system(builder, "torque_sensor", sensor, state=state, contact_torque=contact_torque)
        estimate = JointTorqueWrench(
            model.plant, model.target, model.tool_center, period=period, time_constant=WRENCH_ESTIMATE_TIME_CONSTANT
        )
        add_system(builder, "wrench_estimate", estimate, external_torque=sensor.get_external_torque_output_port())
        positions = add_system(builder, "positions", MatrixGain(np.eye(n, 2 * n)), state)
        builder.Connect(positions.get_output_port(), estimate.get_positions_input_port())
        return estimate.get_wrench_output_port()

    def disturb(self, context: Context, rng: np.random.Generator) -> Mapping[str, Any]:
        """If the wrench is estimated from joint torques, sample their errors; return some of the errors by name."""
        if self._joint_torque is None:
            return {}
        accuracy, sensor, plant = self._joint_torque, self._torque_sensor, self._controller_plant.plant
        largest, bodies = plant.GetEffortUpperLimits(), len(sensor.bodies)
        tool = {int(body.index()) for body in self._controller_plant.arm.tool}
        masses = np.array([body.default_mass() for body in sensor.bodies])
        is_tool = np.array([int(body.index()) in tool for body in sensor.bodies])
        errors = JointTorqueErrors(
            gain=accuracy.gain * rng.uniform(-1.0, 1.0, len(largest)),
            offset=accuracy.offset * largest * rng.uniform(-1.0, 1.0, len(largest)),
            friction=accuracy.friction * largest * rng.uniform(0.0, 1.0, len(largest)),
            mass=np.where(is_tool, 0.0, accuracy.mass * masses) * rng.uniform(-1.0, 1.0, bodies),
            center=accuracy.center * rng.uniform(-1.0, 1.0, (bodies, 3)),
        )
        payload = accuracy.payload * rng.uniform(-1.0, 1.0)
        sensor_context = sensor.GetMyMutableContextFromRoot(context)
        sensor.set_errors(sensor_context, errors, int(rng.integers(2**31)))
        sensor.add_payload(sensor_context, payload)
        return {
            "torque_offset": errors.offset,
            "torque_gain": errors.gain,
            "torque_friction": errors.friction,
            "payload_error": payload,
        }

    def set_payload(self, context: Context, mass: float) -> None:
        """Add a mass [kg] to the tool; `context` is the root context.

        The models of controller and sensor do not contain this mass.
        """
        plant_context, tool = self.plant.GetMyMutableContextFromRoot(context), self.arm.tool[0]
        tool.SetMass(plant_context, tool.default_mass() + mass)
        if self._joint_torque is not None:
            self._torque_sensor.add_payload(self._torque_sensor.GetMyMutableContextFromRoot(context), mass)
