"""Base class of all stations, their ports, and the parts that they share.

A *station* is a diagram with a robot, its controller and the objects of a task. All stations have these ports, with
poses of O coordinates and wrenches of W components. The table describes O = W = 6; on the plane station O = W = 2, and
poses and wrenches have only x and y:

=================  =====  ==========================================================================================
input              size   meaning
=================  =====  ==========================================================================================
`desired_pose`     O      desired pose X_TP of the tool center P, [x y z Rz Ry Rx] in meters and radians
`command_time`     1      optional: time of `desired_pose` [s]; if it stops increasing, the last safe pose is held
`max_wrench`       8      optional, only if the impedance is bounded: largest [fx fy fz tx ty tz], norm of the force
                          and norm of the torque [N, Nm]; lowers the bound of the impedance
=================  =====  ==========================================================================================

===================  =====  ========================================================================================
output               size   meaning
===================  =====  ========================================================================================
`pose`               O      measured pose X_TP, in the same coordinates
`wrench`             W      wrench of the surroundings on the tool at P in the axes of T, [fx fy fz tx ty tz],
                            N and Nm, without the tool's weight and inertia, low-pass filtered
`contact_force`      1      magnitude of the contact force [N]: the simulator's, low-pass filtered like `wrench`
                            but without errors of a sensor; on a robot that of `wrench`
`impedance_force`    1      only with an impedance: magnitude of its force [N], which `force_limit` bounds and by
                            which collisions are detected
`saturation`         1      nonzero while the controller is at a limit of force or torque; size 2 on the plane station
`command_timed_out`  1      1 while commands are missing or not finite, and the last safe pose is held
===================  =====  ========================================================================================

A simulated station also has `query` (of the scene graph), and `body_poses` and `contact_results` (of the plant), for
cameras, rewards, terminations and views; the plane and the pouring station have no `body_poses`.

The orientation of X_TP is Rz(a) Ry(b) Rx(c). T is the target frame of the workcell: the pose is zero when the task is
done. T is fixed in the world by the *nominal* fixture; offsets of the fixture do not move it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

import numpy as np
from numpy.typing import ArrayLike
from pydrake.geometry import ProximityProperties, Role, RoleAssign, SceneGraph
from pydrake.multibody.plant import AddMultibodyPlant, CoulombFriction, MultibodyPlant, MultibodyPlantConfig
from pydrake.multibody.tree import Frame, ModelInstanceIndex
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, InputPort, OutputPort
from pydrake.systems.primitives import ConstantVectorSource, LinearSystem, MatrixGain, PassThrough

from guiderail.diagrams.stations.options import CONTROL_PERIOD as CONTROL_PERIOD
from guiderail.diagrams.stations.options import TARE_AVERAGED, TARE_SKIPPED
from guiderail.diagrams.wiring import add_system
from guiderail.models.common.arrays import round_period
from guiderail.models.common.errors import InputError, brief
from guiderail.models.common.transforms import POSE_SIZE
from guiderail.models.control.wrench import FORCE_SHARES, POSE_ORDER, WrenchBound
from guiderail.systems.support.declarations import input_getter, output_getter
from guiderail.systems.support.drake_multibody import pose_to_transform
from guiderail.systems.wrench_signals import MeanForce

if TYPE_CHECKING:
    from guiderail.diagrams.stations.workcell import Workcell
    from guiderail.models.control.motion_constraints import StateConstraints

Robot = TypeVar("Robot")

INPUTS = ("desired_pose", "command_time")
OUTPUTS = ("pose", "wrench", "contact_force", "saturation", "command_timed_out")
"""Output ports of every station; `INPUTS` are the input ports."""

# Accuracy and cost of other time steps: `python -m research.benchmarks time_step`.
PLANT_PERIOD = CONTROL_PERIOD / 2  # default time step of a plant [s]
TIME_UNIT = CONTROL_PERIOD / 4  # a control period is a whole multiple of it [s]
WRENCH_TIME_CONSTANT = 0.01  # time constant of the low-pass filter of a simulated wrench [s]
COMMAND_TIMEOUT = 0.1  # age above which a time-stamped command is stale [s]; at least two control periods

_FINEST = 2**47  # largest denominator of a time step of which a day's multiples are exact, [1/s]

# Largest stiffness of workpiece, grasp and fixture in series for which an impact stays inside the bound [N/m].
CONTACT_STIFFNESS = 2.5e4
CONTACT_LEVER = 0.02  # distance of the contact from the tool center, if the workpiece is not known [m]


@dataclass(frozen=True)
class Impedance:
    """Impedance at the tool center along and about the axes of T, [x y z Rz Ry Rx].

    Raises:
        InputError: If stiffness or limits are not six positive numbers, or the damping ratio is not positive.
    """

    stiffness: tuple[float, ...] = (1500.0, 1500.0, 1500.0, 30.0, 30.0, 30.0)  # stiffness [N/m], [Nm/rad]
    damping_ratio: float = 1.0  # damping ratio of every mode
    limits: tuple[float, ...] = (40.0, 40.0, 40.0, 3.0, 3.0, 3.0)  # largest forces [N] and torques [Nm]
    # Bound of the wrench and of the approach speed, within `limits`, in the order [x y z Rx Ry Rz]; None: only `limits`
    # apply.
    bound: WrenchBound | None = None

    def __post_init__(self) -> None:
        for name in ("stiffness", "limits"):
            value = np.asarray(getattr(self, name), dtype=float)
            if value.shape != (POSE_SIZE,) or not (np.isfinite(value) & (value > 0.0)).all():
                raise InputError(f"the impedance's {name} need six positive numbers, not {getattr(self, name)}")
        if not (np.isfinite(self.damping_ratio) and self.damping_ratio > 0.0):
            raise InputError(f"the impedance's damping_ratio must be positive, not {self.damping_ratio}")

    def with_max_force(self, force: float, lever: float = CONTACT_LEVER) -> Impedance:
        """Return the same impedance, bounded so that the norm of its force is below `force` [N].

        No entry of `limits` is raised. `FORCE_SHARES` favors z, the direction of insertion. The approach speed is
        limited for contacts of at most `CONTACT_STIFFNESS`, at most at the distance `lever` [m] from the tool center.
        """
        limits = np.array(self.limits)
        limits[:3] = np.minimum(limits[:3], force * np.array(FORCE_SHARES))
        axes = to_wrench_order(limits.tolist())
        norms = (float(np.linalg.norm(axes[:3])), float(np.linalg.norm(axes[3:])))
        return replace(self, limits=tuple(limits.tolist()), bound=WrenchBound(axes, *norms, CONTACT_STIFFNESS, lever))


def max_wrench(force: float) -> np.ndarray:
    """Return the value (8,) of a station's input `max_wrench` that limits the norm of the force [N].

    Raises:
        InputError: If the force is not positive.
    """
    bound = Impedance().with_max_force(force).bound
    assert bound is not None
    return bound.numbers


def whole_multiple(control_period: float, unit: float) -> float:
    """Return a control period [s] as an exact multiple of `unit` [s].

    Raises:
        InputError: If the period is not a whole multiple of `unit`, or one of the two is not positive and finite.
    """
    number = round(control_period / unit) if 0.0 < unit <= 2.0 * control_period < np.inf else 0
    if number < 1 or abs(number * unit - control_period) > 1e-6:
        raise InputError(f"control_period must be a whole multiple of {unit:g} s, not {control_period:g} s")
    return number * unit


def exact_periods(control_period: float, time_step: float) -> tuple[float, float]:
    """Return a control period and a time step [s] whose multiples are exact in double precision; see `round_period`.

    The control period changes only if its part is not exact, by at most a picosecond for each of its time steps.

    Raises:
        InputError: If the control period is not a whole multiple of the time step.
    """
    whole_multiple(control_period, time_step)
    count = round(control_period / time_step)
    exact = Fraction(control_period) / count
    if exact.denominator <= _FINEST:
        return control_period, float(exact)
    step = round_period(control_period / count)
    return count * step, step


def command_timeout(period: float) -> float:
    """Return the age [s] above which a command is stale, for commands that are sent every `period` [s]."""
    return max(COMMAND_TIMEOUT, 2.0 * period)


def tare_steps(period: float) -> tuple[int, int]:
    """Return the numbers of steps of `period` [s] before and during a tare."""
    skipped, averaged = (max(round(n * CONTROL_PERIOD / period), 1) for n in (TARE_SKIPPED, TARE_AVERAGED))
    return skipped, averaged


class Station(Diagram):
    """Diagram with the ports of every station.

    Attributes:
        plant: The simulated plant.
        scene_graph: Its scene graph.
        control_period: Time between commands [s].
        wraps_angles: True if the pose's angles jump at ±π; the angles of a gantry are unbounded.
    """

    plant: MultibodyPlant
    scene_graph: SceneGraph
    control_period: float = CONTROL_PERIOD
    wraps_angles: bool = False

    @property
    def time_step(self) -> float:
        """Time step of the simulation [s]; the control period is a multiple of it."""
        return float(self.plant.time_step())

    @property
    def nominal_period(self) -> float:
        """Time between commands with an undisturbed clock [s]."""
        return self.control_period

    @property
    def pose_size(self) -> int:
        """Number of coordinates of a pose, O."""
        return self.get_pose_output_port().size()

    @property
    def wrench_size(self) -> int:
        """Number of coordinates of a wrench, W."""
        return self.get_wrench_output_port().size()

    get_desired_pose_input_port = input_getter("desired_pose", "desired pose, (O,)")
    get_command_time_input_port = input_getter("command_time", "time of the desired pose, (1,) [s]; optional")
    get_pose_output_port = output_getter("pose", "measured pose, (O,)")
    get_wrench_output_port = output_getter("wrench", "wrench of the surroundings on the tool, (W,)")
    get_contact_force_output_port = output_getter("contact_force", "magnitude of the contact force, (1,) [N]")
    get_impedance_force_output_port = output_getter("impedance_force", "magnitude of the impedance's force, (1,) [N]")
    get_saturation_output_port = output_getter(
        "saturation", "nonzero while the controller is at a limit, (1,); plane: (2,)"
    )
    get_command_timed_out_output_port = output_getter(
        "command_timed_out", "flag, 1 while the last safe pose is held, (1,)"
    )

    def impedance_force(self) -> dict[str, OutputPort]:
        """Return the port `impedance_force` by name; empty for a station without an impedance."""
        name = "impedance_force"
        return {name: self.GetOutputPort(name)} if self.HasOutputPort(name) else {}

    def finish(self, builder: DiagramBuilder, desired_pose: InputPort, **ports: Any) -> None:
        """Export the ports of a station and build this diagram, at the end of its constructor.

        Args:
            builder: Builder of the station.
            desired_pose: Input for the desired pose, (O,).
            ports: `pose` and, where the station has them, the other ports of `export_station_ports` by name.
        """
        export_station_ports(builder, desired_pose, **ports)
        builder.BuildInto(self)

    def set_pose(self, context: Context, pose: np.ndarray) -> None:
        """Put the robot at rest with its tool center at `pose`, (O,); `context` is the root context.

        By default, a pose is the positions of the plant.

        Raises:
            InputError: If `pose` has another shape or is not finite.
        """
        positions = check_pose(pose, self.plant.num_positions())
        plant_context = self.plant.GetMyMutableContextFromRoot(context)
        self.plant.SetPositionsAndVelocities(plant_context, np.r_[positions, 0.0 * positions])

    def joint_range(self, margin: float) -> StateConstraints:
        """Return constraints that keep the robot's joints within their limits and a margin [rad].

        Raises:
            InputError: If the station has no arm.
        """
        raise InputError("joint_margin needs the joints of an arm: choose station=arm, or leave it out")

    def set_contact(self, context: Context, friction: float, modulus: float) -> None:
        """Multiply the friction and modulus of all contacts by factors until the next reset.

        `context` is the root context. The modulus is Drake's hydroelastic modulus, or the contact stiffness of another
        engine.
        """
        scene_graph_context = self.scene_graph.GetMyMutableContextFromRoot(context)
        inspector, source = self.scene_graph.model_inspector(), self.plant.get_source_id()
        for geometry in inspector.GetAllGeometryIds(Role.kProximity):
            properties = ProximityProperties(inspector.GetProximityProperties(geometry))
            if properties.HasProperty("material", "coulomb_friction"):
                nominal = properties.GetProperty("material", "coulomb_friction")
                scaled = CoulombFriction(friction * nominal.static_friction(), friction * nominal.dynamic_friction())
                properties.UpdateProperty("material", "coulomb_friction", scaled)
            if properties.HasProperty("hydroelastic", "hydroelastic_modulus"):
                nominal = properties.GetProperty("hydroelastic", "hydroelastic_modulus")
                properties.UpdateProperty("hydroelastic", "hydroelastic_modulus", modulus * nominal)
            self.scene_graph.AssignRole(scene_graph_context, source, geometry, properties, RoleAssign.kReplace)

    def disturb(self, context: Context, rng: np.random.Generator) -> Mapping[str, Any]:
        """Sample the station's own disturbances at a reset, and return them by name; `context` is the root context."""
        return {}


