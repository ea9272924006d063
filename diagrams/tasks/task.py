"""A task as a declaration: what `build_task_diagram` needs to know to make a diagram of it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, OutputPort
from pydrake.systems.primitives import ConstantVectorSource

from guiderail.diagrams.envs import options as option_models
from guiderail.diagrams.envs.cameras import Camera
from guiderail.diagrams.envs.observation import ObservationTerm
from guiderail.diagrams.envs.scene import Scene, in_plane
from guiderail.diagrams.envs.task_diagram import Symmetry
from guiderail.diagrams.envs.trace import Metric
from guiderail.diagrams.guidance.prior import PlacedTemplate, ScriptedApproach
from guiderail.diagrams.stations.station import Station
from guiderail.models.control.keep_out import KeepOut
from guiderail.models.primitives import LinearConstraints, ReferenceTrajectory
from guiderail.systems.episode_monitor import TerminationTerm
from guiderail.systems.reward_system import RewardTerm

if TYPE_CHECKING:
    from guiderail.diagrams.envs.config import EnvConfig


ScriptedPolicy = Callable[[np.ndarray], np.ndarray]
"""Function from an observation to an action."""


class EpisodeConstant:
    """Numbers that are constant during an episode, for whoever observes, rewards or ends it."""

    def __init__(self, builder: DiagramBuilder, name: str, size: int):
        """Adds their source to the builder; they are zero until a reset sets them."""
        self._source = builder.AddNamedSystem(name, ConstantVectorSource(np.zeros(size)))

    @property
    def port(self) -> OutputPort:
        """Where they come out, (size,)."""
        return self._source.get_output_port()

    def set(self, root_context: Context, values: np.ndarray) -> None:
        """Sets them, (size,); the context is the root diagram's."""
        context = self._source.GetMyMutableContextFromRoot(root_context)
        self._source.get_mutable_source_value(context).SetFromVector(values)


@dataclass(frozen=True)
class Threshold:
    """A signal that means a collision while it is above a limit.

    The episode statistics count these collisions, in `collisions` and `collision_steps`. They do not end an episode: a
    `TerminationTerm` does.

    Attributes:
        signal: the name of a signal of one number.
        above: the limit, in its unit.
    """

    signal: str = "contact_force"
    above: float = 0.0


