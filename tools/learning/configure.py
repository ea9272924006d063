"""Configuration of a run: resolved from arguments, or that of the run to resume."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from guiderail.diagrams.tasks.registry import TASKS
from guiderail.models.common.errors import InputError
from guiderail.tools.environments import check_environment, flat_environment, task_content
from guiderail.tools.evaluation.episode import check_seed
from guiderail.tools.learning.config import (
    check_episodes,
    config_values,
    default_preset,
    flat_settings,
    make_config,
    resolve_preset,
)
from guiderail.tools.learning.run_folder import RunConfig, RunFolder, SetMember, as_arguments, installed_versions

DEFAULT_EPISODES, DEFAULT_SEED = 60, 0

_LOGGER = logging.getLogger(__name__)


def configure(
    task: str,
    environment: Mapping[str, Any],
    *,
    algorithm: str | None = None,
    preset: str | None = None,
    settings: Mapping[str, Any] | None = None,
    episodes: int = DEFAULT_EPISODES,
    seed: int = DEFAULT_SEED,
    imports: Sequence[str] = (),
    step_log: bool = True,
    human_in_the_loop: bool = False,
    members: Sequence[SetMember] = (),
) -> RunConfig:
    """Return a checked configuration with everything resolved.

    The arguments are those of `start_or_resume`, with `imports` as `import_modules` returns them, and
    `human_in_the_loop`: True if a supervisor corrects the policy. With `members`, task and environment are those of the
    first member. By default, the algorithm is the preset's, and the
    preset is `default_preset`; `with_defaults` adds the learner that the task declares.

    Raises:
        InputError: If a name is unknown or a value is out of range.
    """
    episodes, seed = check_episodes(episodes), check_seed(seed)
    learner = resolve_preset(preset, algorithm, settings)
    resolved = check_environment(task, environment)
    return RunConfig(
        task, as_arguments(resolved), learner, preset or default_preset(learner.algorithm), episodes, seed,
        installed_versions(), tuple(imports), step_log, task_content(task, resolved, imports), human_in_the_loop,
        members=tuple(members),
    )  # fmt: skip


def with_defaults(task: str, given: Mapping[str, Any]) -> dict[str, Any]:
    """Complete the arguments of `configure` with the learner that the task declares.

    The task's learner is used if neither `algorithm` nor `preset` is given; `settings` override its settings by name.
    """
    has_learner = given.keys() & {"algorithm", "preset"} or task not in TASKS.names()
    learner: dict[str, Any] = {} if has_learner else dict(TASKS.get(task).learner)
    settings = flat_settings(learner.get("settings")) | flat_settings(given.get("settings"))
    return {**learner, **given} | ({"settings": settings} if settings else {})


def resumed_config(
    folder: RunFolder,
    task: str | None,
    environment: Mapping[str, Any],
    given: Mapping[str, Any],
    settings: Mapping[str, Any] | None,
    members: Sequence[SetMember] = (),
) -> RunConfig:
    """Return the configuration of the run to continue; raise an InputError if an argument contradicts it."""
    config = folder.config()
    config.refuse_changed_task(folder.path)
    stored = {"task": config.task, "seed": config.seed, "preset": config.preset, "algorithm": config.learner.algorithm}
    stored |= {"step_log": config.step_log, "human_in_the_loop": config.human_in_the_loop} | config.environment
    if environment:
        resolved = check_environment(config.task, environment)
        given_options = flat_environment(config.task, environment)
        environment = {key: resolved.get(key, value) for key, value in given_options.items()}
    arguments = {**as_arguments(environment), **given} | ({} if task is None else {"task": task})
    for key, value in arguments.items():
        if key == "episodes" and value < config.episodes and value < (done := folder.num_saved_episodes()):
            raise InputError(f"the run in {folder.path} has done {done} episodes: give at least as many")
        if key != "episodes" and stored.get(key) != value:
            raise InputError(
                f"the run in {folder.path} has {key} {stored.get(key)!r}, not {value!r}: leave {key} out, or train "
                "again in another folder"
            )
    if members and tuple(members) != config.members:
        raise InputError(
            f"the run in {folder.path} has another set of environments: leave the tasks and --variants out, or train "
            "again in another folder"
        )
    values = config_values(config.learner) | flat_settings(settings)
    algorithm = values.pop("algorithm")
    if make_config(algorithm, values) != config.learner:
        raise InputError(
            f"the run in {folder.path} has other learner settings: leave --set out, or train again in another folder"
        )
    episodes = check_episodes(given.get("episodes", config.episodes))
    return replace(config, episodes=episodes, versions=_merged_versions(folder, config))


def _merged_versions(folder: RunFolder, config: RunConfig) -> dict[str, str]:
    """Return the package versions so far and the current ones; warn if they differ, because results may differ."""
    merged = {}
    for name, current in installed_versions().items():
        stored = config.versions.get(name, current)
        merged[name] = stored if stored.split(", then ")[-1] == current else f"{stored}, then {current}"
    if changed := [f"{name} {value}" for name, value in merged.items() if value != config.versions.get(name, value)]:
        _LOGGER.warning("the run in %s continues with other versions: %s", folder.path, "; ".join(changed))
    return config.versions | merged


def warn_of_unfinished_source(config: RunConfig) -> None:
    """Warn if the run that the setting `init_from` names is unfinished; training starts from its checkpoint."""
    name = getattr(config.learner, "init_from", "")
    source = RunFolder(name)
    if name and source.checkpoint.is_file() and not (source.path / "policy.json").is_file():
        _LOGGER.warning(
            "the run %s that init_from names is unfinished: training starts from its checkpoint of %d episodes",
            source.path,
            source.num_saved_episodes(),
        )
