"""Check of an environment's options against declared models, before a module that needs Drake is imported."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from guiderail.diagrams.envs.options import (
    KERNEL_OPTIONS,
    CommonOptions,
    Options,
    PrimitiveOptions,
    TemplateOptions,
    check_choice,
    validate_options,
)
from guiderail.diagrams.guidance.registry import GUIDANCE
from guiderail.diagrams.stations.options import Disturbances
from guiderail.diagrams.stations.registry import STATIONS, stations_for
from guiderail.diagrams.tasks.registry import TASKS
from guiderail.models.common.errors import InputError, brief
from guiderail.models.common.registry import did_you_mean


def declared_models(task: str) -> list[type[Options]]:
    """Return the models of all options that a task of this package may have, with any guidance and on any station."""
    declared: list[type[Options] | None] = [CommonOptions, TASKS.declared(task, "Options")]
    declared += [PrimitiveOptions, TemplateOptions]
    workcell_kind = TASKS.declared(task, "workcell_kind") if TASKS.declares(task, "workcell_kind") else "insertion"
    declared += [Disturbances] if workcell_kind == "insertion" else []
    stations = stations_for(workcell_kind)
    declared += [STATIONS.declared(name, "options") for name in stations if STATIONS.declares(name, "options")]
    declared += [GUIDANCE.declared(name, "options") for name in GUIDANCE.names() if GUIDANCE.declares(name, "options")]
    return list(dict.fromkeys(model for model in declared if model is not None))


def check_declared_options(task: str, options: Mapping[str, Any]) -> None:
    """Refuse an unknown option, and a value that every model with this option refuses.

    This is a quick check of single options; `EnvConfig.resolve` checks all of them. Nothing is checked if the task,
    a guidance or a station is not of this package, because it may have options of its own.

    Raises:
        InputError: If an option is unknown or its value is out of range.
    """
    registered = ((TASKS, [task]), (GUIDANCE, GUIDANCE.names()), (STATIONS, STATIONS.names()))
    if not all(registry.is_packaged(name) for registry, names in registered for name in names):
        return
    if not TASKS.declares(task, "Options"):
        return
    for option, choices in (("reward", "rewards"), ("observation", "observations")):
        if option in options and TASKS.declares(task, choices):
            check_choice(option, options[option], list(TASKS.declared(task, choices)), task)
    models = declared_models(task)
    for option in options:
        holders = [model for model in models if option in model.model_fields]
        if not holders:
            known = {name for model in models for name in model.model_fields}
            raise InputError(f"{task} has no option {brief(option)} here: {did_you_mean(option, known)}")
        checked = [option, *(KERNEL_OPTIONS if option in KERNEL_OPTIONS else ())]  # validated together
        values = {name: options[name] for name in checked if name in options}
        errors = []
        for model in holders:
            try:
                validate_options(model, values, task)
            except InputError as error:
                errors.append(error)
        if len(errors) == len(holders):
            raise errors[0]
