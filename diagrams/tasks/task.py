"""Base class of tasks: the declaration that `build_task_diagram` wires."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, OutputPort
from pydrake.systems.primitives import ConstantVectorSource

from guiderail.diagrams.envs import options as option_models
from guiderail.diagrams.envs.observation import ObservationTerm
from guiderail.diagrams.envs.scene import Camera, Scene, in_plane
from guiderail.diagrams.envs.task_diagram import Symmetry
from guiderail.diagrams.envs.trace import Metric
from guiderail.diagrams.guidance.prior import PlacedTemplate, ScriptedApproach
from guiderail.diagrams.stations.registry import stations_for
from guiderail.diagrams.stations.station import CONTROL_PERIOD, TIME_UNIT, Impedance, Station, whole_multiple
from guiderail.models.common.termination import TERMINATIONS
from guiderail.models.control.keep_out import KeepOut
from guiderail.models.control.motion_constraints import MotionConstraints
from guiderail.models.primitives import LinearConstraints, ReferenceTrajectory
from guiderail.systems.episode_monitor import TerminationTerm
from guiderail.systems.reward_system import RewardTerm

if TYPE_CHECKING:
    from guiderail.diagrams.envs.settings import EnvSettings


ScriptedPolicy = Callable[[np.ndarray], np.ndarray]
"""Function from an observation to an action."""


class EpisodeConstant:
    """Episode-constant signal, set at reset, usable by observations, rewards and terminations."""

    def __init__(self, builder: DiagramBuilder, name: str, size: int, default: np.ndarray | None = None):
        """Add the source; until a reset sets the values, they are `default`, (size,), or zero."""
        values = np.zeros(size) if default is None else np.array(default, dtype=float)
        self._source = builder.AddNamedSystem(name, ConstantVectorSource(values))

    @property
    def port(self) -> OutputPort:
        """Output port, (size,)."""
        return self._source.get_output_port()

    def set(self, root_context: Context, values: np.ndarray) -> None:
        """Set the values, (size,), in the root diagram's context."""
        context = self._source.GetMyMutableContextFromRoot(root_context)
        self._source.get_mutable_source_value(context).SetFromVector(values)


@dataclass(frozen=True)
class Threshold:
    """Signal that indicates a collision while it is above a limit.

    The episode statistics `collisions` and `collision_steps` count these collisions. They do not end an episode; a
    `TerminationTerm` does.

    Attributes:
        signal: Name of a signal of one number.
        above: Limit, in the signal's unit.
    """

    signal: str = "contact_force"
    above: float = 0.0


def terminal_reward(rewards: Mapping[str, float], name: str = "terminal_reward") -> RewardTerm:
    """Return the reward term `name` for the end of an episode; `rewards` maps terminations to rewards, by default 0."""
    return RewardTerm(name, {"termination": 1}, lambda termination: rewards.get(TERMINATIONS[int(termination[0])], 0.0))


@lru_cache(maxsize=32)
def _on_clock(reference: ReferenceTrajectory, period: float) -> ReferenceTrajectory:
    """Return `Task.on_clock` for a control period [s]; cached, so that environments share trajectories."""
    is_on_clock = np.abs(np.diff(reference.times) - period).max() <= 1e-6 * period
    return reference if is_on_clock else reference.resampled(period)


