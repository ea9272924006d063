"""Gantry station: tool center on six impedance-controlled joints, faster to simulate than an arm.

The station `mujoco` of packages/mujoco has the same joints, carriage and damping and imports them from here.
"""

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

from guiderail.diagrams.stations.impedance_control import add_impedance_control, add_joint_impedance
from guiderail.diagrams.stations.options import GantryOptions, ImpedanceControl
from guiderail.diagrams.stations.registry import register_station
from guiderail.diagrams.stations.station import (
    CONTROL_PERIOD,
    PLANT_PERIOD,
    WRENCH_TIME_CONSTANT,
    ControllerPlant,
    Impedance,
    Station,
    add_workcell_plant,
    check_pose,
    exact_periods,
    export_simulation_ports,
    plant_period,
    set_at_rest,
)
from guiderail.diagrams.stations.workcell import Workcell
from guiderail.diagrams.wiring import add_system
from guiderail.models.common.errors import InputError
from guiderail.models.common.transforms import POSE_SIZE
from guiderail.systems.wrench_signals import PoseWrench

GANTRY_JOINTS = (
    ("x", PrismaticJoint, [1.0, 0.0, 0.0]),
    ("y", PrismaticJoint, [0.0, 1.0, 0.0]),
    ("z", PrismaticJoint, [0.0, 0.0, 1.0]),
    ("Rz", RevoluteJoint, [0.0, 0.0, 1.0]),
    ("Ry", RevoluteJoint, [0.0, 1.0, 0.0]),
    ("Rx", RevoluteJoint, [1.0, 0.0, 0.0]),
)
# Mass [kg] and moment of inertia [kg m²] of the moving tool, as at the tool of an arm with inertia shaping.
CARRIAGE_MASS, CARRIAGE_INERTIA = 1.5, 2e-3
MASSES = np.array([CARRIAGE_MASS] * 3 + [CARRIAGE_INERTIA] * 3)  # mass or moment of inertia that each joint moves
# Mass [kg] and radius [m] of a link between two joints; massless links would make the plant's mass matrix singular.
LINK_MASS, LINK_RADIUS = 1e-3, 0.01

# Time step of the plant with a Cartesian controller [s]. The controller's forces are constant within a step; forces of
# the joint springs are not. With this step, Cartesian control is as accurate as joint springs with `PLANT_PERIOD`: see
# `python -m research.benchmarks impedance`.
CARTESIAN_PLANT_PERIOD = PLANT_PERIOD / 2


def joint_damping(impedance: Impedance) -> np.ndarray:
    """Return the damping of the joints for an impedance, (6,) [N s/m, Nm s/rad]."""
    return 2.0 * impedance.damping_ratio * np.sqrt(np.array(impedance.stiffness) * MASSES)


@register_station("gantry", workcell_kind="insertion", options=GantryOptions)
class GantryStation(Station):
    """Gantry with joints x, y, z, Rz, Ry, Rx from the target frame to the tool center.

    The joint positions are the pose, and joint efforts are limited. There are two kinds of impedance control. "joint":
    the springs and dampers are PD gains of the plant's actuators, solved implicitly with the contact, which is stable
    at any stiffness and time step. "cartesian": a `CartesianImpedanceController` computes the forces explicitly at each
    time step of the plant, as on a real robot, and therefore needs shorter steps. There is no gravity, as on a robot
    with gravity compensation.
    """

    def __init__(
        self,
        workcell: Workcell,
        impedance: Impedance = Impedance(),  # noqa: B008 (frozen)
        time_step: float | None = None,
        impedance_control: ImpedanceControl = "joint",
        control_period: float = CONTROL_PERIOD,
    ):
        """Construct the station.

        Args:
            workcell: Fixture in the world and held workpiece.
            impedance: Impedance at the tool center.
            time_step: Time step of the plant [s]; default: that of the workcell, or half of `CONTROL_PERIOD`, a quarter
                for "cartesian".
            impedance_control: "joint" or "cartesian", see `GantryStation`.
            control_period: Time between commands [s], a whole multiple of the time step.

        Raises:
            InputError: If there is no such impedance control, the time step is too long for a Cartesian controller
                with this impedance, or the control period is no multiple of the time step.
        """
        super().__init__()
        builder = DiagramBuilder()
        is_joint = impedance_control == "joint"
        if time_step is None:
            time_step = plant_period(workcell, PLANT_PERIOD if is_joint else CARTESIAN_PLANT_PERIOD)
        control_period, time_step = exact_periods(control_period, time_step)
        self.control_period = control_period
        if not is_joint:
            _check_time_step(impedance, time_step)
        self.plant, self.scene_graph, self.gantry = add_workcell_plant(
            builder, workcell, time_step, lambda plant: _add_gantry(plant, workcell, impedance, with_gains=is_joint)
        )
        plant, gantry = self.plant, self.gantry
        state = plant.get_state_output_port(gantry)
        pose = add_system(builder, "pose", MatrixGain(np.eye(POSE_SIZE, 2 * POSE_SIZE)), state).get_output_port()
        wrench = _add_wrench(builder, plant, gantry, pose)
        if is_joint:
            desired = add_joint_impedance(
                builder,
                impedance,
                damping=joint_damping(impedance),
                mass=moving_mass(plant),
                time_step=time_step,
                pose=pose,
                state=state,
                wrench=wrench,
                impedance_wrench=plant.get_net_actuation_output_port(gantry),
                control_period=control_period,
            )
            # The desired pose is the first half of the desired state; the desired velocity is zero.
            desired_state = add_system(builder, "desired_state", MatrixGain(np.eye(2 * POSE_SIZE, POSE_SIZE)), desired)
            builder.Connect(desired_state.get_output_port(), plant.get_desired_state_input_port(gantry))
        else:
            torque = add_impedance_control(
                builder,
                _controller_plant(workcell, impedance),
                impedance,
                control_period,
                state=state,
                wrench=wrench,
                compensate_gravity=False,
            )
            builder.Connect(torque, plant.get_actuation_input_port(gantry))
        export_simulation_ports(builder, self.plant, self.scene_graph)
        builder.BuildInto(self)

    def set_pose(self, context: Context, pose: np.ndarray) -> None:
        """Put the tool at rest at `pose`, (6,); `context` is the root context."""
        set_at_rest(self.plant, self.gantry, context, check_pose(pose, POSE_SIZE))


