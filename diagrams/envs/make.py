"""From names and options to an environment, or to a learned skill as a diagram."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Generic, TypeVar

import numpy as np
from pydantic import Field
from pydrake.systems.framework import Diagram, System
from threadpoolctl import threadpool_limits

from guiderail.diagrams.envs.assemble import SkillDiagram, build_skill_diagram, build_task_diagram, known_of, randomizes
from guiderail.diagrams.envs.config import (
    STANDARD,
    Integer,
    Options,
    PrimitiveOptions,
    TemplateOptions,
    choose,
    validated,
)
from guiderail.diagrams.envs.env import GuidedEnv, check_render_mode
from guiderail.diagrams.envs.task_diagram import TaskDiagram
from guiderail.diagrams.guidance.prior import PriorKnowledge
from guiderail.diagrams.guidance.registry import GUIDANCE, build_guidance, check_guidance, possible_guidance
from guiderail.diagrams.stations.disturbances import Disturbances, disturbed
from guiderail.diagrams.stations.registry import STATIONS, StationKind, stations_for
from guiderail.diagrams.stations.station import Station
from guiderail.diagrams.tasks.registry import TASKS, check_num_steps, is_task_folder, register_task_folder
from guiderail.diagrams.tasks.task import Choice, Task
from guiderail.models.common.errors import InputError, brief
from guiderail.models.common.registry import did_you_mean

Built = TypeVar("Built")


class DiagramPool(Generic[Built]):
    """Keeps what was built until somebody needs the same again.

    A diagram with a LeafSystem of Python in it is never freed: C++ holds the system's methods, these hold the system,
    and no garbage collector sees the circle. What cannot be freed can be used again, as a diagram is the same after use
    as before: all that changes is in a context, and everyone makes one of their own.
    """

    def __init__(self) -> None:
        self._idle: dict[Hashable, list[Built]] = defaultdict(list)

    def take(self, key: Hashable, build: Callable[[], Built]) -> Built:
        """One that is free, or a new one; nobody else has it until it is given back."""
        idle = self._idle[key]
        return idle.pop() if idle else build()

    def give_back(self, key: Hashable, built: Built) -> None:
        """It is free again."""
        self._idle[key].append(built)


class CommonOptions(Options):
    """Of every environment."""

    guidance: str = Field("", description="what stands between the policy and the robot")
    station: str = Field("", description="where it is done")
    reward: str = Field("", description="what is rewarded")
    observation: str = Field("", description="what the policy sees")
    difficulty: str = Field(STANDARD, description="which of the task's declared settings")
    action_repeat: Integer = Field(1, ge=1, description="control steps per decision")


@dataclass(frozen=True)
class Resolved:
    """What an environment is made of, every option checked and every default filled in.

    Attributes:
        task: the declaration.
        station: the kind of station.
        models: the options by whom they concern: "common", "task", "station", "primitive", "template", "guidance",
            "disturbances".
    """

    task: Task
    station: StationKind
    models: Mapping[str, Options]

    @property
    def values(self) -> dict[str, Any]:
        """All options by name, as `gymnasium.make` takes them."""
        return dict(self.task.choice.values)


def option_models(task: type[Task], guidance: str, station: str) -> dict[str, type[Options]]:
    """The models of all options that an environment has, by whom they concern."""
    kind = check_guidance(guidance, task.provides(), task.name)
    return {
        "common": CommonOptions,
        "task": task.Options,
        "station": STATIONS.get(station).options or Options,
        "primitive": PrimitiveOptions if "demonstrations" in task.provides() else Options,
        "template": TemplateOptions if "template" in task.provides() else Options,
        "guidance": kind.options or Options,
        "disturbances": Disturbances if task.workcell_kind == "workcell" else Options,
    }


def resolve(name: str, given: Mapping[str, Any]) -> Resolved:
    """The options of an environment of a task, checked, defaults filled in.

    Raises:
        InputError: for an unknown task, option or word, or a value out of range.
    """
    if name not in TASKS.names() and is_task_folder(name):
        name = register_task_folder(name)
    declared = TASKS.get(name)
    places = stations_for(declared.workcell_kind)
    if not places:
        kinds = {STATIONS.get(place).world for place in STATIONS.names()}
        raise InputError(
            f"no station works on a world of the kind {brief(declared.workcell_kind)}, which {name} has: "
            f"{did_you_mean(declared.workcell_kind, kinds)}"
        )
    if not possible_guidance(declared.provides()):
        raise InputError(f"nothing guides {name}, as it knows nothing: write its reference(), template() or approach()")
    difficulty = choose("difficulty", given.get("difficulty", STANDARD), list(declared.difficulties), name)
    first = {"guidance": possible_guidance(declared.provides())[0], "station": places[0]}
    first |= {"reward": declared.rewards[0], "observation": declared.observations[0]}
    merged = first | dict(declared.defaults) | dict(declared.difficulties[difficulty]) | dict(given)
    station = STATIONS.get(choose("station", merged["station"], places, name))
    choose("reward", merged["reward"], list(declared.rewards), name)
    choose("observation", merged["observation"], list(declared.observations), name)

    models = option_models(declared, merged["guidance"], station.name)
    known = [key for model in models.values() for key in model.model_fields]
    for whose, settings in {"defaults": declared.defaults, **declared.difficulties}.items():
        for key in set(settings) - set(known):
            if key not in (anywhere := _known_anywhere(declared)):
                raise InputError(f"{whose} of {name} sets no option {brief(key)}: {did_you_mean(key, anywhere)}")
    unknown = sorted(set(given) - set(known))
    if unknown:
        elsewhere = [place for place in places if unknown[0] in (STATIONS.get(place).options or Options).model_fields]
        remedy = f"it is one of station={elsewhere[0]!r}" if elsewhere else did_you_mean(unknown[0], known)
        raise InputError(f"{name} has no option {brief(unknown[0])} here: {remedy}")
    checked = {
        part: validated(model, {key: merged[key] for key in model.model_fields if key in merged}, name)
        for part, model in models.items()
    }
    values = {key: value for model in checked.values() for key, value in _values(model).items()}
    choice = Choice(**_values(checked["common"]), values=values)
    task = declared(checked["task"], choice)
    return Resolved(task, station, checked)


def _known_anywhere(task: type[Task]) -> set[str]:
    """The options that a task has with any guidance on any of its stations."""
    models = {
        model
        for guidance in possible_guidance(task.provides())
        for station in stations_for(task.workcell_kind)
        for model in option_models(task, guidance, station).values()
    }
    return {key for model in models for key in model.model_fields}


def make_station(resolved: Resolved) -> Station:
    """The station of an environment, its world in it."""
    kind, disturbances = resolved.station, resolved.models["disturbances"]
    check_num_steps(resolved.task.name, getattr(resolved.task, "num_steps", None))
    world = resolved.task.workcell()
    if world is None:
        raise InputError(
            f"workcell() of {resolved.task.name} returns nothing: let it return what station={kind.name!r} works on"
        )
    build = partial(kind.build, world, **_values(resolved.models["station"]))
    return (
        disturbed(build, disturbances, kind.is_simulated, kind.name)
        if isinstance(disturbances, Disturbances)
        else build()
    )


def make_guidance(resolved: Resolved, station: Station) -> Diagram:
    """The guidance of an environment, for its station."""
    return build_guidance(resolved.task.choice.guidance, _known(resolved, station), resolved.task.name)


def known(task: str, **options: Any) -> PriorKnowledge:
    """What is known about a task, with the options of an environment: for whoever wants its primitive or template.

    Raises:
        InputError: as `make_env`.
    """
    resolved = resolve(task, options)
    return _known(resolved, make_station(resolved))


def _known(resolved: Resolved, station: Station) -> PriorKnowledge:
    models = resolved.models
    return known_of(resolved.task, station, _values(models["primitive"]), _values(models["guidance"]))


def make_env(task: str, *, render_mode: str | None = None, **options: Any) -> GuidedEnv:
    """`gymnasium.make("guiderail/<Task>-v0", ...)`.

    From here on this process calculates with one thread: matrices are small here, and where another process wants the
    cores too, threads that wait for each other take eighty times as long.

    Args:
        task: its name, or the path of a task folder.
        render_mode: None, "human" (a browser view) or "rgb_array".
        options: those of `guiderail list`: of every environment, of the task, its guidance and its station.

    Raises:
        InputError: for an unknown name, a value out of range, or a pairing that makes no sense.
    """
    check_render_mode(render_mode)
    resolved = resolve(task, options)
    if not resolved.station.is_simulated:
        raise InputError(
            f"station={resolved.station.name!r} is a real robot, which no reset can put anywhere: train and evaluate "
            "in a simulation, and run what was learned by guiderail run"
        )
    threadpool_limits(1)
    exported = render_mode if render_mode == "rgb_array" else None
    key = _key(resolved, exported)
    built = _POOL.take(key, lambda: _build(resolved, exported))
    # What a run hides is the task's: it is this environment's own, whoever had the diagram before. What a reset sets in
    # the diagram is the diagram's.
    assert built.diagram.declaration is not None
    resolved.task.drawn = built.diagram.declaration.drawn
    reset = randomizes(resolved.task, built.station, built.guidance)
    diagram = replace(built.diagram, randomize=reset, declaration=resolved.task)
    release = partial(_POOL.give_back, key, built)
    try:
        return GuidedEnv(
            diagram, action_repeat=resolved.task.choice.action_repeat, render_mode=render_mode, release=release
        )
    except BaseException:  # such as a view that finds no port
        release()
        raise


@dataclass(frozen=True)
class _Built:
    diagram: TaskDiagram
    station: Station
    guidance: Diagram


_POOL: DiagramPool[_Built] = DiagramPool()


def _build(resolved: Resolved, render_mode: str | None) -> _Built:
    station = make_station(resolved)
    guidance = make_guidance(resolved, station)
    return _Built(build_task_diagram(resolved.task, station, guidance, render_mode=render_mode), station, guidance)


def _key(resolved: Resolved, render_mode: str | None) -> Hashable:
    """What makes two environments' diagrams the same: everything that they are made of."""
    kind = GUIDANCE.get(resolved.task.choice.guidance)
    key = (type(resolved.task), kind, resolved.station, render_mode, *sorted(resolved.values.items()))
    try:
        hash(key)
    except TypeError:
        return object()  # an option that cannot be compared: nobody else has it
    return key


def make_skill(
    task: str,
    policy: System | Callable[[np.ndarray], np.ndarray],
    *,
    render_mode: str | None = None,
    **options: Any,
) -> SkillDiagram:
    """A learned skill as a plain diagram that `Simulator` runs: observation → policy → guidance → station.

    Args:
        task: the name of the task that it was learned on.
        policy: a saved `Policy`, any function from an observation to an action, or a system in its place.
        render_mode: None, or "human" for a view in the browser.
        options: those of the environment that it was learned in.

    Raises:
        InputError: as `make_env`, or if a system in the policy's place sees or gives another number of values.
    """
    resolved = resolve(task, options)
    threadpool_limits(1)
    station = make_station(resolved)
    guidance = make_guidance(resolved, station)
    return build_skill_diagram(resolved.task, station, guidance, policy, render_mode=render_mode)


def _values(model: Options) -> dict[str, Any]:
    return {name: getattr(model, name) for name in type(model).model_fields}