@dataclass
class ControllerPlant:
    """Model of a robot for its controller: with tool and workpiece, without fixture and offsets."""

    plant: MultibodyPlant  # plant with the robot, tool and workpiece
    target: Frame  # target frame T
    tool_center: Frame  # frame of the tool center P
    posture: np.ndarray  # joint positions to which the null space returns, (n,)

    def solve(self, pose: np.ndarray, posture: np.ndarray) -> np.ndarray:
        """Return the joint positions (n,) closest to `posture`, (n,), with the tool center at `pose`, (6,).

        Raises:
            InputError: If the pose is out of reach.
        """
        X_TP = pose_to_transform(pose)
        from guiderail.models.robots.inverse_kinematics import solve_inverse_kinematics

        return solve_inverse_kinematics(self.plant, self.target, self.tool_center, X_TP, posture)

    def place(self, plant: MultibodyPlant, model: ModelInstanceIndex, context: Context, pose: np.ndarray) -> None:
        """Put the robot of a station's plant at rest with its tool center at `pose`, (6,), in the root context."""
        set_at_rest(plant, model, context, self.solve(check_pose(pose, POSE_SIZE), self.posture))


def set_at_rest(plant: MultibodyPlant, model: ModelInstanceIndex, context: Context, positions: np.ndarray) -> None:
    """Set joint positions (n,) and zero velocities of a model in the root context."""
    plant_context = plant.GetMyMutableContextFromRoot(context)
    plant.SetPositions(plant_context, model, positions)
    plant.SetVelocities(plant_context, model, np.zeros(plant.num_velocities(model)))


