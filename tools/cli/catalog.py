"""`guiderail list`: what there is to choose from, this package's own and whatever installed packages add."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

from guiderail.diagrams.envs.config import EnvConfig
from guiderail.diagrams.envs.options import CommonOptions, PrimitiveOptions, TemplateOptions, describe_options
from guiderail.diagrams.guidance.guidance import INPUTS as GUIDANCE_INPUTS
from guiderail.diagrams.guidance.guidance import OUTPUTS as GUIDANCE_OUTPUTS
from guiderail.diagrams.guidance.registry import GUIDANCE, possible_guidance
from guiderail.diagrams.stations.disturbances import Disturbances
from guiderail.diagrams.stations.registry import STATIONS, stations_for
from guiderail.diagrams.stations.station import INPUTS as STATION_INPUTS
from guiderail.diagrams.stations.station import OUTPUTS as STATION_OUTPUTS
from guiderail.diagrams.tasks.registry import TASKS, environment_id
from guiderail.diagrams.tasks.task import Task
from guiderail.models.robots.robot import end_effector_names, find_end_effector, find_robot, robot_names
from guiderail.tools.environments import task_options
from guiderail.tools.learning.learner import LEARNERS


def everything() -> dict[str, Any]:
    """Tasks, guidance, stations, robots and learners by name: what each is, its ports and its options."""
    return {
        "tasks": {name: task(name) for name in TASKS.names()},
        "guidance": {name: _guidance(name) for name in GUIDANCE.names()},
        "stations": {name: _station(name) for name in STATIONS.names()},
        "robots": {
            name: {"is": find_robot(name).title, "joints": find_robot(name).num_joints} for name in robot_names()
        },
        "end_effectors": {name: {"is": find_end_effector(name).title} for name in end_effector_names()},
        "learners": {name: {} for name in LEARNERS.names()},
        "options": {
            "of every environment": describe_options(CommonOptions),
            "of guidance made of demonstrations": describe_options(PrimitiveOptions),
            "of guidance made of a template": describe_options(TemplateOptions),
            "of everything that an insertion may be disturbed by": describe_options(Disturbances),
        },
    }


def task(name: str) -> dict[str, Any]:
    """One task.

    Raises:
        InputError: if there is none of that name.
    """
    declared = TASKS.get(name)
    return {
        "is": _first_line(declared),
        "environment": environment_id(name),
        "guidance": possible_guidance(declared.provides()),
        "stations": stations_for(declared.workcell_kind),
        "rewards": list(declared.rewards),
        "observations": list(declared.observations),
        "difficulties": {level: dict(settings) for level, settings in declared.difficulties.items()},
        "defaults": {**declared.defaults, **declared.learner},
        "options": describe_options(declared.Options),
        "reset_options": describe_options(declared.Reset),
    }


def options_in_words(name: str) -> dict[str, str]:
    """The options of a task's environment, each with its default, its range and what it is.

    Raises:
        InputError: if there is no task of that name.
    """
    if name not in TASKS.names():
        return {key: f"{value!r}" for key, value in task_options(name).items()}
    config = EnvConfig.resolve(name, {})
    declared = TASKS.get(name)
    choices = {
        "guidance": possible_guidance(declared.provides()),
        "station": stations_for(declared.workcell_kind),
        "reward": declared.rewards,
        "observation": declared.observations,
        "difficulty": tuple(declared.difficulties),
    }
    words = {}
    for model in (CommonOptions, *map(type, config.parts.values())):
        for row in describe_options(model):
            words[row["name"]] = _option(row, config.options[row["name"]], choices.get(row["name"], ()))
    for kind in map(GUIDANCE.get, choices["guidance"]):
        if kind.name != config.guidance:
            own = {
                row["name"]: f"of guidance={kind.name}: {_option(row, row['default'])}"
                for row in describe_options(kind.options)
            }
            words |= {key: f"{words[key]}; {said}" if key in words else said for key, said in own.items()}
    for difficulty, settings in declared.difficulties.items():
        if settings:
            stands_for = ", ".join(f"{key}={_said(value)}" for key, value in settings.items())
            words[f"difficulty={difficulty}"] = f"stands for {stands_for}"
    if declared.rewards is Task.rewards:
        words["reward"] = "what is rewarded: the task's own, which has no name"
    reset = {f"reset: {row['name']}": row["description"] for row in describe_options(declared.Reset)}
    if not declared.has_held_out_distribution:
        reset["reset: held_out"] = "nothing here: the task declares no conditions that training never draws"
    return words | reset


def _option(row: Mapping[str, Any], default: Any, choices: Collection[str] = ()) -> str:
    """What an option is, what it can be, and what it is unless given."""
    allowed = row.get("choices") or choices
    among = f"one of {', '.join(map(str, allowed))}; " if allowed else ""
    if {"minimum", "maximum"} <= row.keys():
        among = f"from {row['minimum']:g} to {row['maximum']:g}; "
    return f"{row['description']}: {among}{default!r} unless given"


def _guidance(name: str) -> dict[str, Any]:
    kind = GUIDANCE.get(name)
    return {
        "is": kind.label,
        "needs": [list(needed) for needed in kind.needs],
        "inputs": list(GUIDANCE_INPUTS),
        "outputs": list(GUIDANCE_OUTPUTS),
        "options": describe_options(kind.options),
    }


def _station(name: str) -> dict[str, Any]:
    kind = STATIONS.get(name)
    return {
        "is": kind.words,
        "world": kind.world,
        "inputs": list(STATION_INPUTS),
        "outputs": list(STATION_OUTPUTS),
        "options": describe_options(kind.options),
    }


def _said(value: Any) -> str:
    """A setting as `--env` takes it, without the rounding of the last bit."""
    if isinstance(value, tuple | list):
        return f"[{','.join(map(_said, value))}]"
    return f"{value:g}" if isinstance(value, float) else str(value)


def _first_line(thing: object) -> str:
    return str(thing.__doc__ or "").strip().split("\n\n")[0].replace("\n", " ").strip()
