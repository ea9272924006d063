"""Configuration of an environment: an immutable tree of options, validated once at the boundary and passed as it is."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np

from guiderail.diagrams.envs.options import (
    STANDARD,
    CommonOptions,
    Options,
    PrimitiveOptions,
    TemplateOptions,
    check_choice,
    flat_options,
    option_fields,
    validate_options,
    validate_tree,
)
from guiderail.diagrams.guidance.prior import Prior
from guiderail.diagrams.guidance.registry import (
    GUIDANCE,
    GuidanceKind,
    check_guidance,
    default_guidance,
    possible_guidance,
)
from guiderail.diagrams.stations.options import Disturbances
from guiderail.diagrams.stations.registry import STATIONS, StationKind, stations_for
from guiderail.diagrams.stations.station import CONTROL_PERIOD, TIME_UNIT, whole_multiple
from guiderail.diagrams.tasks.registry import TASKS, is_task_folder, register_task_folder
from guiderail.diagrams.tasks.task import Task
from guiderail.models.common.errors import InputError, brief
from guiderail.models.common.registry import did_you_mean
from guiderail.models.primitives import LinearConstraints, ReferenceTrajectory


@dataclass(frozen=True)
class EnvConfig:
    """Validated configuration of an environment, without missing options; `resolve` makes it.

    Attributes:
        task: Name of the task.
        guidance: Name of the guidance.
        station: Name of the station.
        difficulty: Name of the difficulty.
        action_repeat: Control steps per action.
        control_period: Time between commands [s]; None: that of the station.
        parts: All other options by the part that they configure: "task", which is the `Task` itself, "station",
            "primitive", "template", "guidance" and "disturbances".
    """

    task: str
    guidance: str
    station: str
    difficulty: str
    action_repeat: int
    control_period: float | None
    parts: Mapping[str, Options] = field(hash=False)

    @classmethod
    def resolve(cls, task: str, options: Mapping[str, Any] | None = None) -> EnvConfig:
        """Validate the options of a task's environment and fill in the defaults.

        Resolving the `options` of a configuration gives an equal configuration.

        Args:
            task: Name of the task, or path of a task folder.
            options: Options by name, as `gymnasium.make` takes them. They override the options of the difficulty, which
                override the task's defaults.

        Raises:
            InputError: If a task, an option or a choice is unknown, a value is out of range, or options are
                incompatible.
        """
        if task not in TASKS.names() and is_task_folder(task):
            task = register_task_folder(task)
        return _resolve(TASKS.get(task), dict(options or {}))

    @property
    def options(self) -> dict[str, Any]:
        """All options by name, as `gymnasium.make` takes them."""
        common = {name: getattr(self, name) for name in CommonOptions.model_fields}
        parts = (
            (part, name, field) for part in self.parts.values() for name, field in option_fields(type(part)).items()
        )
        return common | {name: getattr(part, field) for part, name, field in parts}

    @property
    def declared(self) -> Task:
        """The task."""
        task = self.parts["task"]
        assert isinstance(task, Task)
        return task

    @property
    def guidance_kind(self) -> GuidanceKind:
        """Registered kind of the guidance."""
        return GUIDANCE.get(self.guidance)

    @property
    def station_kind(self) -> StationKind:
        """Registered kind of the station."""
        return STATIONS.get(self.station)

    @property
    def period(self) -> float:
        """Time between commands with an undisturbed clock [s]."""
        kind = self.station_kind
        if self.control_period is None:
            return kind.control_period or CONTROL_PERIOD
        return whole_multiple(self.control_period, kind.time_unit or TIME_UNIT)

    def steps_of(self, seconds: float) -> int:
        """Return the number of control steps, at least one, that last `seconds`."""
        return max(round(seconds / self.period), 1)

    @property
    def num_steps(self) -> int:
        """Number of control steps of an episode, without those for which the motion may wait.

        Raises:
            InputError: If the task has neither a duration nor a reference.
        """
        duration = self.declared.duration
        if duration is None:
            reference = self.reference()
            if reference is None:
                raise InputError(f"{self.task} has neither a duration nor a reference: give it a duration [s]")
            return reference.num_steps
        if not 0.0 < duration < np.inf:
            raise InputError(f"the duration of {self.task} must be positive, not {duration} s")
        return self.steps_of(duration)

    def reference(self) -> ReferenceTrajectory | None:
        """Return the task's reference trajectory in steps of the control period, or None."""
        reference = self.declared.prior().reference
        if callable(reference):
            reference = reference()
        return None if reference is None else on_clock(reference, self.period)

    def constraints(self) -> LinearConstraints | None:
        """Return the task's constraints G y ≥ c on every commanded pose, or None."""
        constraints = self.declared.prior().constraints
        return constraints(self.num_steps) if callable(constraints) else constraints

    def action_outputs(self, pose_size: int) -> tuple[int, ...]:
        """Return the indices of the outputs that an action moves, of all outputs of a pose."""
        chosen = getattr(self.parts["primitive"], "action_dims", None)
        return tuple(range(pose_size)) if chosen is None else tuple(chosen)