def check_pose(pose: ArrayLike, size: int) -> np.ndarray:
    """Return a pose as an array (size,), which must be finite: Drake would abort the process otherwise.

    Raises:
        InputError: If it has another shape or is not finite.
    """
    try:
        numbers = np.asarray(pose, dtype=float)
        if numbers.shape != (size,) or not np.isfinite(numbers).all():
            raise ValueError
    except (TypeError, ValueError):
        raise InputError(f"the robot's pose must be {size} finite numbers, not {brief(pose)}") from None
    return numbers


def add_plant(builder: DiagramBuilder, time_step: float, **config: Any) -> tuple[MultibodyPlant, SceneGraph]:
    """Add a plant with the settings that all stations share; `config` has further fields of `MultibodyPlantConfig`."""
    shared = {"discrete_contact_approximation": "lagged", "use_sampled_output_ports": False}  # see `TaskDiagram`
    return AddMultibodyPlant(MultibodyPlantConfig(time_step=time_step, **shared | config), builder)


def add_contact_force(
    builder: DiagramBuilder, plant: MultibodyPlant, robot: ModelInstanceIndex, control_period: float
) -> dict[str, OutputPort]:
    """Add the mean contact force of a control step on each joint; return `wrench` and `contact_force` by name."""
    n, step = plant.num_velocities(robot), plant.time_step()
    total = LinearSystem(np.eye(n), np.eye(n), np.eye(n), np.zeros((n, n)), step)
    add_system(builder, "force_sum", total, plant.get_generalized_contact_forces_output_port(robot))
    mean = MeanForce(n, round(control_period / step), control_period)
    add_system(builder, "mean_force", mean, force_sum=total.get_output_port())
    return {"wrench": mean.get_force_output_port(), "contact_force": mean.get_magnitude_output_port()}


