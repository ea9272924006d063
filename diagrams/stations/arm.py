"""An iiwa 14 under a Cartesian impedance, with a connector tool."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import FixedOffsetFrame, Frame, ModelInstanceIndex, RigidBody, WeldJoint
from pydrake.systems.framework import Context, DiagramBuilder

from guiderail.diagrams.stations.station import (
    PLANT_PERIOD,
    Impedance,
    Station,
    add_contact_plant,
    export_simulation_ports,
)
from guiderail.diagrams.stations.workcell import Workcell
from guiderail.models.parsing import add_model
from guiderail.models.pose_coordinates import pose_to_transform
from guiderail.models.robots.iiwa import CONNECTOR_TOOL_URDF, IIWA_URDF, NUM_JOINTS, READY_POSTURE
from guiderail.models.robots.inverse_kinematics import solve_inverse_kinematics
from guiderail.systems.cartesian_impedance_controller import CartesianImpedanceController, ImpedanceGains
from guiderail.systems.impedance_monitor import ImpedanceMonitor
from guiderail.systems.wrench_sensor import WrenchSensor

# The tool is bolted on turned by this much, so that a quarter turn lies symmetric about joint 7's middle.
TOOL_TURN = 0.75 * np.pi  # [rad]
# The arm's joints are torque-controlled: feedback of the joint torque makes the rotors appear this much lighter
# (Albu-Schäffer, Ott, Hirzinger 2007). Without it a Cartesian impedance would lag far behind its command.
APPARENT_ROTOR_INERTIA = 0.1


@dataclass(frozen=True)
class ArmModel:
    """The arm, its tool and what it holds, in some plant."""

    model: ModelInstanceIndex
    target: Frame
    tool_centre: Frame
    wrist: WeldJoint
    tool: list[RigidBody]


def add_arm(plant: MultibodyPlant, workcell: Workcell) -> ArmModel:
    """Adds the arm at the world's origin, the tool, and the workpiece in it."""
    arm = add_model(plant, IIWA_URDF)
    plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("iiwa_link_0", arm))
    tool = add_model(plant, CONNECTOR_TOOL_URDF)
    wrist = plant.WeldFrames(
        plant.GetFrameByName("iiwa_flange", arm),
        plant.GetFrameByName("tool_body", tool),
        RigidTransform(RotationMatrix.MakeZRotation(TOOL_TURN), np.zeros(3)),
    )
    tool_centre = plant.GetFrameByName("tool_centre", tool)
    for number in range(1, NUM_JOINTS + 1):
        actuator = plant.GetJointActuatorByName(f"iiwa_motor_{number}", arm)
        actuator.set_default_rotor_inertia(APPARENT_ROTOR_INERTIA * actuator.default_rotor_inertia())
    workpiece = workcell.add_workpiece(plant, tool_centre)
    target = plant.AddFrame(FixedOffsetFrame("target", plant.world_frame(), workcell.X_WT))
    carried = [plant.GetBodyByName("tool_body", tool), plant.GetBodyByName("tool_centre", tool), workpiece]
    return ArmModel(arm, target, tool_centre, wrist, carried)


def controller_model(workcell: Workcell) -> tuple[MultibodyPlant, ArmModel]:
    """The arm alone, as its controller knows it: without the fixture, without offsets."""
    plant = MultibodyPlant(0.0)
    arm = add_arm(plant, workcell)
    plant.Finalize()
    return plant, arm


def impedance_gains(impedance: Impedance, posture: np.ndarray) -> ImpedanceGains:
    """The station's impedance, which is ordered as a pose is, as the controller wants it."""
    by_axis = [0, 1, 2, 5, 4, 3]
    return ImpedanceGains(
        stiffness=np.diag(np.array(impedance.stiffness)[by_axis]),
        wrench_limits=np.array(impedance.limits)[by_axis],
        posture=posture,
        damping_ratio=impedance.damping_ratio,
    )


class ArmStation(Station):
    """The arm, its controller and the workcell.

    Its rotors' reflected inertia makes the arm slower than the rails to follow, and stable under a controller that is
    as slow as the plant's step.
    """

    def __init__(
        self,
        workcell: Workcell,
        impedance: Impedance = Impedance(),  # noqa: B008 (frozen)
        time_step: float = PLANT_PERIOD,
        wrench_time_constant: float = 0.01,
    ):
        """
        Args:
            workcell: what stands in the world and what is held.
            impedance: at the tool centre.
            time_step: of the plant and of the controller [s].
            wrench_time_constant: of the wrench sensor's low-pass filter [s].
        """
        super().__init__()
        builder = DiagramBuilder()
        self.plant, self.scene_graph = plant, _ = add_contact_plant(builder, time_step)
        workcell.add_fixture(plant)
        self.arm = add_arm(plant, workcell)
        plant.Finalize()
        workcell.filter_contacts(plant, self.scene_graph)

        self.controller_plant, self._controller_arm = controller_model(workcell)
        # Halfway through the quarter turn, so that the posture pulls either way alike.
        self.posture = self.solve(np.array([0.0, 0.0, 0.0, np.pi / 4, 0.0, 0.0]), READY_POSTURE)
        controller = builder.AddNamedSystem(
            "controller",
            CartesianImpedanceController(
                self.controller_plant,
                self._controller_arm.target,
                self._controller_arm.tool_centre,
                impedance_gains(impedance, self.posture),
                period=time_step,
            ),
        )
        monitor = builder.AddNamedSystem("monitor", ImpedanceMonitor(np.array(impedance.limits)[[0, 1, 2, 5, 4, 3]]))
        sensor = builder.AddNamedSystem(
            "wrench_sensor",
            WrenchSensor(
                plant,
                self.arm.wrist,
                self.arm.tool,
                self.arm.tool_centre,
                workcell.X_WT.rotation(),
                time_step,
                wrench_time_constant,
            ),
        )
        sensor.connect(builder, plant)
        builder.Connect(plant.get_state_output_port(self.arm.model), controller.get_state_input_port())
        builder.Connect(controller.get_torque_output_port(), plant.get_actuation_input_port(self.arm.model))
        builder.Connect(controller.get_impedance_wrench_output_port(), monitor.get_impedance_wrench_input_port())
        builder.ExportInput(controller.get_desired_pose_input_port(), "desired_pose")
        builder.ExportInput(controller.get_command_time_input_port(), "command_time")
        builder.ExportOutput(controller.get_pose_output_port(), "pose")
        builder.ExportOutput(sensor.get_wrench_output_port(), "wrench")
        builder.ExportOutput(monitor.get_contact_force_output_port(), "contact_force")
        builder.ExportOutput(controller.get_saturation_output_port(), "saturation")
        builder.ExportOutput(controller.get_holding_output_port(), "holding")
        export_simulation_ports(builder, plant, self.scene_graph)
        builder.BuildInto(self)

    def solve(self, pose: np.ndarray, guess: np.ndarray) -> np.ndarray:
        """Joint positions (7,) with the tool centre at `pose`, (6,)."""
        arm = self._controller_arm
        return solve_inverse_kinematics(
            self.controller_plant, arm.target, arm.tool_centre, pose_to_transform(pose), guess
        )

    def set_pose(self, context: Context, pose: np.ndarray) -> None:
        """Puts the arm at rest with its tool centre at `pose`, (6,); `context` is the root context."""
        plant_context = self.plant.GetMyMutableContextFromRoot(context)
        self.plant.SetPositions(plant_context, self.arm.model, self.solve(pose, self.posture))
        self.plant.SetVelocities(plant_context, self.arm.model, np.zeros(NUM_JOINTS))
