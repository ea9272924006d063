"""Builders of the task diagram and the skill diagram from a task, its station and its guidance, with their checks."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from typing import Any

import gymnasium
import numpy as np
from pydrake.geometry import Meshcat
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, OutputPort, PortDataType, System
from pydrake.systems.primitives import ConstantVectorSource, ZeroOrderHold

from guiderail.diagrams.envs.config import EnvConfig
from guiderail.diagrams.envs.env import INFO_KEYS, RECORDED_SIGNALS
from guiderail.diagrams.envs.observation import (
    CLOCKS,
    MOTION_TIME,
    ImageAndStateSpace,
    Observation,
    ObservationTerm,
    Observed,
    affine,
)
from guiderail.diagrams.envs.options import PrimitiveOptions, validate_options
from guiderail.diagrams.envs.scene import add_camera, add_meshcat, add_picture, contact_results_of, scene_of
from guiderail.diagrams.envs.task_diagram import Symmetry, TaskDiagram
from guiderail.diagrams.guidance.guidance import OUTPUTS, check_guidance_ports
from guiderail.diagrams.guidance.prior import PlacedTemplate, PrimitiveConfig, PriorKnowledge, limits_per_output
from guiderail.diagrams.stations.impedance_control import make_phase_wrench_limit
from guiderail.diagrams.stations.station import Station
from guiderail.diagrams.tasks.task import Condition, Threshold, World, signals_of
from guiderail.diagrams.wiring import add_system
from guiderail.models.common.errors import InputError, brief, naming_failures
from guiderail.models.common.registry import did_you_mean, is_sibling_module
from guiderail.models.control.motion_constraints import MotionConstraints
from guiderail.models.laws import StateProgress
from guiderail.models.primitives import LinearConstraints
from guiderail.models.primitives.kernels import make_kernel
from guiderail.models.primitives.reference import pass_through
from guiderail.systems.command_checks import ConstraintViolation
from guiderail.systems.episode_terms import EpisodeMonitor, RewardSystem, RewardTerm, TerminationTerm


def build_prior_knowledge(config: EnvConfig, station: Station) -> PriorKnowledge:
    """Return the prior knowledge that a task provides to guidance on a station.

    Raises:
        InputError: If the angles of the reference come near ±180°, where the station's pose jumps, or an option of the
            primitive does not fit the task or the station.
    """
    prior, reference, template = config.declared.prior(), config.reference(), template_of(config)
    primitive = None
    constraints = config.constraints() or LinearConstraints.none(station.pose_size)
    if reference is not None:
        options = dict(config.parts["primitive"])
        kernel = make_kernel(options["kernel"], options["length_scale"], options["kernel_parameters"])
        reference = pass_through(reference, options["via_points"], kernel)
        if station.wraps_angles:
            refuse_half_turns(reference.means)
        primitive = PrimitiveConfig(
            reference=reference,
            kernel=kernel,
            constraints=constraints,
            motion=_motion_constraints(prior.motion, options, constraints, station),
            progress=_state_progress(config, station.control_period),
            control_period=station.control_period,
            isotropic_groups=prior.isotropic_groups,
            keep_out=prior.keep_out,
            wrench_size=station.wrench_size,
            **{name: value for name, value in options.items() if name not in _CONVERTED_OPTIONS},
        )
    return PriorKnowledge(
        period=station.control_period,
        primitive=primitive,
        template=template,
        approach=prior.approach,
        options=dict(config.parts["guidance"]),
        pose_size=station.pose_size,
        wrench_size=station.wrench_size,
    )


def template_of(config: EnvConfig) -> PlacedTemplate | None:
    """Return the task's template with the option `active_constraints`, or None."""
    template = config.declared.prior().template
    placed = template() if callable(template) else template
    if placed is None:
        return None
    active = getattr(config.parts["template"], "active_constraints", None)
    return replace(placed, active_constraints=active)


# With progress=state: deviation of position [m] and angles [rad] from the command beyond which the motion waits, and
# largest total time for which it waits [s].
PROGRESS_TOLERANCE, MAX_LAG = (0.0025, 0.1), 3.0
_LIMITS = ("max_speed", "max_acceleration")
# Options that are not attributes of `PrimitiveConfig` but determine one of them.
_CONVERTED_OPTIONS = (
    "kernel", "length_scale", "kernel_parameters", "via_points", "progress", "joint_margin", *_LIMITS,
)  # fmt: skip