class JointStation(Station):
    """Station of a robot whose pose is the positions of its joints, which follow a command by their own PD gains.

    A subclass adds the robot. `wrench` (O,) is the force [N] or torque [Nm] of contacts on each joint, averaged over
    the control step, and `contact_force` its norm. For other outputs, override `finish(builder, desired_pose, **ports)`
    and pass them to that of the base class by name; `wrench` and `contact_force` must not have direct feedthrough from
    `desired_pose`.

    Args:
        workcell: Workcell of the task, which `add_robot` gets.

    Attributes:
        plant_step: Time step of the plant [s]; the control period is a multiple of it.

    Raises:
        InputError: If `add_robot` returns no model, or a joint has no actuator with PD gains.
    """

    plant_step: ClassVar[float] = PLANT_PERIOD

    def __init__(self, workcell: Any):
        """Construct the station."""
        super().__init__()
        builder = DiagramBuilder()
        self.plant, self.scene_graph = plant, _ = add_plant(builder, self.plant_step)
        robot = self.add_robot(plant, workcell)
        if not isinstance(robot, ModelInstanceIndex):
            raise InputError(f"add_robot of {type(self).__name__} must return the robot's model, not {brief(robot)}")
        plant.Finalize()
        n = plant.num_positions(robot)
        actuators = map(plant.get_joint_actuator, plant.GetJointActuatorIndices(robot))
        if sum(actuator.has_controller() for actuator in actuators) != n:
            raise InputError(
                f"each joint of {type(self).__name__} needs an actuator with PD gains: set_controller_gains(...)"
            )
        desired = builder.AddNamedSystem("desired_state", MatrixGain(np.eye(2 * n, n)))  # at rest
        builder.Connect(desired.get_output_port(), plant.get_desired_state_input_port(robot))
        positions = builder.AddNamedSystem("positions", MatrixGain(np.eye(n, 2 * n)))
        builder.Connect(plant.get_state_output_port(robot), positions.get_input_port())
        export_scene_ports(builder, plant, self.scene_graph)
        forces = add_contact_force(builder, plant, robot, self.control_period)
        self.finish(builder, desired.get_input_port(), pose=positions.get_output_port(), **forces)

    def add_robot(self, plant: MultibodyPlant, workcell: Any) -> ModelInstanceIndex:
        """Add joints with PD gains, and what surrounds them, to the plant; return the model of the joints.

        Raises:
            InputError: Unless a subclass overrides this method.
        """
        raise InputError(f"{type(self).__name__} needs a method add_robot(plant, workcell)")


