"""The tool centre on six rails: a Cartesian impedance without an arm, for learning at several times real time."""

from __future__ import annotations

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    FixedOffsetFrame,
    Frame,
    JointActuator,
    ModelInstanceIndex,
    PdControllerGains,
    PrismaticJoint,
    RevoluteJoint,
    SpatialInertia,
    UnitInertia,
)
from pydrake.systems.framework import Context, DiagramBuilder, OutputPort
from pydrake.systems.primitives import LinearSystem, MatrixGain

from guiderail.diagrams.stations.registry import register_station
from guiderail.diagrams.stations.station import (
    CONTROL_PERIOD,
    PLANT_PERIOD,
    POSE_SIZE,
    ContactOptions,
    Impedance,
    Station,
    add_workcell_plant,
    export_simulation_ports,
    export_station_ports,
)
from guiderail.diagrams.stations.workcell import Workcell
from guiderail.systems.command_watchdog import CommandWatchdog
from guiderail.systems.impedance_monitor import ImpedanceMonitor
from guiderail.systems.pose_wrench import PoseWrench

RAILS = (
    ("x", PrismaticJoint, [1.0, 0.0, 0.0]),
    ("y", PrismaticJoint, [0.0, 1.0, 0.0]),
    ("z", PrismaticJoint, [0.0, 0.0, 1.0]),
    ("Rz", RevoluteJoint, [0.0, 0.0, 1.0]),
    ("Ry", RevoluteJoint, [0.0, 1.0, 0.0]),
    ("Rx", RevoluteJoint, [1.0, 0.0, 0.0]),
)
CARRIAGE_MASS = (
    1.5  # [kg], of all that moves: what an arm feels like at its tool when its controller shapes its inertia
)
CARRIAGE_INERTIA = 2e-3  # [kg m²]
# A link between two rails weighs next to nothing; without any inertia the plant's mass matrix would be singular.
LINK_MASS, LINK_RADIUS = 1e-3, 0.01


@register_station("rails", world="workcell", options=ContactOptions)
class RailsStation(Station):
    """Joints x, y, z, Rz, Ry, Rx from the target frame to the tool centre, each with a spring, a damper and a limit.

    Their positions are the pose itself. Springs and dampers are the plant's own actuator gains, solved implicitly with
    the contact: stable at any stiffness and time step. Weight is compensated by leaving it out.
    """

    def __init__(
        self,
        workcell: Workcell,
        impedance: Impedance = Impedance(),  # noqa: B008 (frozen)
        time_step: float | None = None,
        wrench_time_constant: float = 0.01,
    ):
        """
        Args:
            workcell: what stands in the world and what is held.
            impedance: of the rails.
            time_step: of the plant [s]; half a control period unless given.
            wrench_time_constant: of the wrench's low-pass filter [s]; 0 disables it.
        """
        super().__init__()
        builder = DiagramBuilder()
        self.plant, self.scene_graph, self.rails = add_workcell_plant(
            builder, workcell, time_step or PLANT_PERIOD, lambda plant: _add_rails(plant, workcell, impedance)
        )
        plant = self.plant

        watchdog = builder.AddNamedSystem("watchdog", CommandWatchdog(CONTROL_PERIOD))
        # The desired pose is the desired state's first half; the desired velocity is zero, so that damping damps.
        desired_state = builder.AddNamedSystem("desired_state", MatrixGain(np.eye(2 * POSE_SIZE, POSE_SIZE)))
        pose = builder.AddNamedSystem("pose", MatrixGain(np.eye(POSE_SIZE, 2 * POSE_SIZE)))
        monitor = builder.AddNamedSystem("monitor", ImpedanceMonitor(np.array(impedance.limits)))
        wrench = _add_wrench(builder, plant, self.rails, pose.get_output_port(), wrench_time_constant)
        builder.Connect(watchdog.get_safe_pose_output_port(), desired_state.get_input_port())
        builder.Connect(pose.get_output_port(), watchdog.get_pose_input_port())
        builder.Connect(desired_state.get_output_port(), plant.get_desired_state_input_port(self.rails))
        builder.Connect(plant.get_state_output_port(self.rails), pose.get_input_port())
        builder.Connect(plant.get_net_actuation_output_port(self.rails), monitor.get_impedance_wrench_input_port())
        export_station_ports(
            builder,
            watchdog.get_desired_pose_input_port(),
            watchdog.get_command_time_input_port(),
            pose=pose.get_output_port(),
            wrench=wrench,
            contact_force=monitor.get_contact_force_output_port(),
            saturation=monitor.get_saturation_output_port(),
            holding=watchdog.get_holding_output_port(),
        )
        export_simulation_ports(builder, plant, self.scene_graph)
        builder.BuildInto(self)

    def set_pose(self, context: Context, pose: np.ndarray) -> None:
        """Puts the carriage at rest at `pose`, (6,); `context` is the root context."""
        plant_context = self.plant.GetMyMutableContextFromRoot(context)
        self.plant.SetPositions(plant_context, self.rails, pose)
        self.plant.SetVelocities(plant_context, self.rails, np.zeros(POSE_SIZE))