def _state_progress(config: EnvConfig, period: float) -> StateProgress | None:
    """Return the progress rule from the options, or None if the clock drives the motion."""
    options = config.parts["primitive"]
    if not isinstance(options, PrimitiveOptions) or options.progress == "clock":
        return None
    return StateProgress(PROGRESS_TOLERANCE, round(MAX_LAG / period))


def _num_steps(config: EnvConfig, period: float) -> int:
    """Return the number of control steps of an episode, including those for which the motion may wait."""
    progress = _state_progress(config, period)
    return config.num_steps + (0 if progress is None else progress.max_lag)


def _motion_constraints(
    motion: MotionConstraints | None, options: Mapping[str, Any], constraints: LinearConstraints, station: Station
) -> MotionConstraints | None:
    """Return a task's motion constraints, extended by the limits in its options; None if there are neither."""
    limits: dict[str, Any] = {}
    if options["joint_margin"] is not None:
        limits["state"] = [station.joint_range(options["joint_margin"])]
    outputs = constraints.num_outputs
    limits |= {name: limits_per_output(name, options[name], outputs) for name in _LIMITS if options[name]}
    if motion is None:
        return MotionConstraints(constraints, **limits) if limits else None
    return replace(motion, **limits)


class Signals:
    """Collection of ports by name while a diagram is built; "last_x" is the value of x one control step earlier."""

    def __init__(self, builder: DiagramBuilder, period: float, ports: Mapping[str, OutputPort]):
        """Construct the collection; zero-order holds for "last_x", with the control `period` [s], go into `builder`."""
        self._builder, self._period, self._ports = builder, period, dict(ports)

    def add(self, ports: Mapping[str, OutputPort]) -> None:
        """Add signals; they replace earlier signals of the same names."""
        self._ports |= ports

    def get(self, name: str, user: str, size: int | None = None) -> OutputPort:
        """Return the port of a signal; error messages name the `user`, the part of the task that needs the signal.

        Raises:
            InputError: If there is no signal of this name, or it has another `size`.
        """
        current = name.removeprefix("last_")
        if name not in self._ports and current != name and current in self._ports:
            port = self._ports[current]
            hold = add_system(self._builder, name, ZeroOrderHold(self._period, port.size()), port)
            self._ports[name] = hold.get_output_port()
        if name not in self._ports:
            raise InputError(
                f"{user} needs the signal {name!r}, which does not exist here: {did_you_mean(name, self._ports)}"
            )
        port = self._ports[name]
        if size not in (None, port.size()):
            numbers = "one number" if size == 1 else f"{size} numbers"
            raise InputError(f"{user} takes {numbers} as the signal {name!r}, which has {port.size()}")
        return port

    def sizes(self, functions: Iterable[Callable[..., Any]], user: str) -> dict[str, int]:
        """Return the sizes of the signals that functions name by their parameters."""
        names = dict.fromkeys(name for function in functions for name in signals_of(function, user))
        return {name: self.get(name, user).size() for name in names}

    def connect(self, system: Any, terms: Sequence[RewardTerm | TerminationTerm], user: str) -> None:
        """Connect each signal that a term names to the system's input `get_signal_input_port(name)`."""
        for name in dict.fromkeys(name for term in terms for name in term.inputs):
            self._builder.Connect(self.get(name, user), system.get_signal_input_port(name))


