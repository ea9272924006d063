"""Station from a scenario file: model directives of robot and surroundings, as in Drake's `hardware_sim`."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from pydrake.math import RigidTransform
from pydrake.multibody.parsing import GetScopedFrameByNameMaybe, ModelDirective
from pydrake.multibody.plant import AddMultibodyPlant, MultibodyPlant, MultibodyPlantConfig
from pydrake.multibody.tree import FixedOffsetFrame, Frame, ModelInstanceIndex, RigidBody, WeldJoint
from pydrake.systems.framework import Context, DiagramBuilder

from guiderail.diagrams.stations.impedance_control import add_impedance_control
from guiderail.diagrams.stations.station import (
    CONTROL_PERIOD,
    PLANT_PERIOD,
    ControllerPlant,
    Impedance,
    Station,
    exact_periods,
    export_simulation_ports,
)
from guiderail.models.common.errors import InputError
from guiderail.systems.wrench_sensors import WrenchSensor
from guiderail_hardware.robot.scenario import follow_directives, read_typed


@dataclass
class ArmConfig:
    """Arm under impedance control, by the names of models and frames in the directives."""

    model: str = "arm"  # model with the joints, one actuator per joint
    tool: list[str] = field(default_factory=lambda: ["tool"])  # rigid models on its flange, the first at the wrist
    tool_center: str = "tool::tool_center"  # frame of the tool center P, in the tool
    target: str = "target"  # target frame T, fixed in the world
    stiffness: list[float] = field(default_factory=lambda: list(Impedance().stiffness))  # as in `Impedance`
    damping_ratio: float = Impedance().damping_ratio
    limits: list[float] = field(default_factory=lambda: list(Impedance().limits))
    max_force: float | None = None  # bound of the norm of the force [N]; None: only the limits
    # Factor of the rotor inertias: torque control reduces the inertia that the joints have.
    apparent_rotor_inertia: float = 1.0
    control_period: float = CONTROL_PERIOD  # time between commands [s]
    wrench_time_constant: float = 0.01  # time constant of the wrench sensor's low-pass filter [s]

    @property
    def impedance(self) -> Impedance:
        """Impedance at the tool center."""
        impedance = Impedance(tuple(self.stiffness), self.damping_ratio, tuple(self.limits))
        return impedance if self.max_force is None else impedance.with_max_force(self.max_force)


@dataclass
class StationScenario:
    """Scenario of a simulated station; `plant_config` and `directives` are fields of Drake's `hardware_sim`."""

    directives: list[ModelDirective] = field(default_factory=list)
    plant_config: MultibodyPlantConfig = field(default_factory=lambda: MultibodyPlantConfig(time_step=PLANT_PERIOD))
    arm: ArmConfig = field(default_factory=ArmConfig)


class ScenarioStation(Station):
    """Arm under a Cartesian impedance controller among the objects of model directives.

    The arm's initial joint positions, `default_joint_positions` of its directive, are also its null-space posture.

    Attributes:
        scenario: Scenario that the station was built from.
    """

    wraps_angles = True

    def __init__(self, scenario: StationScenario, folder: Path | None = None):
        """Construct the station; packages of its models are searched in `folder`.

        Raises:
            InputError: If the directives cannot be followed, a model or a frame is missing, the target can move, the
                tool is not welded to the arm, or a period or an impedance is out of range.
        """
        super().__init__()
        self.scenario, arm = scenario, scenario.arm
        if not scenario.plant_config.time_step > 0.0:
            raise InputError("a station's plant is discrete: give plant_config a time_step above 0")
        self.control_period, time_step = exact_periods(arm.control_period, scenario.plant_config.time_step)
        # The systems read the plant at control steps: see `TaskDiagram`.
        config = _copy(scenario.plant_config, time_step=time_step, use_sampled_output_ports=False)
        builder = DiagramBuilder()
        self.plant, self.scene_graph = plant, _ = AddMultibodyPlant(config, builder)
        follow_directives(plant, scenario.directives, folder)
        self._model = _model(plant, arm.model)
        _scale_rotors(plant, self._model, arm.apparent_rotor_inertia)
        plant.Finalize()
        target = _frame(plant, arm.target, "target")
        if target.body() not in plant.GetBodiesWeldedTo(plant.world_body()):
            raise InputError(f"the target frame {arm.target!r} can move: give a frame that is fixed in the world")
        X_WT = target.CalcPoseInWorld(plant.CreateDefaultContext())
        center = _frame(plant, arm.tool_center, "tool_center")
        wrist, tool = _wrist(plant, arm)
        self._controller_plant = _controller_plant(scenario, X_WT, folder)
        sensor = WrenchSensor(plant, wrist, tool, center, X_WT.rotation(), time_step, arm.wrench_time_constant)
        builder.AddNamedSystem("wrench_sensor", sensor)
        sensor.connect(builder, plant)
        torque = add_impedance_control(
            builder,
            self._controller_plant,
            arm.impedance,
            self.control_period,
            state=plant.get_state_output_port(self._model),
            wrench=sensor.get_wrench_output_port(),
        )
        builder.Connect(torque, plant.get_actuation_input_port(self._model))
        export_simulation_ports(builder, plant, self.scene_graph)
        builder.BuildInto(self)

    def set_pose(self, context: Context, pose: np.ndarray) -> None:
        """Put the arm at rest with its tool center at `pose`, (6,); `context` is the root context."""
        self._controller_plant.place(self.plant, self._model, context, pose)


