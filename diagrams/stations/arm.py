"""An iiwa 14 under a Cartesian impedance, with a connector tool."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import FixedOffsetFrame, Frame, ModelInstanceIndex, RigidBody, WeldJoint
from pydrake.systems.framework import Context, DiagramBuilder, OutputPort

from guiderail.diagrams.stations.registry import register_station
from guiderail.diagrams.stations.station import (
    PLANT_PERIOD,
    Impedance,
    Station,
    add_workcell_plant,
    add_wrench_sensor,
    export_simulation_ports,
    export_station_ports,
    force_first,
)
from guiderail.diagrams.stations.workcell import Workcell
from guiderail.models.parsing import add_model
from guiderail.models.pose_coordinates import pose_to_transform
from guiderail.models.robots.iiwa import CONNECTOR_TOOL_URDF, IIWA_URDF, NUM_JOINTS, READY_POSTURE
from guiderail.models.robots.inverse_kinematics import solve_inverse_kinematics
from guiderail.systems.cartesian_impedance_controller import CartesianImpedanceController, ImpedanceGains
from guiderail.systems.impedance_monitor import ImpedanceMonitor

# The tool is bolted on turned by this much, so that a quarter turn lies symmetric about joint 7's middle.
TOOL_TURN = 0.75 * np.pi  # [rad]
# The arm's joints are torque-controlled: feedback of the joint torque makes the rotors appear this much lighter
# (Albu-Schäffer, Ott, Hirzinger 2007). Without it a Cartesian impedance would lag far behind its command.
APPARENT_ROTOR_INERTIA = 0.1
MIDDLE_OF_TURN = np.array([0.0, 0.0, 0.0, np.pi / 4, 0.0, 0.0])


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


class KnownArm:
    """The arm as its controller knows it, and what follows from that alone.

    Attributes:
        plant: the arm, its tool and the workpiece; no fixture, no offsets.
        arm: in that plant.
        posture: halfway through the workpiece's quarter turn, so that a null space that returns to it pulls either way
            alike, (7,).
    """

    def __init__(self, workcell: Workcell):
        """
        Args:
            workcell: what is held, and where the target is.
        """
        self.plant, self.arm = controller_model(workcell)
        self.posture = self.solve(MIDDLE_OF_TURN, READY_POSTURE)

    def solve(self, pose: np.ndarray, guess: np.ndarray) -> np.ndarray:
        """Joint positions (7,) with the tool centre at `pose`, (6,)."""
        arm = self.arm
        return solve_inverse_kinematics(self.plant, arm.target, arm.tool_centre, pose_to_transform(pose), guess)

    def place(self, plant: MultibodyPlant, model: ModelInstanceIndex, context: Context, pose: np.ndarray) -> None:
        """Puts an arm of a station's plant at rest with its tool centre at `pose`, (6,); `context` is the root's."""
        plant_context = plant.GetMyMutableContextFromRoot(context)
        plant.SetPositions(plant_context, model, self.solve(pose, self.posture))
        plant.SetVelocities(plant_context, model, np.zeros(NUM_JOINTS))


def impedance_gains(impedance: Impedance, posture: np.ndarray) -> ImpedanceGains:
    """The station's impedance, which is ordered as a pose is, as the controller wants it."""
    return ImpedanceGains(
        stiffness=np.diag(force_first(impedance.stiffness)),
        wrench_limits=force_first(impedance.limits),
        posture=posture,
        damping_ratio=impedance.damping_ratio,
    )


def add_impedance_control(
    builder: DiagramBuilder,
    known: KnownArm,
    impedance: Impedance,
    period: float,
    *,
    state: OutputPort,
    wrench: OutputPort,
    compensate_gravity: bool = True,
) -> OutputPort:
    """Adds the controller of an arm whose joints are at `state`, and exports a station's ports; returns the torque."""
    controller = builder.AddNamedSystem(
        "controller",
        CartesianImpedanceController(
            known.plant,
            known.arm.target,
            known.arm.tool_centre,
            impedance_gains(impedance, known.posture),
            period=period,
            compensate_gravity=compensate_gravity,
        ),
    )
    monitor = builder.AddNamedSystem("monitor", ImpedanceMonitor(force_first(impedance.limits)))
    builder.Connect(state, controller.get_state_input_port())
    builder.Connect(controller.get_impedance_wrench_output_port(), monitor.get_impedance_wrench_input_port())
    export_station_ports(
        builder,
        controller.get_desired_pose_input_port(),
        controller.get_command_time_input_port(),
        pose=controller.get_pose_output_port(),
        wrench=wrench,
        contact_force=monitor.get_contact_force_output_port(),
        saturation=controller.get_saturation_output_port(),
        holding=controller.get_holding_output_port(),
    )
    return controller.get_torque_output_port()


@register_station("arm", world="workcell")
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
        self.plant, self.scene_graph, self.arm = add_workcell_plant(
            builder, workcell, time_step, lambda plant: add_arm(plant, workcell)
        )
        plant, arm = self.plant, self.arm
        self._known = KnownArm(workcell)
        wrench = add_wrench_sensor(builder, plant, workcell, arm.wrist, arm.tool, arm.tool_centre, wrench_time_constant)
        torque = add_impedance_control(
            builder,
            self._known,
            impedance,
            time_step,
            state=plant.get_state_output_port(arm.model),
            wrench=wrench,
        )
        builder.Connect(torque, plant.get_actuation_input_port(arm.model))
        export_simulation_ports(builder, plant, self.scene_graph)
        builder.BuildInto(self)

    def set_pose(self, context: Context, pose: np.ndarray) -> None:
        """Puts the arm at rest with its tool centre at `pose`, (6,); `context` is the root context."""
        self._known.place(self.plant, self.arm.model, context, pose)