class Task(ABC):
    """Declaration of a task: workcell, prior knowledge, observation, reward, terminations and reset.

    `build_task_diagram` wires what a subclass declares. Reward terms, termination terms and observation terms name
    signals. A signal is an output port of the station, of the guidance or of `signals`, or `action` or `termination`.
    A name with the prefix "last_" is the signal's value one control step earlier.

    Attributes:
        name: Name, set by `register_task`.
        folder: Folder of a task that is read from files; None for any other task.
        workcell_kind: Kind of the workcell; only stations that are registered for it can be used.
        excluded_stations: Names of stations for this kind of workcell that the task cannot use.
        Options: Class of the task's own options, a subclass of `guiderail.Options`.
        Reset: Class of the options of a reset, a subclass of `guiderail.ResetOptions`.
        rewards: Values of the option `reward`; the first is the default.
        observations: Values of the option `observation`; the first is the default.
        defaults: Default values of environment options by name, such as the guidance; they replace the usual defaults.
        difficulties: Options by name for each value of the option `difficulty`; "standard" must be a value. These
            options override `defaults`, and given options override both.
        learner: Default algorithm and preset of `guiderail train`.
        num_steps: Control steps of an episode; set in the class or in `__init__`.
        clip: Largest absolute value in an observation.
        collision: Signal and limit of the statistic `collisions`; default: any contact force. An evaluation omits the
            statistic if the task does not declare this attribute. An episode that a `TerminationTerm` ends as a
            collision is counted only if the signal is also above its limit.
        statistics: Statistics of a table of episodes that only this task has; a study may name them.
        isotropic_groups: Groups of outputs with the same unit, as indices. In residual RL, an action of 1 displaces all
            outputs of a group by the same amount. None: one group of all outputs.
        pushable: True if `DiagramEnv.push` may displace the robot.
        time_unit: Time unit [s]; every control period is a whole multiple of it; default: that of the station.
        default_control_period: Control period without the option `control_period` [s]; default: that of the station.
        config: Configuration of the environment.
        options: The task's own options, an instance of `Options`.
        control_period: Control period [s].
        has_held_out_distribution: True if `reset` can sample from a held-out distribution, with `options.held_out`.
            Otherwise an evaluation repeats conditions of training, and its report states this.
        episode_constants: Constants by name; `signals` adds them to a diagram, and a reset sets them. A later
            environment with the same options reuses the diagram and these constants. No other attribute may therefore
            refer to systems.
    """

    name: ClassVar[str] = ""
    folder: ClassVar[Path | None] = None
    workcell_kind: ClassVar[str] = "insertion"
    excluded_stations: ClassVar[tuple[str, ...]] = ()
    Options: ClassVar[type[option_models.Options]] = option_models.Options
    Reset: ClassVar[type[option_models.ResetOptions]] = option_models.ResetOptions
    rewards: ClassVar[tuple[str, ...]] = ("sparse",)
    observations: ClassVar[tuple[str, ...]] = ("state",)
    defaults: ClassVar[Mapping[str, Any]] = {}
    difficulties: ClassVar[Mapping[str, Mapping[str, Any]]] = {option_models.STANDARD: {}}
    learner: ClassVar[Mapping[str, Any]] = {"algorithm": "tqc", "preset": "tqc_contact"}
    num_steps: int
    clip: ClassVar[float] = 3.0
    statistics: ClassVar[tuple[Metric, ...]] = ()
    collision: Threshold = Threshold()
    has_held_out_distribution: ClassVar[bool] = False
    isotropic_groups: ClassVar[tuple[tuple[int, ...], ...] | None] = None
    pushable: ClassVar[bool] = True
    time_unit: float
    default_control_period: float

    def __init__(self, config: EnvSettings):
        """Construct the task; a subclass may refuse incompatible options.

        Args:
            config: Configuration of the environment.

        Raises:
            InputError: If the control period is not a whole multiple of `time_unit`.
        """
        self.config = config
        self.options = config.parts["task"]
        given, kind, task_class = config.control_period, config.station_kind, type(self)
        self.time_unit = getattr(task_class, "time_unit", kind.time_unit or TIME_UNIT)
        period = kind.control_period or CONTROL_PERIOD
        self.default_control_period = getattr(task_class, "default_control_period", period)
        self.control_period = self.default_control_period if given is None else whole_multiple(given, self.time_unit)
        self.episode_constants: dict[str, EpisodeConstant] = {}

    def steps_of(self, nominal_steps: int) -> int:
        """Return the number of control steps, at least one, that last as long as `nominal_steps` default periods."""
        return max(round(nominal_steps * self.default_control_period / self.control_period), 1)

    def on_clock(self, reference: ReferenceTrajectory) -> ReferenceTrajectory:
        """Return a reference trajectory resampled to the control period, or itself if it has this period already.

        Raises:
            InputError: If fewer than two steps remain.
        """
        return _on_clock(reference, self.control_period)

    @abstractmethod
    def workcell(self) -> Any:
        """Return the workcell, which is the first argument of the station's builder."""

    def signals(self, builder: DiagramBuilder, station: Station) -> Mapping[str, OutputPort]:
        """Add systems and return their output ports by name, as signals of this task.

        The signal `max_wrench` (8,), if there is one, is connected to the station's input of this name.

        Args:
            builder: Builder of the root diagram.
            station: Station, already in the builder.
        """
        return {}

    def impedance(self) -> Impedance | None:
        """Return the impedance of the station, with limits that the task needs; None: the station's own."""
        return None

    # Prior knowledge. A task provides the prior knowledge whose methods it overrides (see `provides`).

    def reference(self) -> ReferenceTrajectory:
        """Return the reference trajectory of demonstrations, in steps of the control period."""
        raise NotImplementedError

    def keep_out(self) -> KeepOut:
        """Return the walls at which safe residual RL stops the robot."""
        raise NotImplementedError

    def template(self) -> PlacedTemplate:
        """Return a shared control template and the poses of its objects."""
        raise NotImplementedError

    def approach(self) -> ScriptedApproach:
        """Return a scripted approach."""
        raise NotImplementedError

    def constraints(self) -> LinearConstraints | None:
        """Return G y ≥ c on every commanded pose; None if only the guidance has constraints, such as a template's."""
        return None

    def motion_constraints(self) -> MotionConstraints | None:
        """Return nonlinear constraints of the commanded motion, such as shapes to stay outside of.

        Guidance by a primitive enforces them. Their linear part is `constraints`.
        """
        return None

    # Observation, reward and termination.

    @abstractmethod
    def observation_terms(self) -> Sequence[ObservationTerm] | Camera:
        """Return the terms of the observation `config.observation`, or the camera of an image."""

    def observation_camera(self) -> Camera | None:
        """Return the camera whose image precedes the observation terms, or None; see `ImageObservation`."""
        return None

    def privileged_terms(self) -> Sequence[ObservationTerm]:
        """Return the terms that only a privileged critic observes, such as hidden values; none by default.

        Only training in simulation uses them; the policy never does. In addition to the signals of other terms, they
        can name `exact_wrench`, the wrench without sensor errors.
        """
        return ()

    @abstractmethod
    def reward_terms(self, num_actions: int) -> Sequence[RewardTerm]:
        """Return the terms of a control step's reward `config.reward`."""

    @abstractmethod
    def termination_terms(self) -> Sequence[TerminationTerm]:
        """Return the terms that end an episode; the reason is the first term that is true."""

    def symmetry(self) -> Symmetry | None:
        """Return rotations and reflections under which the task is invariant, for actions that displace outputs.

        They are ignored if the guidance is not registered with `displaces=True`.
        """
        return None

    def near_symmetry(self) -> Symmetry | None:
        """Return symmetries that hold only for most of an episode; default: `symmetry`."""
        return self.symmetry()

    # Start of an episode.

    @abstractmethod
    def reset(
        self, station: Station, guidance: Diagram, context: Context, rng: np.random.Generator, options: Any
    ) -> dict[str, Any]:
        """Sample an episode's conditions, write them into the root context and return them by name for `info`.

        Rewards and terminations must read the conditions as signals, because an earlier environment with the same
        options may have built their diagram. Attributes of the task may contain only values for its next reset.

        Args:
            station: Station.
            guidance: Guidance.
            context: Root context.
            rng: Random generator of the environment.
            options: Instance of `Reset`. If its `held_out` is true, sample from the held-out distribution.
        """

    def start_within(self) -> np.ndarray | float:
        """Return the largest start offset of a reset, training or held-out, which certificates assume.

        It is the distance from the demonstrations' first pose for each output, (O,), or one number for all outputs.
        Starts given by reset options are not included. Default: the option `start_offset_max`, or 0.
        """
        return float(getattr(self.options, "start_offset_max", 0.0))

    @classmethod
    def folder_digest(cls) -> str:
        """Return a digest of the files of `folder`; "" if the task has no folder."""
        return ""

    @classmethod
    def scripted_policies(cls, difficulty: str = option_models.STANDARD) -> Mapping[str, ScriptedPolicy]:
        """Return scripted policies by name; the first one is the default for `difficulty`.

        A scripted policy takes the observation, (n,), centered, scaled and clipped as `observation_terms` declares it,
        and returns an action, (A,), in [−1, 1]. `guiderail evaluate` runs the default one as a baseline, unless the
        observation is an image. An override must be a class method or a static method.

        Args:
            difficulty: Value of the option `difficulty`.
        """
        return {}

    # Drawing.

    def camera(self) -> Camera | None:
        """Return the camera of `render_mode="rgb_array"`; None if the task has no picture."""
        return None

    def scene(self) -> Scene:
        """Return the contents of a picture other than the robot, and the viewpoints."""
        return Scene(to_world=in_plane)

    # Capabilities of the class.

    @classmethod
    def stations(cls) -> list[str]:
        """Return the names of the stations that the task supports."""
        return [name for name in stations_for(cls.workcell_kind) if name not in cls.excluded_stations]

    @classmethod
    def declares_collision(cls) -> bool:
        """Return True if the class declares `collision`, or has a constructor, which may declare it."""
        return cls.collision is not Task.collision or cls.__init__ is not Task.__init__

    @classmethod
    def provides(cls) -> tuple[str, ...]:
        """Return the kinds of prior knowledge that the task provides: keys of `guidance.registry.REQUIREMENTS`."""
        methods = {
            "demonstrations": "reference",
            "keep_out": "keep_out",
            "template": "template",
            "approach": "approach",
        }
        return tuple(name for name, method in methods.items() if getattr(cls, method) is not getattr(Task, method))