def load_station(path: str | Path) -> ScenarioStation:
    """Build the station of a scenario file; packages of its models are searched in the folder of the file.

    Raises:
        InputError: If the file does not exist or is no scenario, or as `ScenarioStation`.
    """
    path = Path(path)
    scenario = read_typed(path, StationScenario(), "scenario of a station", tags=("!Rpy",))
    return ScenarioStation(scenario, path.parent)


def _copy(config: MultibodyPlantConfig, **changes: object) -> MultibodyPlantConfig:
    """Return a copy of a plant's configuration with changed fields."""
    values = {each.name: getattr(config, each.name) for each in config.__fields__}
    return MultibodyPlantConfig(**values | changes)


def _model(plant: MultibodyPlant, name: str) -> ModelInstanceIndex:
    if not plant.HasModelInstanceNamed(name):
        names = [plant.GetModelInstanceName(ModelInstanceIndex(i)) for i in range(2, plant.num_model_instances())]
        raise InputError(f"the directives have no model {name!r}, only {', '.join(names) or 'none'}")
    return plant.GetModelInstanceByName(name)


def _scale_rotors(plant: MultibodyPlant, model: ModelInstanceIndex, factor: float) -> None:
    if not 0.0 <= factor < np.inf:
        raise InputError(f"apparent_rotor_inertia is a factor of at least 0, not {factor}")
    actuators = [plant.get_joint_actuator(index) for index in plant.GetJointActuatorIndices()]
    for actuator in actuators:
        if actuator.model_instance() == model:
            actuator.set_default_rotor_inertia(factor * actuator.default_rotor_inertia())


def _frame(plant: MultibodyPlant, name: str, use: str) -> Frame:
    frame = GetScopedFrameByNameMaybe(plant, name)
    if frame is None:
        raise InputError(f"the directives have no frame {name!r}, which arm.{use} names: write MODEL::FRAME")
    return frame


def _wrist(plant: MultibodyPlant, arm: ArmConfig) -> tuple[WeldJoint, list[RigidBody]]:
    """Return the joint between the arm and the first model of the tool, and the bodies of the tool."""
    if not arm.tool:
        raise InputError("a wrench is measured between arm and tool: give arm.tool the name of a model")
    model, tools = _model(plant, arm.model), [_model(plant, name) for name in arm.tool]
    for joint in (plant.get_joint(index) for index in plant.GetJointIndices()):
        parent, child = joint.parent_body().model_instance(), joint.child_body().model_instance()
        if isinstance(joint, WeldJoint) and parent == model and child == tools[0]:
            first = joint.child_body()
            indices = [index for tool in tools for index in plant.GetBodyIndices(tool) if index != first.index()]
            return joint, [first, *(plant.get_body(index) for index in indices)]
    raise InputError(f"the model {arm.tool[0]!r} is not welded to the model {arm.model!r}: give an add_weld directive")


def _controller_plant(scenario: StationScenario, X_WT: RigidTransform, folder: Path | None) -> ControllerPlant:
    """Return the model of arm and tool alone: the directives of these models, and of frames and welds between them."""
    arm = scenario.arm
    models = {arm.model, *arm.tool}

    def is_of_arm(frame: str) -> bool:
        scope, _, name = frame.rpartition("::")
        return scope in models or (not scope and name in frames)

    frames, kept = {"world"}, []
    for directive in scenario.directives:
        added, framed, welded = directive.add_model, directive.add_frame, directive.add_weld
        if added is not None and added.name in models:
            kept.append(directive)
        elif framed is not None and is_of_arm(framed.X_PF.base_frame or framed.name.rpartition("::")[0]):
            frames.add(framed.name)
            kept.append(directive)
        elif welded is not None and welded.child.rpartition("::")[0] in models and is_of_arm(welded.parent):
            kept.append(directive)
    plant = MultibodyPlant(0.0)
    follow_directives(plant, kept, folder)
    _scale_rotors(plant, _model(plant, arm.model), arm.apparent_rotor_inertia)
    target = plant.AddFrame(FixedOffsetFrame("target_of_controller", plant.world_frame(), X_WT))
    plant.Finalize()
    posture = plant.GetPositions(plant.CreateDefaultContext())
    return ControllerPlant(plant, target, _frame(plant, arm.tool_center, "tool_center"), posture)
