"""Configuration of an environment: resolved and validated once, then passed on as one immutable object."""

from __future__ import annotations

import os
from collections.abc import Hashable, Mapping
from typing import Any

from guiderail.diagrams.envs.options import (
    STANDARD,
    CommonOptions,
    Options,
    PrimitiveOptions,
    TemplateOptions,
    check_choice,
    flat_options,
    option_fields,
    validate_tree,
)
from guiderail.diagrams.envs.settings import EnvSettings
from guiderail.diagrams.guidance.registry import (
    GUIDANCE,
    check_guidance,
    default_guidance,
    possible_guidance,
)
from guiderail.diagrams.stations.options import Disturbances
from guiderail.diagrams.stations.registry import STATIONS
from guiderail.diagrams.tasks.registry import TASKS, is_task_folder, register_task_folder
from guiderail.diagrams.tasks.task import Task
from guiderail.models.common.errors import InputError, brief
from guiderail.models.common.registry import did_you_mean


class EnvConfig(EnvSettings):
    """Validated configuration of an environment, without missing options."""

    @classmethod
    def resolve(cls, task: str, options: Mapping[str, Any] | None = None) -> EnvConfig:
        """Validate the options of a task's environment and fill in the defaults.

        Results are cached. Resolving the `options` of a configuration gives an equal configuration.

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
        task_class, options = TASKS.get(task), dict(options or {})
        key = _cache_key(task_class, options)
        config, *kinds = _RESOLVED.get(key, (None,))
        if config is None or kinds != [config.guidance_kind, config.station_kind]:
            config = _resolve(task_class, options)
            if len(_RESOLVED) >= _MAX_RESOLVED:
                _RESOLVED.clear()
            entry = (config, config.guidance_kind, config.station_kind)
            _RESOLVED[key] = _RESOLVED[_cache_key(task_class, config.options)] = entry
        return config

    def make_task(self) -> Task:
        """Return a new instance of the task; its hidden offsets are not yet sampled."""
        return TASKS.get(self.task)(self)


def option_models(task: type[Task], guidance: str, station: str) -> dict[str, type[Options]]:
    """Return the models of an environment's options by part; the part "common" has the options of every environment.

    Raises:
        InputError: If the guidance or the station is unknown, or the task lacks what the guidance requires.
    """
    kind = check_guidance(guidance, task.provides(), task.name)
    return {
        "common": CommonOptions,
        "task": task.Options,
        "station": STATIONS.get(station).options or Options,
        "primitive": PrimitiveOptions if "demonstrations" in task.provides() else Options,
        "template": TemplateOptions if "template" in task.provides() else Options,
        "guidance": kind.options or Options,
        "disturbances": Disturbances if task.workcell_kind == "insertion" else Options,
    }


_RESOLVED: dict[Hashable, Any] = {}
_MAX_RESOLVED = 512  # entries before the cache is emptied


def _cache_key(task: type[Task], options: Mapping[str, Any]) -> Hashable:
    """Return a key of a task and its options, equal for equal options; unique if an option is not comparable.

    It contains the registered names and the working directory, because defaults and relative paths depend on them.
    """
    try:
        values = tuple(sorted((name, freeze(value)) for name, value in options.items()))
        key = (task, values, tuple(GUIDANCE.names()), tuple(STATIONS.names()), os.getcwd())
        hash(key)
    except (TypeError, OSError):
        return object()
    return key


def freeze(value: Any) -> tuple[str, Any]:
    """Return a hashable pair of a value's type and content, because True, 1 and 1.0 are equal.

    Raises:
        TypeError: If the value is not None, a bool, int, float or str, or a list, tuple or dict of such values.
    """
    if isinstance(value, dict):
        return "dict", tuple(sorted((name, freeze(entry)) for name, entry in value.items()))
    if isinstance(value, list | tuple):
        return "list", tuple(freeze(entry) for entry in value)
    if value is not None and type(value) not in (bool, int, float, str):
        raise TypeError
    return type(value).__name__, repr(value)


def _resolve(task: type[Task], options: Mapping[str, Any]) -> EnvConfig:
    name = task.name
    difficulty = check_choice("difficulty", options.get("difficulty", STANDARD), list(task.difficulties), name)
    settings = task.defaults, task.difficulties[difficulty], options
    chosen: dict[str, Any] = {"reward": task.rewards[0], "observation": task.observations[0]}
    for given in settings:
        chosen |= {key: given[key] for key in ("guidance", "station", *chosen) if key in given}
    if "guidance" not in chosen:
        chosen["guidance"] = _default_guidance(task)
    if "station" not in chosen:
        chosen["station"] = _default_station(task)
    _check_station(task, chosen["station"])
    check_choice("reward", chosen["reward"], list(task.rewards), name)
    check_choice("observation", chosen["observation"], list(task.observations), name)

    models = option_models(task, chosen["guidance"], chosen["station"])
    known = {option for model in models.values() for option in option_fields(model)}
    _check_declared_options(task, known)
    defaults, preset, options = (flat_options(models.values(), given) for given in settings)
    _check_given_options(task, options, known)
    parts: dict[str, Any] = dict(validate_tree(models, {**defaults, **preset, **options, **chosen}, name))
    common = parts.pop("common")
    config = EnvConfig(name, **{option: getattr(common, option) for option in CommonOptions.model_fields}, parts=parts)
    config.make_task()  # its constructor refuses incompatible options
    return config


def _default_guidance(task: type[Task]) -> str:
    guidance = possible_guidance(task.provides())
    if not guidance:
        raise InputError(f"no guidance can be built for {task.name}: write its reference(), template() or approach()")
    return default_guidance(guidance)


def _default_station(task: type[Task]) -> str:
    """Return a station of guiderail if there is one, so that another package's registration changes no environment."""
    stations = task.stations()
    if not stations:
        kinds = {kind.workcell_kind for kind in STATIONS.entries().values()}
        raise InputError(
            f"no station works on a workcell of the kind {brief(task.workcell_kind)}, which {task.name} has: "
            f"{did_you_mean(task.workcell_kind, kinds)}"
        )
    return min(stations, key=lambda station: not STATIONS.is_packaged(station))


def _check_station(task: type[Task], name: Any) -> None:
    """Raise an InputError unless the task supports a station; only this station is imported if it does."""
    is_known = isinstance(name, str) and name in STATIONS.names() and name not in task.excluded_stations
    if not is_known or STATIONS.get(name).workcell_kind != task.workcell_kind:
        check_choice("station", name, task.stations(), task.name)


def _check_declared_options(task: type[Task], known: set[str]) -> None:
    """Refuse defaults and difficulties with an option that no guidance and no station of the task has."""
    for context, settings in {"defaults": task.defaults, **task.difficulties}.items():
        for option in {*settings} - known:
            anywhere = {
                name
                for guidance in possible_guidance(task.provides())
                for station in task.stations()
                for model in option_models(task, guidance, station).values()
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
    elsewhere = [name for name in task.stations() if unknown[0] in option_fields(STATIONS.get(name).options or Options)]
    is_entry = "." in str(unknown[0])  # entries of structured options would make the list of names too long
    names = [name for name in known if is_entry or "." not in name]
    remedy = f"it is an option of station={elsewhere[0]!r}" if elsewhere else did_you_mean(unknown[0], names)
    raise InputError(f"{task.name} has no option {brief(unknown[0])} here: {remedy}")