def moving_mass(plant: MultibodyPlant) -> float:
    """Return the mass of the tool and the bodies that are fixed to it [kg]; the links' mass is negligible."""
    tool = plant.GetBodiesWeldedTo(plant.GetBodyByName("tool_center"))
    return float(sum(body.default_mass() for body in tool))


def max_stable_time_step(impedance: Impedance) -> float:
    """Return the time step [s] above which a Cartesian controller with an impedance is unstable.

    The controller's force K e − D v is constant within a time step h, and the plant is integrated by the semi-implicit
    Euler method. A mode with natural frequency ω and damping ratio ζ is then stable if h ω < 2 (√(1 + ζ²) − ζ).
    """
    fastest = float(np.sqrt(np.max(np.array(impedance.stiffness) / MASSES)))  # [rad/s]
    ratio = impedance.damping_ratio
    return 2.0 * float(np.hypot(1.0, ratio) - ratio) / fastest


def _check_time_step(impedance: Impedance, time_step: float) -> None:
    longest = max_stable_time_step(impedance)
    if time_step >= longest:
        raise InputError(
            f"time_step {time_step:g} s is too long for impedance_control='cartesian', which needs less than "
            f"{longest:.2g} s with this impedance: make it shorter, or choose impedance_control='joint'"
        )


def _controller_plant(workcell: Workcell, impedance: Impedance) -> ControllerPlant:
    plant = MultibodyPlant(0.0)
    _add_gantry(plant, workcell, impedance, with_gains=False)
    plant.Finalize()
    target, tool_center = (plant.GetFrameByName(name) for name in ("target", "tool_center"))
    return ControllerPlant(plant, target, tool_center, np.zeros(POSE_SIZE))


def _add_gantry(
    plant: MultibodyPlant, workcell: Workcell, impedance: Impedance, *, with_gains: bool
) -> ModelInstanceIndex:
    """Add joints, tool and workpiece without gravity; add springs and dampers to the joints if `with_gains` is True."""
    model = plant.AddModelInstance("gantry")
    parent: Frame = plant.AddFrame(FixedOffsetFrame("target", plant.world_frame(), workcell.X_WT))
    for (name, joint_type, axis), stiffness, damping, limit in zip(
        GANTRY_JOINTS, impedance.stiffness, joint_damping(impedance), impedance.limits, strict=True
    ):
        link = plant.AddRigidBody(f"{name}_link", model, SpatialInertia.SolidSphereWithMass(LINK_MASS, LINK_RADIUS))
        joint = plant.AddJoint(joint_type(name, parent, link.body_frame(), axis))
        actuator: JointActuator = plant.AddJointActuator(f"{name}_motor", joint, limit)
        if with_gains:
            actuator.set_controller_gains(PdControllerGains(p=stiffness, d=damping))
        parent = link.body_frame()
    inertia = UnitInertia(*np.full(3, CARRIAGE_INERTIA / CARRIAGE_MASS))
    tool = plant.AddRigidBody("tool_center", model, SpatialInertia(CARRIAGE_MASS, np.zeros(3), inertia))
    plant.WeldFrames(parent, tool.body_frame())
    workpiece = workcell.add_workpiece(plant, tool.body_frame())
    for weightless in (model, workpiece.model_instance()):
        plant.set_gravity_enabled(weightless, False)
    return model


def _add_wrench(
    builder: DiagramBuilder, plant: MultibodyPlant, gantry: ModelInstanceIndex, pose: OutputPort
) -> OutputPort:
    """Add the contact wrench with a low-pass filter and, as from a sensor, a delay of one plant step; return its port.

    Only C++ systems of Drake run at every plant step; the Python system `PoseWrench` runs when its output is read.
    """
    period = plant.time_step()
    decay = float(np.exp(-period / WRENCH_TIME_CONSTANT))
    identity = np.eye(POSE_SIZE)
    low_pass = LinearSystem(decay * identity, (1.0 - decay) * identity, identity, 0 * identity, period)
    add_system(builder, "low_pass", low_pass, plant.get_generalized_contact_forces_output_port(gantry))
    wrench = add_system(builder, "wrench", PoseWrench(), pose=pose, generalized_force=low_pass.get_output_port())
    return wrench.get_wrench_output_port()