class Loop:
    """Control loop without the policy: station, guidance and observation, connected.

    Args:
        config: Configuration of the environment.
        station: Station.
        guidance: Diagram with the ports of `Guidance`.

    Raises:
        InputError: If a signal that the task names does not exist, a port has the wrong size, or the station or the
            guidance does not support the task's observation, its signal `max_wrench` or the template's wrench limits.

    Attributes:
        builder: Builder of the root diagram.
        station: Subsystem "station".
        guidance: Subsystem "guidance".
        signals: Signals that rewards, terminations and observations can name.
        observed: Observation that the task declares.
        space: Space of observations.
        observation: Port of the observation.
    """

    def __init__(self, config: EnvConfig, station: Station, guidance: Diagram):
        self.config, self.task = config, config.declared
        self.builder = builder = DiagramBuilder()
        check_guidance_ports(guidance, station.pose_size, station.wrench_size, config.guidance)
        self.station = builder.AddNamedSystem("station", station)
        pose, wrench = station.get_pose_output_port(), station.get_wrench_output_port()
        self.guidance = add_system(builder, "guidance", guidance, pose=pose, wrench=wrench)
        builder.Connect(guidance.GetOutputPort("desired_pose"), station.get_desired_pose_input_port())
        self.signals = Signals(builder, station.control_period, _vector_ports(station) | _vector_ports(guidance))
        self.signals.add({"action": guidance.GetOutputPort("held_action")})
        if not station.HasOutputPort("exact_wrench"):
            self.signals.add({"exact_wrench": station.get_wrench_output_port()})
        signals = self.task.signals(builder, station)
        self.signals.add(signals)
        self._connect_max_wrench(signals.get("max_wrench"))
        self.observed = Observed.of(self.task.observe())
        self.space, self.observation = self._add_observation()
        if guidance.HasInputPort("reference_window"):
            self._add_reference()

    def _connect_max_wrench(self, bound: OutputPort | None) -> None:
        """Connect the station's `max_wrench` to the task's `bound`, lowered to the limits of the template's state."""
        limit, placed = None, template_of(self.config) if self.guidance.HasOutputPort("state") else None
        if placed is not None:
            impedance = self.task.impedance() if self.station.HasInputPort("max_wrench") else None
            limit = make_phase_wrench_limit(placed.template, impedance, self.station.control_period)
        if limit is not None:
            if not self.guidance.HasOutputPort("state_max_wrench"):
                raise InputError(
                    f"states of the template of {self.task.name} limit force or torque, and guidance="
                    f"{self.config.guidance!r} has no output 'state_max_wrench': export max_wrench of its state machine"
                )
            state_max_wrench = self.guidance.GetOutputPort("state_max_wrench")
            add_system(self.builder, "phase_wrench_limit", limit, state_max_wrench=state_max_wrench)
            if bound is not None:
                self.builder.Connect(bound, limit.get_max_wrench_input_port())
            bound = limit.get_phase_max_wrench_output_port()
            self.signals.add({"max_wrench": bound})
        if bound is not None:
            if not self.station.HasInputPort("max_wrench"):
                raise InputError(
                    f"station={self.config.station!r} has no input for the signal 'max_wrench' of {self.task.name}: "
                    "leave the signal out, or choose a station with a bounded impedance"
                )
            self.builder.Connect(bound, self.station.GetInputPort("max_wrench"))

    def _add_reference(self) -> None:
        """Add the system that predicts the guidance's reference window from the observation."""
        if self.observed.camera is not None:
            raise InputError(f"the guidance of {self.task.name} takes no images: choose another observation")
        guidance: Any = self.guidance
        reference = guidance.make_reference(self.observation.size())
        add_system(self.builder, "reference", reference, observation=self.observation)
        self.builder.Connect(reference.GetOutputPort("reference_window"), guidance.GetInputPort("reference_window"))

    def _add_observation(self) -> tuple[gymnasium.spaces.Box, OutputPort]:
        """Add the observation; return its space and its port."""
        camera, terms = self.observed.camera, self.observed.terms
        if camera is None:
            return self.add_terms(terms, "observation")
        image, (width, height) = add_camera(self.builder, self.station, "observation_camera", camera), camera.size
        if not terms:
            return gymnasium.spaces.Box(0, 255, (height, width, 3), np.uint8), image
        from guiderail.systems.policy_system import ImageObservation  # most environments have no image

        space, state = self.add_terms(terms, "state_observation")
        combined = ImageObservation(width, height, state.size())
        add_system(self.builder, "observation", combined, image=image, state=state)
        return ImageAndStateSpace((height, width, 3), space), combined.get_observation_output_port()

    def add_terms(self, terms: Sequence[ObservationTerm], name: str) -> tuple[gymnasium.spaces.Box, OutputPort]:
        """Add the diagram `name` of observation terms; return the space and the port of its output.

        Raises:
            InputError: If a term names a signal that does not exist, or as `Observation`.
        """
        task, user = self.task, f"the {name} of {self.task.name}"
        names = [term.signal for term in terms if term.signal not in CLOCKS]
        ports = {signal: self.signals.get(signal, user) for signal in names}
        duration = self.config.num_steps * self.station.control_period
        sizes = {signal: port.size() for signal, port in ports.items()}
        waits = self.guidance.HasOutputPort(MOTION_TIME) and len(names) < len(terms)
        observation = Observation(terms, sizes, duration, task.clip, task.name, waits=waits)
        if waits:
            ports[MOTION_TIME] = self.guidance.GetOutputPort(MOTION_TIME)
        add_system(self.builder, name, observation, **ports)
        return observation.space, observation.get_observation_output_port()

    def add_monitor(self) -> EpisodeMonitor:
        """Add the monitor of the task's terminations."""
        task, user = self.task, f"the termination of {self.task.name}"
        conditions = task.done()
        terms = []
        for reason, given in conditions.items():
            condition = given if isinstance(given, Condition) else Condition(given)
            sizes = self.signals.sizes([condition.holds], user)
            steps = self.config.steps_of(condition.seconds)
            more = condition.progress, condition.min_progress
            terms.append(TerminationTerm(reason, sizes, condition.holds, steps, *more))
        monitor = self.builder.AddNamedSystem("monitor", EpisodeMonitor(terms, self.station.control_period, task.name))
        self.signals.connect(monitor, terms, user)
        self.signals.add({"termination": monitor.get_termination_output_port()})
        return monitor

    def add_reward(self) -> RewardSystem:
        """Add the sum of the task's reward terms."""
        task, is_named = self.task, "reward" in type(self.task).__annotations__
        user = f"the reward {task.reward!r} of {task.name}" if is_named else f"the reward of {task.name}"
        functions = task.rewards()
        repeat = ConstantVectorSource([float(self.config.action_repeat)])
        if any("action_repeat" in signals_of(function, user) for function in functions.values()):
            source = self.builder.AddNamedSystem("action_repeat", repeat)
            self.signals.add({"action_repeat": source.get_output_port()})
        terms = [RewardTerm(name, self.signals.sizes([each], user), each) for name, each in functions.items()]
        reward = self.builder.AddNamedSystem("reward", RewardSystem(terms, task.name))
        self.signals.connect(reward, terms, user)
        return reward

    def build(
        self, render_mode: str | None, before_build: Callable[[DiagramBuilder], object] | None, suffix: str = ""
    ) -> Diagram:
        """Add a picture and the systems of `before_build`; build the root diagram, named by the task and `suffix`."""
        if render_mode == "rgb_array":
            add_picture(self.builder, self.station, self.task.scene().camera, self.task.name)
        if before_build is not None:
            before_build(self.builder)
        diagram = self.builder.Build()
        diagram.set_name(self.task.name.replace("/", "_") + suffix)
        return diagram


