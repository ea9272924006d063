"""Descriptions of tasks, guidance, stations, robots and learners, for `guiderail list` and the reference pages."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

from guiderail.diagrams.envs.config import EnvConfig, prior_of, stations_of
from guiderail.diagrams.envs.options import (
    STANDARD,
    CommonOptions,
    Options,
    PrimitiveOptions,
    TaskOptions,
    TemplateOptions,
    choices_of,
    describe_options,
    option_fields,
)
from guiderail.diagrams.guidance.guidance import INPUTS as GUIDANCE_INPUTS
from guiderail.diagrams.guidance.guidance import OUTPUTS as GUIDANCE_OUTPUTS
from guiderail.diagrams.guidance.registry import GUIDANCE, possible_guidance
from guiderail.diagrams.stations.options import Disturbances
from guiderail.diagrams.stations.registry import STATIONS
from guiderail.diagrams.stations.station import INPUTS as STATION_INPUTS
from guiderail.diagrams.stations.station import OUTPUTS as STATION_OUTPUTS
from guiderail.diagrams.tasks.registry import TASKS, environment_id
from guiderail.models.common.registry import Registry, find_plugins
from guiderail.models.primitives.kernels import KERNELS
from guiderail.models.robots.robot import END_EFFECTORS, ROBOTS, find_end_effector, find_robot
from guiderail.tools.environments import task_options
from guiderail.tools.learning.learner import LEARNERS


def describe_all() -> dict[str, Any]:
    """Describe all registered tasks, guidance, stations, robots, end effectors, learners and kernels.

    Installed siblings add their registries, such as drivers and engines.

    The descriptions of guidance and stations include ports and options, those of tasks include options. The key
    `options` has the options that all tasks share. Entries of installed packages that cannot be used are left out.
    """
    registries = {"kernels": KERNELS, **{name: point.load() for name, point in find_plugins("registry")}}
    return {
        "tasks": {name: describe_task(name) for name in TASKS.usable()},
        "guidance": {name: _describe_guidance(name) for name in GUIDANCE.usable()},
        "stations": {name: _describe_station(name) for name in STATIONS.usable()},
        "robots": {
            name: {"description": find_robot(name).title, "joints": find_robot(name).num_joints}
            for name in ROBOTS.usable()
        },
        "end_effectors": {name: {"description": find_end_effector(name).title} for name in END_EFFECTORS.usable()},
        "learners": {name: {} for name in LEARNERS.usable()},
        **{
            key: {name: {"description": _first_paragraph(registry.get(name))} for name in registry.usable()}
            for key, registry in registries.items()
        },
        "options": {
            "common": describe_options(CommonOptions),
            "primitive": describe_options(PrimitiveOptions),
            "template": describe_options(TemplateOptions),
            "disturbances": describe_options(Disturbances),
        },
    }


def describe_task(name: str) -> dict[str, Any]:
    """Describe a task: its guidance, stations, rewards, observations, difficulties, defaults and options."""
    declared = TASKS.get(name)
    return {
        "description": _first_paragraph(declared),
        "environment": environment_id(name),
        "guidance": possible_guidance(prior_of(declared).provides),
        "stations": stations_of(declared),
        "rewards": list(choices_of(declared, "reward")),
        "observations": list(choices_of(declared, "observation")),
        "difficulties": {STANDARD: {}} | {level: dict(settings) for level, settings in declared.presets.items()},
        "defaults": {**declared.defaults, **declared.learner},
        "options": [row for row in describe_options(declared) if row["name"] not in TaskOptions.model_fields],
        "reset_options": describe_options(declared.Reset),
    }


BASIC = (
    "difficulty", "guidance", "station", "robot", "reward", "observation", "action_repeat", "fixture_offset",
    "demonstrations", "force_limit", "action_scale", "sensing",
)  # fmt: skip
"""Options that `guiderail list TASK` prints first, at most twelve."""

_STRUCTURED = {
    "disturbances": "disturbances of a simulated station, by its entries",
    "exploration": "exploration in training episodes, by its entries",
    "selection": "selection of the exported actor, by its entries",
    "sensing": "see the basic options; its entries:",
}
"""Descriptions of structured options and settings where they have no value of their own."""


def describe_task_groups(name: str) -> dict[str, dict[str, str]]:
    """Describe the options of a task in groups: basic, task, motion, station, disturbances, difficulties and reset.

    An entry of a structured option follows its option; its name is indented.
    """
    texts = describe_task_options(name)
    if name not in TASKS.names():
        return {"options": texts}
    parts = EnvConfig.resolve(name, {}).parts
    groups = dict.fromkeys(BASIC, "basic")
    for part in ("task", "disturbances", "station"):
        groups = dict.fromkeys(option_fields(type(parts[part])), part) | groups
    for kind in map(STATIONS.get, stations_of(TASKS.get(name))):
        groups = dict.fromkeys(option_fields(kind.options or Options), "station") | groups
    result: dict[str, dict[str, str]] = {
        group: {} for group in ("basic", "task", "motion", "station", "disturbances", "difficulties", "reset")
    }
    result["basic"] = {key: texts[key] for key in BASIC if key in texts}
    for key, text in texts.items():
        group = "difficulties" if key.startswith("difficulty=") else groups.get(key, "motion")
        result["reset" if key.startswith("reset: ") else group][key.removeprefix("reset: ")] = text
    return {group: indent_entries(rows) for group, rows in result.items() if rows}


def indent_entries(rows: Mapping[str, Any]) -> dict[str, Any]:
    """Return rows by name with each entry of a structured option after its option, as "  .entry"."""
    result: dict[str, Any] = {}
    for name in dict.fromkeys(name.partition(".")[0] for name in rows):
        entries = {f"  .{key.partition('.')[2]}": row for key, row in rows.items() if key.startswith(f"{name}.")}
        result |= {name: rows.get(name, _STRUCTURED.get(name, ""))} | entries
    return result


def describe_guidance_options(name: str) -> dict[str, str]:
    """Describe a kind of guidance as text: requirements, ports, and the options of environments with it."""
    kind, described = GUIDANCE.get(name), _describe_guidance(name)
    models: list[Any] = [PrimitiveOptions] if any("demonstrations" in names for names in kind.needs) else []
    models += [TemplateOptions] if any("template" in names for names in kind.needs) else []
    rows = {"description": kind.label, "needs": " or ".join(" and ".join(names) for names in kind.needs)}
    rows |= {key: ", ".join(described[key]) for key in ("inputs", "outputs")}
    described_options = [row for model in (*models, kind.options) for row in describe_options(model)]
    return rows | indent_entries({row["name"]: _describe_option(row, row["default"]) for row in described_options})


def describe_task_options(name: str) -> dict[str, str]:
    """Describe the options of a task's environment and of its reset as text: meaning, range and default.

    For a task that is only registered with Gymnasium, the texts are the defaults.
    """
    if name not in TASKS.names():
        return {key: f"{value!r}" for key, value in task_options(name).items()}
    config = EnvConfig.resolve(name, {})
    declared = TASKS.get(name)
    choices = {
        "guidance": possible_guidance(prior_of(declared).provides),
        "station": stations_of(declared),
        "difficulty": (STANDARD, *declared.presets),
    }
    texts = {}
    for model in (CommonOptions, *map(type, config.parts.values())):
        for row in describe_options(model):
            texts[row["name"]] = _describe_option(row, config.options[row["name"]], choices.get(row["name"], ()))
    names_by_text: dict[tuple[str, str, str], list[str]] = {}  # names of guidance or stations, by option and text
    registries: dict[str, Registry[Any]] = {"guidance": GUIDANCE, "station": STATIONS}
    for choice, registry in registries.items():
        for kind in map(registry.get, choices[choice]):
            for row in describe_options(kind.options) if kind.name != getattr(config, choice) else ():
                key = row["name"], choice, _describe_option(row, row["default"])
                names_by_text.setdefault(key, []).append(kind.name)
    for (name, choice, text), names in names_by_text.items():
        text = f"with {choice}={' or '.join(names)}: {text}"
        texts[name] = f"{texts[name]}; {text}" if name in texts else text
    for difficulty, settings in declared.presets.items():
        if settings:
            pairs = ", ".join(f"{key}={_format_value(value)}" for key, value in settings.items())
            texts[f"difficulty={difficulty}"] = f"is the same as {pairs}"
    if len(choices_of(declared, "reward")) == 1:
        texts["reward"] = "the task has a single reward without a name"
    reset = {f"reset: {row['name']}": row["description"] for row in describe_options(declared.Reset)}
    if not declared.has_held_out_distribution:
        reset["reset: held_out"] = "no effect: the task declares no held-out conditions"
    return texts | reset


def _describe_option(row: Mapping[str, Any], default: Any, choices: Collection[str] = ()) -> str:
    """Return an option's meaning, its range or choices, and its default."""
    allowed = row.get("choices") or choices
    values = [f"one of {', '.join(map(str, allowed))}"] if allowed else []
    if {"minimum", "maximum"} <= row.keys():
        values = [f"from {row['minimum']:g} to {row['maximum']:g}"]
    if default not in (None, (), "") or "default" not in row["description"]:  # otherwise the description explains it
        values.append(f"default {default!r}")
    return ": ".join([str(row["description"]), *(["; ".join(values)] if values else [])])


def _describe_guidance(name: str) -> dict[str, Any]:
    kind = GUIDANCE.get(name)
    return {
        "description": kind.label,
        "needs": [list(names) for names in kind.needs],
        "inputs": list(GUIDANCE_INPUTS),
        "outputs": list(GUIDANCE_OUTPUTS),
        "options": describe_options(kind.options),
    }


def _describe_station(name: str) -> dict[str, Any]:
    kind = STATIONS.get(name)
    return {
        "description": kind.description,
        "workcell_kind": kind.workcell_kind,
        "inputs": list(STATION_INPUTS),
        "outputs": list(STATION_OUTPUTS),
        "options": describe_options(kind.options),
    }


def _format_value(value: Any) -> str:
    """Return a value in the notation of `--env`; a float is rounded to six digits."""
    if isinstance(value, tuple | list):
        return f"[{','.join(map(_format_value, value))}]"
    return f"{value:g}" if isinstance(value, float) else str(value)


def _first_paragraph(entry: object) -> str:
    return str(entry.__doc__ or "").strip().split("\n\n")[0].replace("\n", " ").strip()
