"""What every station has in common: its ports, its numbers, and how it is placed at a reset.

A *station* is a diagram with the robot, its controller and the objects of a task. Whatever the robot, it has

=================  =====  ==========================================================================================
input              size   meaning
=================  =====  ==========================================================================================
`desired_pose`     6      where the tool centre P shall be: X_TP as [x y z Rz Ry Rx], metres and radians
`command_time`     1      optional: when `desired_pose` was given [s]; where it stops, the last safe pose is held
=================  =====  ==========================================================================================

=================  =====  ==========================================================================================
output             size   meaning
=================  =====  ==========================================================================================
`pose`             6      where P is: X_TP, in the same coordinates
`wrench`           6      of the surroundings on the tool, at P, in the axes of T: [fx fy fz tx ty tz], N and Nm,
                          without the tool's own weight and inertia, low-pass filtered
`contact_force`    1      size of the force with which the impedance pushes [N]: what a collision is judged by
`saturation`       1      1 while the controller is at a limit of force or torque, otherwise 0
`command_timed_out`          1      1 while commands have stopped, or are no numbers, and the last safe pose is held
=================  =====  ==========================================================================================

A simulated station also has `query` (the scene graph's) and `body_poses` (the plant's): for cameras, and for judging
what a robot can't see of itself.

The orientation of X_TP is Rz(a) Ry(b) Rx(c), T being the target frame of the workcell: the pose is all zeros when the
task is done. T lies still in the world, where the *nominal* fixture wants it: a station does not know of offsets.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field, field_validator
from pydrake.geometry import ProximityProperties, Role, RoleAssign, SceneGraph
from pydrake.multibody.plant import AddMultibodyPlant, CoulombFriction, MultibodyPlant, MultibodyPlantConfig
from pydrake.multibody.tree import Frame, RigidBody, WeldJoint
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, InputPort, OutputPort

from guiderail.diagrams.envs.options import Number, Options
from guiderail.diagrams.envs.task_diagram import round_period
from guiderail.diagrams.stations.workcell import Workcell
from guiderail.models.common.errors import InputError, brief
from guiderail.systems.wrench_sensor import WrenchSensor

Robot = TypeVar("Robot")

INPUTS = ("desired_pose", "command_time")
OUTPUTS = ("pose", "wrench", "contact_force", "saturation", "command_timed_out")
"""The ports of every station."""

POSE_SIZE = 6
CONTROL_PERIOD = 4 * round_period(0.005)  # [s]
# `python -m research.benchmarks time_step` shows by how much a longer and a shorter one are wrong, and what they cost.
PLANT_PERIOD = CONTROL_PERIOD / 2  # [s]
MAX_HALVINGS = 7


class ContactOptions(Options):
    """Of a station whose plant simulates an insertion's contact."""

    time_step: Number | None = Field(
        None, gt=0, description="of the plant [s]: the control period, or half, a quarter, an eighth … of it"
    )

    @field_validator("time_step")
    @classmethod
    def _part_of_control_period(cls, value: float | None) -> float | None:
        if value is None:
            return None
        halvings = np.log2(CONTROL_PERIOD / value)
        if abs(halvings - round(halvings)) > 1e-6 or not 0 <= round(halvings) <= MAX_HALVINGS:
            raise ValueError(
                f"it is the control period, {CONTROL_PERIOD:g} s, or half, a quarter, … of it, at most {MAX_HALVINGS} "
                "times halved"
            )
        # Whose multiples are exact: see `round_period`.
        return CONTROL_PERIOD / 2 ** round(halvings)