def build_task_diagram(
    config: EnvConfig,
    station: Station,
    guidance: Diagram,
    *,
    render_mode: str | None = None,
    before_build: Callable[[DiagramBuilder], object] | None = None,
) -> TaskDiagram:
    """Build the diagram of a task: control loop, reward and episode monitor. The policy's `action` is an input port.

    Args:
        config: Configuration of the environment.
        station: Station.
        guidance: Diagram with the ports of `Guidance`.
        render_mode: "rgb_array" exports the image of the task's camera; a browser view is not part of the diagram.
        before_build: Function that adds systems to the builder, such as loggers, before the diagram is built.

    Raises:
        InputError: As `Loop`, or if the name of a reward term is reserved, or "rgb_array" is given without a camera.
    """
    loop, task = Loop(config, station, guidance), config.declared
    builder, signals, period = loop.builder, loop.signals, station.control_period
    builder.ExportInput(guidance.GetInputPort("action"), "action")

    violations = _add_violations(builder, config, station, guidance)
    monitor, reward = loop.add_monitor(), loop.add_reward()
    threshold = task.collision or Threshold()
    collision_signal = signals.get(threshold.signal, f"the collision threshold of {task.name}", 1)
    collision = add_system(builder, "collision", affine(np.eye(1), [-threshold.above]), collision_signal)
    exported = {
        **violations,
        "observation": loop.observation,
        "reward": reward.get_reward_output_port(),
        "termination": monitor.get_termination_output_port(),
        "contact_force": station.get_contact_force_output_port(),
        **station.impedance_force(),
        "desired_pose": guidance.GetOutputPort("desired_pose"),
        "pose": station.get_pose_output_port(),
        "wrench": station.get_wrench_output_port(),
        "saturation": station.get_saturation_output_port(),
        "collision": collision.get_output_port(),
        "command_timed_out": station.get_command_timed_out_output_port(),
        "fallback": guidance.GetOutputPort("fallback"),
    }
    reserved = {*exported, *INFO_KEYS, *RECORDED_SIGNALS, "privileged", "rgb_image"}
    for name in reward.term_names:
        if name in reserved:
            raise InputError(
                f"no reward term of {task.name} can be called {name!r}, which is reserved: give it another name"
            )
        exported[name] = reward.get_term_output_port(name)
    if loop.observed.privileged and station.HasOutputPort("body_poses"):
        exported["privileged"] = loop.add_terms(loop.observed.privileged, "privileged")[1]
    # Outputs that only this kind of guidance has, such as the state of a template, are exported as well.
    exported = {name: port for name, port in _vector_ports(guidance).items() if name not in OUTPUTS} | exported
    for name, port in exported.items():
        builder.ExportOutput(port, name)
    diagram = loop.build(render_mode, before_build)
    symmetry, near_symmetry = _symmetries(config, station) if config.guidance_kind.displaces else (None, None)
    return TaskDiagram(
        diagram=diagram,
        control_period=period,
        num_steps=_num_steps(config, period),
        observation_space=loop.space,
        reward_terms=reward.term_names,
        randomize=make_randomize(config, station, guidance, diagram),
        query=station.GetOutputPort("query") if station.HasOutputPort("query") else None,
        contact_results=contact_results_of(station),
        symmetry=symmetry,
        near_symmetry=near_symmetry,
        task=task,
        config=config,
    )


