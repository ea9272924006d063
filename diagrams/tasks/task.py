"""Tasks: values that declare a workcell, prior knowledge, observation, rewards, terminations and reset."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from inspect import Parameter, signature
from pathlib import Path
from types import NoneType
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike
from pydantic import ConfigDict
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, OutputPort
from pydrake.systems.primitives import ConstantVectorSource

from guiderail.diagrams.envs import options as option_models
from guiderail.diagrams.envs.observation import ObservationTerm, Observed
from guiderail.diagrams.envs.scene import Scene, in_plane
from guiderail.diagrams.envs.task_diagram import Symmetry
from guiderail.diagrams.envs.trace import Metric
from guiderail.diagrams.guidance.prior import Prior
from guiderail.diagrams.stations.station import Impedance, Station
from guiderail.models.common.errors import InputError
from guiderail.models.common.termination import TERMINATIONS, Termination

ScriptedPolicy = Callable[[np.ndarray], np.ndarray]
"""Function from an observation to an action."""


@dataclass(frozen=True)
class Threshold:
    """Signal that indicates a collision while it is above a limit.

    The episode statistics `collisions` and `collision_steps` count these collisions. They do not end an episode;
    `Task.done` does.

    Attributes:
        signal: Name of a signal of one number.
        above: Limit, in the signal's unit.
    """

    signal: str = "contact_force"
    above: float = 0.0


@dataclass(frozen=True)
class Condition:
    """Condition on signals that has to hold for a time before it ends an episode.

    Attributes:
        holds: Pure function of signals, its parameters; returns True if the condition holds.
        seconds: Time for which it has to hold without interruption [s]; 0: one control step.
        progress: Function of the same signals. With it, the condition may be interrupted; the time starts again when
            the value of this function has increased by more than `min_progress`.
        min_progress: Increase that counts as progress.
    """

    holds: Callable[..., bool]
    seconds: float = 0.0
    progress: Callable[..., float] | None = None
    min_progress: float = 0.0


def signals_of(function: Callable[..., Any], user: str) -> tuple[str, ...]:
    """Return the names of a function's parameters without default values, which are signals.

    Raises:
        InputError: If it is no function with named parameters; the message names the `user`.
    """
    try:
        parameters = signature(function).parameters.values()
    except (TypeError, ValueError):
        raise InputError(f"{user} is a function of signals, such as lambda pose: -pose[0], not {function!r}") from None
    needed = [parameter for parameter in parameters if parameter.default is Parameter.empty]
    if any(parameter.kind not in (Parameter.POSITIONAL_OR_KEYWORD, Parameter.KEYWORD_ONLY) for parameter in needed):
        raise InputError(f"{user} must name its signals as parameters, such as lambda pose: -pose[0]")
    return tuple(parameter.name for parameter in needed)


def terminal_reward(rewards: Mapping[str, float]) -> Callable[..., float]:
    """Return the reward for the end of an episode; `rewards` maps terminations to rewards, by default 0."""
    return lambda termination: rewards.get(TERMINATIONS[int(termination[0])], 0.0)


def add_constant(builder: DiagramBuilder, name: str, default: ArrayLike) -> OutputPort:
    """Add a signal that a reset may set by `World.set`.

    Args:
        builder: Builder of the diagram.
        name: Name of the system, by which `World.set` finds it.
        default: Values before the first reset that sets them, (n,).

    Returns:
        The port of the signal, (n,).
    """
    return builder.AddNamedSystem(name, ConstantVectorSource(np.array(default, dtype=float))).get_output_port()


@dataclass(frozen=True)
class World:
    """Robot and objects of an environment, whose episode a reset prepares; it writes into the root context only.

    Attributes:
        station: Station.
        guidance: Guidance.
        diagram: Root diagram.
        context: Root context.
        run: Values of the environment that last longer than an episode, such as the hidden offset of a run.
    """

    station: Any
    guidance: Any
    diagram: Diagram
    context: Context
    run: dict[str, Any] = field(default_factory=dict)

    def set_pose(self, pose: ArrayLike) -> None:
        """Put the robot at rest with its tool center at `pose`, (O,)."""
        self.station.set_pose(self.context, np.asarray(pose, dtype=float))

    def has(self, name: str) -> bool:
        """Return True if the diagram has the constant signal `name`; see `add_constant`."""
        return self.diagram.HasSubsystemNamed(name)

    def set(self, name: str, values: ArrayLike) -> None:
        """Set the constant signal `name` to `values`, (n,)."""
        source = self.diagram.GetSubsystemByName(name)
        own = source.GetMyMutableContextFromRoot(self.context)
        source.get_mutable_source_value(own).SetFromVector(np.asarray(values, dtype=float))


class Task(option_models.TaskOptions):
    """Declaration of a task, a frozen value: its fields are the task's options.

    Rewards, terminations and observations name signals. A signal is an output port of the station, of the guidance or
    of `signals`, or `action`, `termination` or `action_repeat`, the number of control steps per action. A name with the
    prefix "last_" is the signal's value one control step earlier. An option is a field with a type, a range and a
    description; `reward` and `observation` are options of every task, and a task with several declares their names as
    `Literal`. A validator of pydantic refuses options that are incompatible.

    Attributes:
        name: Name, set by `register_task`.
        folder: Folder of a task that is read from files; None for any other task.
        digest: Digest of the files of `folder` when they were read; "" without a folder.
        station: Class or function of the default station, which is registered by `register_station`. Stations for the
            same kind of workcell can be chosen instead, except `unsupported_stations`.
        unsupported_stations: Names of stations for this kind of workcell that the task cannot use.
        Reset: Class of the options of a reset, a subclass of `guiderail.ResetOptions`.
        defaults: Default values of environment options by name, such as the guidance; they replace the usual defaults.
        presets: Options by name for each difficulty other than "standard". These options override `defaults`, and given
            options override both.
        learner: Default algorithm and preset of `guiderail train`.
        scripted_policies: Functions from the observation, (n,), as `observe` declares it, to an action, (A,), in
            [−1, 1]. `guiderail evaluate` runs the first one as a baseline, unless the observation is an image.
        scripted_defaults: Scripted policy that a difficulty has as the baseline instead of the first one.
        clip: Largest absolute value in an observation.
        statistics: Statistics of a table of episodes that only this task has; a study may name them.
        has_held_out_distribution: True if `reset` can sample from a held-out distribution. Otherwise an evaluation
            repeats conditions of training, and its report states this.
    """

    # Values without an annotation are attributes of the class, not options.
    model_config = ConfigDict(ignored_types=(bool, int, float, str, tuple, list, dict, NoneType, Threshold))
    name: ClassVar[str] = ""
    folder: ClassVar[Path | None] = None
    digest: ClassVar[str] = ""
    station: ClassVar[Callable[..., Station]]
    unsupported_stations: ClassVar[tuple[str, ...]] = ()
    Reset: ClassVar[type[option_models.ResetOptions]] = option_models.ResetOptions
    defaults: ClassVar[Mapping[str, Any]] = {}
    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {}
    learner: ClassVar[Mapping[str, Any]] = {"algorithm": "tqc", "preset": "tqc_contact"}
    scripted_policies: ClassVar[tuple[ScriptedPolicy, ...]] = ()
    scripted_defaults: ClassVar[Mapping[str, ScriptedPolicy]] = {}
    clip: ClassVar[float] = 3.0
    statistics: ClassVar[tuple[Metric, ...]] = ()
    has_held_out_distribution: ClassVar[bool] = False

    @property
    def duration(self) -> float | None:
        """Duration of an episode [s]; None: that of the reference."""
        return None

    @property
    def collision(self) -> Threshold | None:
        """Signal and limit of the statistic `collisions`; None: any contact force, and evaluations omit the statistic.

        An episode that ends as a collision is counted only if the signal is also above its limit.
        """
        return None

    @abstractmethod
    def workcell(self) -> Any:
        """Return the workcell, which is the first argument of the station's builder."""

    def prior(self) -> Prior:
        """Return the prior knowledge of the guidance."""
        return Prior()

    def impedance(self) -> Impedance | None:
        """Return the impedance of the station, with limits that the task needs; None: the station's own."""
        return None

    def signals(self, builder: DiagramBuilder, station: Station) -> Mapping[str, OutputPort]:
        """Add systems to the root diagram and return their output ports by name, as signals of this task.

        The signal `max_wrench` (8,), if there is one, is connected to the station's input of this name. `station` is
        already in the builder.
        """
        return {}

    def observe(self) -> Sequence[ObservationTerm] | Observed:
        """Return the terms of the observation, or terms, camera and privileged terms; by default the phase."""
        return [ObservationTerm("phase")]

    def rewards(self) -> Mapping[str, Callable[..., float]]:
        """Return the terms of a control step's reward by name, functions of signals; by default 1 for a success."""
        return {"terminal_reward": terminal_reward({Termination.SUCCESS: 1.0})}

    @abstractmethod
    def done(self) -> Mapping[str, Callable[..., bool] | Condition]:
        """Return the conditions that end an episode by their `Termination`; the first that holds is the reason."""

    def reset(self, world: World, rng: np.random.Generator, given: Any) -> Mapping[str, Any] | None:
        """Sample an episode's conditions, write them into the world and return them by name for `info`.

        By default, the robot starts at the reference's first pose. Rewards and terminations must read the conditions as
        signals.

        Args:
            world: Robot and objects.
            rng: Random generator of the environment.
            given: Instance of `Reset`. If its `held_out` is true, sample from the held-out distribution.

        Raises:
            InputError: If the task has neither a reference nor a `reset` of its own.
        """
        reference = self.prior().reference
        if reference is None:
            raise InputError(f"{self.name} has no reference at which an episode could start: write its reset()")
        world.set_pose((reference() if callable(reference) else reference).means[0])
        return None

    def symmetries(self) -> tuple[Symmetry | None, Symmetry | None]:
        """Return rotations and reflections under which the task is invariant, and those of most of an episode.

        The matrices of actions displace all outputs, (K, O, O). Only guidance whose actions displace outputs uses them.
        """
        return None, None

    def scene(self) -> Scene:
        """Return the contents of a picture other than the robot, the camera and the viewpoints."""
        return Scene(to_world=in_plane)