@dataclass(frozen=True)
class Impedance:
    """How the tool centre gives way, along and about the axes of T: [x y z Rz Ry Rx]."""

    stiffness: tuple[float, ...] = (1500.0, 1500.0, 1500.0, 30.0, 30.0, 30.0)  # [N/m], [Nm/rad]
    damping_ratio: float = 1.0
    limits: tuple[float, ...] = (40.0, 40.0, 40.0, 3.0, 3.0, 3.0)  # [N], [Nm]

    def __post_init__(self) -> None:
        for name in ("stiffness", "limits"):
            value = np.asarray(getattr(self, name), dtype=float)
            if value.shape != (POSE_SIZE,) or not (np.isfinite(value) & (value > 0.0)).all():
                raise InputError(f"the impedance's {name} need six positive numbers, not {getattr(self, name)}")
        if not (np.isfinite(self.damping_ratio) and self.damping_ratio > 0.0):
            raise InputError(f"the impedance's damping_ratio must be positive, not {self.damping_ratio}")


class Station(Diagram):
    """A diagram with the ports above."""

    plant: MultibodyPlant
    scene_graph: SceneGraph
    control_period: float = CONTROL_PERIOD
    """Seconds between commands."""
    wraps_angles: bool = False
    """Whether its pose's angles are in (−π, π] and jump there, as a body's do; rails' are how far they turned."""

    @property
    def nominal_period(self) -> float:
        """Seconds between commands where its clock is right."""
        return self.control_period

    @property
    def pose_size(self) -> int:
        """O, numbers in a pose."""
        return self.get_pose_output_port().size()

    @property
    def wrench_size(self) -> int:
        """W, numbers in a wrench."""
        return self.get_wrench_output_port().size()

    def get_desired_pose_input_port(self):
        """Where the tool centre shall be, (6,)."""
        return self.GetInputPort("desired_pose")

    def get_command_time_input_port(self):
        """When the desired pose was given, (1,) [s]; optional."""
        return self.GetInputPort("command_time")

    def get_pose_output_port(self):
        """Where the tool centre is, (6,)."""
        return self.GetOutputPort("pose")

    def get_wrench_output_port(self):
        """The wrench of the surroundings on the tool, (6,)."""
        return self.GetOutputPort("wrench")

    def get_contact_force_output_port(self):
        """The force with which the impedance pushes, (1,) [N]."""
        return self.GetOutputPort("contact_force")

    def get_saturation_output_port(self):
        """1 while the controller is at a limit, (1,)."""
        return self.GetOutputPort("saturation")

    def get_command_timed_out_output_port(self):
        """1 while the last safe pose is held, (1,)."""
        return self.GetOutputPort("command_timed_out")

    @abstractmethod
    def set_pose(self, context: Context, pose: np.ndarray) -> None:
        """Puts the robot at rest with its tool centre at `pose`, (6,); `context` is the root context.

        Raises:
            InputError: if these are not that many finite numbers (see `check_pose`).
        """

    def set_contact(self, context: Context, friction: float, modulus: float) -> None:
        """Multiplies all friction and all compliance of the contact by a factor, until the next reset.

        `context` is the root context; it is Drake's contact here, and another engine's station overrides it.
        """
        scale_contact(self.plant, self.scene_graph, context, friction, modulus)

    def disturb(self, context: Context, rng: np.random.Generator) -> Mapping[str, Any]:
        """Draws what a reset draws of the station itself, and says so; `context` is the root context."""
        return {}


def check_pose(pose: ArrayLike, size: int) -> np.ndarray:
    """A pose (size,) that a robot can be put to: Drake would end the process for one that is not finite.

    Raises:
        InputError: if it is not so many finite numbers.
    """
    try:
        numbers = np.asarray(pose, dtype=float)
        if numbers.shape != (size,) or not np.isfinite(numbers).all():
            raise ValueError
    except (TypeError, ValueError):
        raise InputError(f"a robot is put to a pose of {size} finite numbers, not {brief(pose)}") from None
    return numbers