@dataclass(frozen=True)
class SkillDiagram:
    """Learned skill as a diagram for a `Simulator`: observation → policy → guidance → station."""

    # Diagram with the subsystems "policy", "guidance" and "station"; exports pose, desired_pose, wrench, contact_force,
    # held_action, constraint_violation and fallback, impedance_force if the station has an impedance, and rgb_image if
    # it was built with a camera.
    diagram: Diagram
    control_period: float  # control period [s]
    num_steps: int  # number of control steps of an episode
    # Function as in `TaskDiagram`, to be called with the root context before `Simulator.Initialize`.
    randomize: Callable[[Context, np.random.Generator, Mapping[str, Any]], dict[str, Any]]
    meshcat: Meshcat | None = None  # Meshcat page that the diagram publishes to; None if there is none


def build_skill_diagram(
    config: EnvConfig,
    station: Station,
    guidance: Diagram,
    policy: System | Callable[[np.ndarray], np.ndarray],
    *,
    render_mode: str | None = None,
    before_build: Callable[[DiagramBuilder], object] | None = None,
) -> SkillDiagram:
    """Build the diagram of a learned skill, without reward and episode monitor.

    Args:
        config: Configuration of the environment that the skill was learned in.
        station: Station.
        guidance: Diagram with the ports of `Guidance`.
        policy: Function from an observation to an action, which a `PolicySystem` calls every `action_repeat` control
            periods; or a system with an input `observation` and an output `action`.
        render_mode: None, "human" (browser view) or "rgb_array" (exports the image of the task's camera).
        before_build: Function that adds systems to the builder, such as loggers, before the diagram is built.

    Raises:
        InputError: As `Loop`, or if there is no scene for "human" or no camera for "rgb_array", the policy is neither a
            function nor a system with these ports, or the sizes of the ports do not match.
    """
    loop, task = Loop(config, station, guidance), config.declared
    builder, action = loop.builder, guidance.GetInputPort("action")
    from guiderail.systems.policy_system import PolicySystem, check_policy_ports

    if not isinstance(policy, System):
        port = loop.observation
        model = port.size() if port.get_data_type() == PortDataType.kVectorValued else port.Allocate()
        policy = PolicySystem(policy, model, action.size(), config.action_repeat * station.control_period)
    check_policy_ports(policy, loop.observation.size(), action.size(), task.name)
    add_system(builder, "policy", policy, observation=loop.observation)
    builder.Connect(policy.GetOutputPort("action"), action)
    for name in ("pose", "wrench", "contact_force"):
        builder.ExportOutput(station.GetOutputPort(name), name)
    for name, port in station.impedance_force().items():
        builder.ExportOutput(port, name)
    for name in OUTPUTS:
        builder.ExportOutput(guidance.GetOutputPort(name), name)
    meshcat = add_meshcat(builder, scene_of(station), contact_results_of(station)) if render_mode == "human" else None
    diagram = loop.build(render_mode, before_build, suffix="_skill")
    return SkillDiagram(
        diagram,
        station.control_period,
        _num_steps(config, station.control_period),
        make_randomize(config, station, guidance, diagram),
        meshcat,
    )