def plant_period(workcell: Workcell, longest: float = PLANT_PERIOD) -> float:
    """Return the default time step of a plant with a workcell, at most that of the station [s]."""
    return min(getattr(workcell, "time_step", None) or PLANT_PERIOD, longest)


def add_workcell_plant(
    builder: DiagramBuilder, workcell: Workcell, time_step: float, add_robot: Callable[[MultibodyPlant], Robot]
) -> tuple[MultibodyPlant, SceneGraph, Robot]:
    """Add a finalized plant with the workcell's fixture, and with the robot and workpiece that `add_robot` adds.

    Contact is hydroelastic, with point contact as the fallback; its approximation is the workcell's
    `contact_approximation`.

    Raises:
        InputError: If the time step is not positive.
    """
    if not time_step > 0.0:
        raise InputError(f"the plant's time step must be positive, not {time_step} s")
    contact = {"contact_model": "hydroelastic_with_fallback", "contact_surface_representation": "polygon"}
    approximation = getattr(workcell, "contact_approximation", "lagged")
    plant, scene_graph = add_plant(builder, time_step, **contact, discrete_contact_approximation=approximation)
    workcell.add_fixture(plant)
    robot = add_robot(plant)
    plant.Finalize()
    workcell.filter_contacts(plant, scene_graph)
    return plant, scene_graph, robot


def to_wrench_order(values: Sequence[float]) -> np.ndarray:
    """Reorder values from a pose's order, [x y z Rz Ry Rx], to a wrench's, [x y z Rx Ry Rz]."""
    return np.array(values)[POSE_ORDER]


def export_station_ports(
    builder: DiagramBuilder,
    desired_pose: InputPort,
    command_time: InputPort | None = None,
    *,
    max_wrench: InputPort | None = None,
    impedance_force: OutputPort | None = None,
    **outputs: OutputPort,
) -> None:
    """Export the `INPUTS` and `OUTPUTS` of a station, and the ports of an impedance if there is one.

    `pose` is required; without a port, another output is zero, and the time of commands has no effect.
    """
    if command_time is None:
        command_time = builder.AddNamedSystem("command_time", PassThrough(1)).get_input_port()
    for name in OUTPUTS:
        if name not in outputs:
            zero = np.zeros(outputs["pose"].size() if name == "wrench" else 1)
            outputs[name] = builder.AddNamedSystem(name, ConstantVectorSource(zero)).get_output_port()
    if max_wrench is not None:
        builder.ExportInput(max_wrench, "max_wrench")
    builder.ExportInput(desired_pose, "desired_pose")
    builder.ExportInput(command_time, "command_time")
    for name in OUTPUTS:
        builder.ExportOutput(outputs[name], name)
    if impedance_force is not None:
        builder.ExportOutput(impedance_force, "impedance_force")


def export_scene_ports(builder: DiagramBuilder, plant: MultibodyPlant, scene_graph: SceneGraph) -> None:
    """Export the ports that a view of a simulated station draws."""
    builder.ExportOutput(scene_graph.get_query_output_port(), "query")
    builder.ExportOutput(plant.get_contact_results_output_port(), "contact_results")


def export_simulation_ports(builder: DiagramBuilder, plant: MultibodyPlant, scene_graph: SceneGraph) -> None:
    """Export the ports of simulated stations."""
    export_scene_ports(builder, plant, scene_graph)
    builder.ExportOutput(plant.get_body_poses_output_port(), "body_poses")