def scale_contact(
    plant: MultibodyPlant, scene_graph: SceneGraph, context: Context, friction: float, modulus: float
) -> None:
    """Multiplies friction and hydroelastic modulus of all of a plant's surfaces, in the root context alone."""
    own = scene_graph.GetMyMutableContextFromRoot(context)
    inspector = scene_graph.model_inspector()
    for geometry in inspector.GetAllGeometryIds(Role.kProximity):
        properties = ProximityProperties(inspector.GetProximityProperties(geometry))
        if properties.HasProperty("material", "coulomb_friction"):
            nominal = properties.GetProperty("material", "coulomb_friction")
            factored = CoulombFriction(friction * nominal.static_friction(), friction * nominal.dynamic_friction())
            properties.UpdateProperty("material", "coulomb_friction", factored)
        if properties.HasProperty("hydroelastic", "hydroelastic_modulus"):
            nominal = properties.GetProperty("hydroelastic", "hydroelastic_modulus")
            properties.UpdateProperty("hydroelastic", "hydroelastic_modulus", modulus * nominal)
        scene_graph.AssignRole(own, plant.get_source_id(), geometry, properties, RoleAssign.kReplace)


def add_contact_plant(builder: DiagramBuilder, time_step: float) -> tuple[MultibodyPlant, SceneGraph]:
    """A plant whose contact is that of the connector's files: polygons on compliant primitives, quietly regularized."""
    if not time_step > 0.0:
        raise InputError(f"the plant's time step must be positive, not {time_step} s")
    config = MultibodyPlantConfig(
        time_step=time_step,
        contact_model="hydroelastic_with_fallback",
        discrete_contact_approximation="lagged",
        contact_surface_representation="polygon",
        # A plant with sampled ports steps by an unrestricted update, which Drake runs *before* the discrete updates of
        # the same instant: a new command would then reach it one step late.
        use_sampled_output_ports=False,
    )
    return AddMultibodyPlant(config, builder)


def add_workcell_plant(
    builder: DiagramBuilder, workcell: Workcell, time_step: float, add_robot: Callable[[MultibodyPlant], Robot]
) -> tuple[MultibodyPlant, SceneGraph, Robot]:
    """A finalized plant with the workcell's fixture, and the robot that `add_robot` adds with the workpiece."""
    plant, scene_graph = add_contact_plant(builder, time_step)
    workcell.add_fixture(plant)
    robot = add_robot(plant)
    plant.Finalize()
    workcell.filter_contacts(plant, scene_graph)
    return plant, scene_graph, robot


def add_wrench_sensor(
    builder: DiagramBuilder,
    plant: MultibodyPlant,
    workcell: Workcell,
    wrist: WeldJoint,
    tool: list[RigidBody],
    tool_centre: Frame,
    time_constant: float,
) -> OutputPort:
    """Adds a sensor at the wrist, behind which `tool` hangs; returns the wrench as a station exports it."""
    axes = workcell.X_WT.rotation()
    sensor = WrenchSensor(plant, wrist, tool, tool_centre, axes, plant.time_step(), time_constant)
    builder.AddNamedSystem("wrench_sensor", sensor)
    sensor.connect(builder, plant)
    return sensor.get_wrench_output_port()


def to_wrench_order(values: Sequence[float]) -> np.ndarray:
    """What is ordered as a pose is, [x y z Rz Ry Rx], as a wrench is: [x y z Rx Ry Rz]."""
    return np.array(values)[[0, 1, 2, 5, 4, 3]]


def export_station_ports(
    builder: DiagramBuilder,
    desired_pose: InputPort,
    command_time: InputPort,
    *,
    pose: OutputPort,
    wrench: OutputPort,
    contact_force: OutputPort,
    saturation: OutputPort,
    command_timed_out: OutputPort,
) -> None:
    """Exports the ports of the table above."""
    builder.ExportInput(desired_pose, "desired_pose")
    builder.ExportInput(command_time, "command_time")
    builder.ExportOutput(pose, "pose")
    builder.ExportOutput(wrench, "wrench")
    builder.ExportOutput(contact_force, "contact_force")
    builder.ExportOutput(saturation, "saturation")
    builder.ExportOutput(command_timed_out, "command_timed_out")


def export_simulation_ports(builder: DiagramBuilder, plant: MultibodyPlant, scene_graph: SceneGraph) -> None:
    """Exports what only a simulation knows."""
    builder.ExportOutput(scene_graph.get_query_output_port(), "query")
    builder.ExportOutput(plant.get_body_poses_output_port(), "body_poses")