def _vector_ports(diagram: Diagram) -> dict[str, OutputPort]:
    """Return the vector output ports of a diagram by name."""
    ports = (diagram.get_output_port(index) for index in range(diagram.num_output_ports()))
    return {port.get_name(): port for port in ports if port.get_data_type() == PortDataType.kVectorValued}


def _symmetries(config: EnvConfig, station: Station) -> tuple[Symmetry | None, Symmetry | None]:
    """Return the task's symmetries of the outputs that actions move; the second holds for most of an episode."""
    outputs = config.action_outputs(station.pose_size)
    exact, near = (None if each is None else each.restrict(outputs) for each in config.declared.symmetries())
    return exact, near or exact


def _add_violations(
    builder: DiagramBuilder, config: EnvConfig, station: Station, guidance: Diagram
) -> dict[str, OutputPort]:
    """Add the checks of the task's constraints, and return the ports of the violations by name.

    Without task constraints, ports of the guidance are returned instead, if it has them.
    """
    constraints = config.constraints()
    poses = {"commanded_violation": guidance.GetOutputPort("desired_pose")}
    poses["measured_violation"] = station.get_pose_output_port()
    violations = {}
    if constraints is None:
        constraints = LinearConstraints.none(station.pose_size)
        violations["commanded_violation"] = guidance.GetOutputPort("constraint_violation")
        if guidance.HasOutputPort("measured_violation"):
            violations["measured_violation"] = guidance.GetOutputPort("measured_violation")
    for name, port in poses.items():
        if name not in violations:
            checked = config.declared.prior().motion or constraints
            violation = add_system(builder, name, ConstraintViolation(checked, station.control_period), pose=port)
            violations[name] = violation.get_violation_output_port()
    return violations


def make_randomize(config: EnvConfig, station: Station, guidance: Diagram, diagram: Diagram) -> Any:
    """Return the function `TaskDiagram.randomize` of a root diagram, with hidden values of a run of its own.

    The returned function raises an `InputError` if a reset option is invalid, or the task's `reset` returns a value
    with a reserved name.
    """
    task = config.declared
    run: dict[str, Any] = {}
    is_packaged = is_sibling_module(type(task).__module__)

    def randomize(context: Context, rng: np.random.Generator, options: Mapping[str, Any]) -> dict[str, Any]:
        given = validate_options(task.Reset, options, f"a reset of {task.name}")
        with nullcontext() if is_packaged else naming_failures(f"reset of {task.name}", RuntimeError, SystemExit):
            sampled = task.reset(World(station, guidance, diagram, context, run), rng, given)
        sampled = {} if sampled is None else sampled
        if not isinstance(sampled, Mapping):
            raise InputError(f"reset of {task.name} returns a dict of values by name or None, not {brief(sampled)}")
        if reserved := [name for name in sampled if name in INFO_KEYS]:
            raise InputError(
                f"reset of {task.name} returns a value named {reserved[0]!r}, which is reserved: give it another name"
            )
        return {**sampled, **station.disturb(context, rng)}

    return randomize


# Smallest distance of demonstrated angles from ±180° [rad], because actions and contact turn the tool further.
HALF_TURN_MARGIN = 0.1


def turns_near_half(means: np.ndarray) -> bool:
    """Return True if angles of a motion (N, 6) come near ±180°."""
    return bool(np.abs(means[:, 3:]).max(initial=0.0) > np.pi - HALF_TURN_MARGIN)


def refuse_half_turns(means: np.ndarray) -> None:
    """Raise an `InputError` if angles of a motion (N, 6) come near ±180°, where the station's angles jump."""
    if turns_near_half(means):
        furthest = np.abs(means[:, 3:]).max()
        raise InputError(
            f"the demonstrations turn to {np.rad2deg(furthest):.0f}°, and this station's angles jump by a full turn at "
            f"180°: rotate the target's frame, so that they stay {np.rad2deg(HALF_TURN_MARGIN):.0f}° away"
        )