def _add_rails(plant: MultibodyPlant, workcell: Workcell, impedance: Impedance) -> ModelInstanceIndex:
    """Adds the rails and behind them the tool with the workpiece, all weightless."""
    model = plant.AddModelInstance("rails")
    parent: Frame = plant.AddFrame(FixedOffsetFrame("target", plant.world_frame(), workcell.X_WT))
    masses = np.array([CARRIAGE_MASS] * 3 + [CARRIAGE_INERTIA] * 3)
    dampings = 2.0 * impedance.damping_ratio * np.sqrt(np.array(impedance.stiffness) * masses)
    for (name, joint_type, axis), stiffness, damping, limit in zip(
        RAILS, impedance.stiffness, dampings, impedance.limits, strict=True
    ):
        link = plant.AddRigidBody(f"{name}_link", model, SpatialInertia.SolidSphereWithMass(LINK_MASS, LINK_RADIUS))
        joint = plant.AddJoint(joint_type(name, parent, link.body_frame(), axis))
        actuator: JointActuator = plant.AddJointActuator(f"{name}_motor", joint, limit)
        actuator.set_controller_gains(PdControllerGains(p=stiffness, d=damping))
        parent = link.body_frame()
    inertia = UnitInertia(*np.full(3, CARRIAGE_INERTIA / CARRIAGE_MASS))
    tool = plant.AddRigidBody("tool_centre", model, SpatialInertia(CARRIAGE_MASS, np.zeros(3), inertia))
    plant.WeldFrames(parent, tool.body_frame())
    workpiece = workcell.add_workpiece(plant, tool.body_frame())
    for weightless in (model, workpiece.model_instance()):
        plant.set_gravity_enabled(weightless, False)
    return model


def _add_wrench(
    builder: DiagramBuilder, plant: MultibodyPlant, rails: ModelInstanceIndex, pose: OutputPort, time_constant: float
) -> OutputPort:
    """Adds the wrench of the plug's contact, low-pass filtered: one plant step old, as a sensor's is.

    What runs at every plant step is Drake's own; the wrench is computed where somebody reads it.
    """
    period = plant.time_step()
    decay = float(np.exp(-period / time_constant)) if time_constant > 0.0 else 0.0
    one, zero = np.eye(POSE_SIZE), np.zeros((POSE_SIZE, POSE_SIZE))
    low_pass = builder.AddNamedSystem("low_pass", LinearSystem(decay * one, (1.0 - decay) * one, one, zero, period))
    wrench = builder.AddNamedSystem("wrench", PoseWrench())
    builder.Connect(plant.get_generalized_contact_forces_output_port(rails), low_pass.get_input_port())
    builder.Connect(low_pass.get_output_port(), wrench.get_generalized_force_input_port())
    builder.Connect(pose, wrench.get_pose_input_port())
    return wrench.get_wrench_output_port()