class Task(ABC):
    """What is done, in what world, for what reward, and how an episode begins and ends.

    A subclass says what there is, and `build_task_diagram` wires it. Reward terms, conditions and observations name signals. A
    signal is an output port of the station, of the guidance or of `signals`; `action` and `termination` are signals
    too. "last_" before a name means its value of the control step before.

    Attributes:
        name: set by `register_task`.
        workcell_kind: the kind of world, "workcell" unless given: only stations that are registered for it can be used.
        Options: the model of the task's own options, a subclass of `guiderail.Options`.
        Reset: the model of the options of a reset, a subclass of `guiderail.ResetOptions`.
        rewards: names that `reward=` chooses from; the first one unless given. `config.reward` is the chosen one.
        observations: names that `observation=` chooses from; the first one unless given.
        defaults: options of the environment, by name, that differ from what they are elsewhere, such as the guidance.
        difficulties: names that `difficulty=` chooses from, each with the options that it stands for. "standard" must
            be one of them. What is given replaces what a difficulty says, and that replaces `defaults`.
        learner: the algorithm and the preset that `guiderail train` uses unless told otherwise.
        num_steps: control steps after which an episode is over; must be given, in the class or in `__init__`.
        clip: the largest absolute value in an observation; larger ones are clipped.
        collision: the signal that the statistic `collisions` counts, and its limit; any contact force unless given, and
            then an evaluation leaves the count out. A `TerminationTerm` that ends an episode as a collision is not counted by
            itself.
        statistics: Statistics of a table of episodes that only this task has; studies name them.
        isotropic_groups: indices of outputs of one unit, group by group; residual learning moves all outputs of a group
            alike. None is one group of all.
        pushable: whether `GuidedEnv.push` may displace the robot.
        options: the task's own options, checked: an instance of `Options`.
        config: Configuration of the environment.
        has_held_out_distribution: whether `reset` draws from conditions that training never draws where `options.held_out` is
            true. Without it an evaluation repeats conditions of training, and says so.
        drawn: what `signals` adds to a diagram and a reset sets, by name. A diagram is used again by whoever asks for
            the same, whose task gets these with it: systems that a task keeps anywhere else are missing there.
    """

    name: ClassVar[str] = ""
    workcell_kind: ClassVar[str] = "workcell"
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

    def __init__(self, config: EnvConfig):
        """Construct the task; a subclass may refuse options that do not go together.

        Args:
            config: Configuration of the environment.
        """
        self.config = config
        self.options = config.parts["task"]
        self.drawn: dict[str, EpisodeConstant] = {}

    # What there is.

    @abstractmethod
    def workcell(self) -> Any:
        """What a station of `workcell_kind` works on: the first argument that the station is built with."""

    def signals(self, builder: DiagramBuilder, station: Station) -> Mapping[str, OutputPort]:
        """Further signals: a mapping from names to output ports of systems that this adds to the builder.

        They are found under these names by reward terms, conditions, observations and `collision`.

        Args:
            builder: of the root diagram.
            station: already in it; its output ports are what a system here can be connected to.
        """
        return {}

    # What is known of it. Guidance can be made of what a task overrides here (see `provides`).

    def reference(self) -> ReferenceTrajectory:
        """What demonstrations have in common; its clock is the control period."""
        raise NotImplementedError

    def keep_out(self) -> KeepOut:
        """Walls that safe residual learning stops before."""
        raise NotImplementedError

    def template(self) -> PlacedTemplate:
        """A shared control template."""
        raise NotImplementedError

    def approach(self) -> ScriptedApproach:
        """A scripted approach."""
        raise NotImplementedError

    def constraints(self) -> LinearConstraints | None:
        """G y ≥ c on every commanded pose; None where only guidance knows (a template's active constraints)."""
        return None

    # What a policy sees, and what it is told.

    @abstractmethod
    def observation_terms(self) -> Sequence[ObservationTerm] | Camera:
        """What a policy sees, for `config.observation`."""

    @abstractmethod
    def reward_terms(self, num_actions: int) -> Sequence[RewardTerm]:
        """The terms of a control step's reward, for `config.reward`."""

    @abstractmethod
    def termination_terms(self) -> Sequence[TerminationTerm]:
        """What ends an episode; the first that holds counts."""

    def symmetry(self) -> Symmetry | None:
        """Turns and mirrors under which the task stays what it is; an action displaces the explored outputs.

        Guidance that is not registered with `displaces=True` takes actions for something else, and has none.
        """
        return None

    def near_symmetry(self) -> Symmetry | None:
        """More of them, from which only most of an episode stays what it is; the exact ones unless there are more."""
        return self.symmetry()

    # How an episode begins.

    @abstractmethod
    def reset(
        self, station: Station, guidance: Diagram, context: Context, rng: np.random.Generator, options: Any
    ) -> dict[str, Any]:
        """Draws an episode's conditions and writes them into the root context; returns what `info` says of them.

        `options` is an instance of `Reset`. Where its `held_out` is True, draw from conditions that training never
        draws: evaluation resets so.

        They go nowhere else: rewards and conditions read signals, and may belong to a diagram that was built for an
        earlier environment with the same options. What is remembered in the task is for its next reset.
        """

    def start_within(self) -> np.ndarray | float:
        """How far beside the demonstrations' first pose a reset may put the robot at most: certificates assume it.

        Of each output, (O,), in its unit, or one number for all of them. It covers all that a reset draws, held out or
        not, and no place that somebody names in a reset's options. The option `start_offset_max` unless overridden, 0 for a
        task that has none.
        """
        return float(getattr(self.options, "start_offset_max", 0.0))

    @classmethod
    def scripted_policies(cls, difficulty: str = option_models.STANDARD) -> Mapping[str, ScriptedPolicy]:
        """Return scripted policies by name; the first one is the default for `difficulty`."""
        return {}

    # How it is drawn.

    def camera(self) -> Camera | None:
        """What `render_mode="rgb_array"` sees; None where a task has no picture."""
        return None

    def scene(self) -> Scene:
        """What is drawn beside the robot, and where to look from."""
        return Scene(to_world=in_plane)

    @classmethod
    def declares_collision(cls) -> bool:
        """Whether somebody said what a collision is, for the class or in its constructor."""
        return cls.collision is not Task.collision or cls.__init__ is not Task.__init__

    @classmethod
    def provides(cls) -> tuple[str, ...]:
        """Which of "demonstrations" (`reference`), "keep_out", "template" and "approach" the task overrides."""
        hooks = {
            "demonstrations": "reference",
            "keep_out": "keep_out",
            "template": "template",
            "approach": "approach",
        }
        return tuple(name for name, hook in hooks.items() if getattr(cls, hook) is not getattr(Task, hook))