@lru_cache(maxsize=32)
def on_clock(reference: ReferenceTrajectory, period: float) -> ReferenceTrajectory:
    """Return a reference resampled to a control period [s], or itself; cached, so that environments share it."""
    is_on_clock = np.abs(np.diff(reference.times) - period).max() <= 1e-6 * period
    return reference if is_on_clock else reference.resampled(period)


def stations_of(task: type[Task]) -> list[str]:
    """Return the names of the stations that a task supports."""
    return [name for name in stations_for(station_kind_of(task).workcell_kind) if name not in task.unsupported_stations]


def station_kind_of(task: type[Task]) -> StationKind:
    """Return the registered kind of a task's default station.

    Raises:
        InputError: If the station is not registered.
    """
    station = getattr(task, "station", None)
    kind = getattr(station, "kind", None)
    if not isinstance(kind, StationKind):
        raise InputError(f"station of {task.name} is a class that register_station registers, not {brief(station)}")
    return kind


def prior_of(task: type[Task]) -> Prior:
    """Return the prior knowledge that a task declares with its default options."""
    return validate_options(task, {}, task.name).prior()


def option_models(
    task: type[Task], guidance: str, station: str, provides: tuple[str, ...] | None = None
) -> dict[str, type[Options]]:
    """Return the models of an environment's options by part; the part "common" has the options of every environment.

    Raises:
        InputError: If the guidance or the station is unknown, or the task lacks what the guidance requires.
    """
    provides = prior_of(task).provides if provides is None else provides
    kind = check_guidance(guidance, provides, task.name)
    return {
        "common": CommonOptions,
        "task": task,
        "station": STATIONS.get(station).options or Options,
        "primitive": PrimitiveOptions if "demonstrations" in provides else Options,
        "template": TemplateOptions if "template" in provides else Options,
        "guidance": kind.options or Options,
        "disturbances": Disturbances if station_kind_of(task).workcell_kind == "insertion" else Options,
    }


def _resolve(task: type[Task], options: Mapping[str, Any]) -> EnvConfig:
    """Return the configuration of `EnvConfig.resolve` for the class of a task."""
    name, presets = task.name, {STANDARD: {}, **task.presets}
    difficulty = check_choice("difficulty", options.get("difficulty", STANDARD), list(presets), name)
    settings = task.defaults, presets[difficulty], options
    provides = prior_of(task).provides
    chosen = {"station": station_kind_of(task).name}
    for given in settings:
        chosen |= {key: given[key] for key in ("guidance", "station") if key in given}
    if "guidance" not in chosen:
        possible = possible_guidance(provides)
        if not possible:
            raise InputError(f"no guidance can be built for {name}: let its prior() have a reference or a template")
        chosen["guidance"] = default_guidance(possible)
    _check_station(task, chosen["station"])
    models = option_models(task, chosen["guidance"], chosen["station"], provides)
    known = {option for model in models.values() for option in option_fields(model)}
    _check_declared_options(task, provides, known)
    defaults, preset, options = (flat_options(given, task.model_fields) for given in settings)
    _check_given_options(task, options, known)
    parts: dict[str, Any] = dict(validate_tree(models, {**defaults, **preset, **options, **chosen}, name))
    common = parts.pop("common")
    config = EnvConfig(name, **{option: getattr(common, option) for option in CommonOptions.model_fields}, parts=parts)
    _ = config.period  # refuses a control period that is no multiple of the station's time unit
    return config


def _check_station(task: type[Task], name: Any) -> None:
    """Raise an InputError unless the task supports a station; only this station is imported if it does."""
    is_known = isinstance(name, str) and name in STATIONS.names() and name not in task.unsupported_stations
    if not is_known or STATIONS.get(name).workcell_kind != station_kind_of(task).workcell_kind:
        STATIONS.refuse_missing(str(name))
        check_choice("station", name, stations_of(task), task.name)


def _check_declared_options(task: type[Task], provides: tuple[str, ...], known: set[str]) -> None:
    """Refuse defaults and presets with an option that no guidance and no station of the task has."""
    for context, settings in {"defaults": task.defaults, **task.presets}.items():
        for option in {*settings} - known:
            anywhere = {
                name
                for guidance in possible_guidance(provides)
                for station in stations_of(task)
                for model in option_models(task, guidance, station, provides).values()
                for entry in option_fields(model)
                for name in (entry, entry.partition(".")[0])
            }
            if option not in anywhere:
                raise InputError(
                    f"{context} of {task.name} sets the unknown option {brief(option)}: "
                    f"{did_you_mean(option, anywhere)}"
                )


def _check_given_options(task: type[Task], options: Mapping[str, Any], known: set[str]) -> None:
    """Refuse given options that are not `known`; the error message names another station that has the option."""
    unknown = sorted(set(options) - known, key=str)
    if not unknown:
        return
    stations = stations_of(task)
    elsewhere = [name for name in stations if unknown[0] in option_fields(STATIONS.get(name).options or Options)]
    is_entry = "." in str(unknown[0])  # entries of structured options would make the list of names too long
    names = [name for name in known if is_entry or "." not in name]
    remedy = f"it is an option of station={elsewhere[0]!r}" if elsewhere else did_you_mean(unknown[0], names)
    raise InputError(f"{task.name} has no option {brief(unknown[0])} here: {remedy}")
