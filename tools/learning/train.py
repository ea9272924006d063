"""`guiderail train`: what was typed becomes a checked configuration, and a run becomes a folder with its pictures."""

import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import gymnasium
import pandas as pd

from guiderail.diagrams.tasks.registry import TASKS
from guiderail.models.common.errors import InputError
from guiderail.tools.environments import check_environment, import_modules, task_content
from guiderail.tools.evaluation.metrics import summary
from guiderail.tools.evaluation.progress import EpisodeProgress
from guiderail.tools.evaluation.rollout import PolicyFn, check_seed
from guiderail.tools.learning.config import resolve_preset
from guiderail.tools.learning.interventions import Supervisor
from guiderail.tools.learning.run_folder import RunConfig, RunFolder, as_arguments, installed_versions

DEFAULTS: dict[str, Any] = {"algorithm": "tqc", "preset": "tqc_contact", "episodes": 60, "seed": 0}


def own_defaults(task: str) -> dict[str, Any]:
    """The learner that a task declares, taken where neither algorithm nor preset is asked for."""
    return dict(TASKS.get(task).learner) if task in TASKS.names() else {}


# What a finished run says about itself.
SUMMARY = (
    "episodes", "episodes_to_convergence", "success_rate", "success_rate_last_10", "mean_return_last_10",
    "max_commanded_violation", "peak_force", "collisions", "wall_time",
)  # fmt: skip


def configure(
    task: str,
    environment: Mapping[str, Any],
    *,
    algorithm: str = DEFAULTS["algorithm"],
    preset: str = DEFAULTS["preset"],
    settings: Mapping[str, Any] | None = None,
    episodes: int = DEFAULTS["episodes"],
    seed: int = DEFAULTS["seed"],
    imports: Sequence[str] = (),
    step_log: bool = True,
    with_person: bool = False,
) -> RunConfig:
    """A checked configuration with everything resolved.

    Raises:
        InputError: for an unknown name or a number out of range.
    """
    if episodes < 1:
        raise InputError(f"a run needs at least one episode, not {episodes}")
    check_seed(seed)
    learner = resolve_preset(preset, algorithm, settings)
    resolved = check_environment(task, environment)
    return RunConfig(
        task, as_arguments(resolved), learner, preset, episodes, seed, installed_versions(), tuple(imports), step_log,
        task_content(task, resolved, imports), with_person,
    )  # fmt: skip


def run(
    task: str | None,
    out: Path | None,
    *,
    environment: Mapping[str, Any],
    algorithm: str | None = None,
    preset: str | None = None,
    settings: Mapping[str, Any] | None = None,
    episodes: int | None = None,
    seed: int | None = None,
    resume: bool = False,
    imports: Sequence[str] = (),
    step_log: bool | None = None,
    person: Callable[[], Supervisor] | None = None,
    demonstrator: Callable[[str], Callable[[gymnasium.Env], PolicyFn]] | None = None,
) -> dict[str, Any]:
    """Trains, with a progress bar, and leaves the curve and the replay page too. None stands for the default.

    A run that goes on keeps its configuration; only more episodes may be asked for. `person` makes who watches, pushes
    and speaks, where somebody does. `demonstrator` finds who acts in
    the learner's `demonstration_episodes` by the task's name, and raises an InputError where nobody does.

    Returns:
        What happened, in a few numbers.
    """
    if out is None:
        raise InputError("where should the run go? name a folder with --out RUN")
    folder = RunFolder(out)
    imports = import_modules(imports)
    choices = {"algorithm": algorithm, "preset": preset, "episodes": episodes, "seed": seed, "step_log": step_log}
    choices["with_person"] = None if person is None else True
    given: dict[str, Any] = {key: value for key, value in choices.items() if value is not None}
    if resume:
        config = _continued(folder, task, environment, given, settings)
    elif task is None:
        raise InputError("what should be learned? name a task, such as guiderail train NarrowPassage --out RUN")
    else:
        folder.refuse_existing()
        given["settings"] = settings
        config = configure(task, environment, imports=imports, **with_defaults(task, given))
    from guiderail.tools.learning.trainer import train  # PyTorch takes seconds: what is wrong was refused by now

    shows = demonstrator(config.task) if demonstrator and config.learner.demonstration_episodes else None
    watching = person() if config.with_person and person is not None else None
    with EpisodeProgress(config.episodes, name=config.task) as progress:
        rows = train(folder, config, resume=resume, report=progress.update, demonstrator=shows, person=watching)
    print(f"learned; now the learning curve and a replay page are drawn into {out}", file=sys.stderr, flush=True)
    return {"run": str(out), **summary(pd.DataFrame(rows), SUMMARY)} | finish(out)


def with_defaults(task: str, given: Mapping[str, Any]) -> dict[str, Any]:
    """What was asked for, and for the rest the learner that this task was measured with.

    Args:
        task: its name.
        given: of `configure`; the task's own learner is taken where neither algorithm nor preset is among them, with
            single settings of it replaced.
    """
    learner = {} if given.keys() & {"algorithm", "preset"} else own_defaults(task)
    settings = {**learner.get("settings", {}), **(given.get("settings") or {})}
    return {**learner, **given} | ({"settings": settings} if settings else {})


def finish(out: Path) -> dict[str, str]:
    """Adds the pictures to a run that has its numbers; what cannot be drawn on this machine is said, not raised."""
    from guiderail.tools.visualization.curves import plot_run
    from guiderail.tools.visualization.episode_spec import EpisodeSpec
    from guiderail.tools.visualization.replay import default_page, write_page

    curve = str(plot_run(out))
    try:
        write_page(page := default_page(out, {}), EpisodeSpec.of_run(out))
        return {"curve": curve, "replay": str(page)}
    except InputError as error:
        return {"curve": curve, "replay": f"none: {error}"}


def _continued(
    folder: RunFolder,
    task: str | None,
    environment: Mapping[str, Any],
    given: Mapping[str, Any],
    settings: Mapping[str, Any] | None,
) -> RunConfig:
    """The configuration of the run that goes on; refuses what would make it another run."""
    config = folder.config()
    config.refuse_changed_task(folder.path)
    stored = {"task": config.task, "seed": config.seed, "preset": config.preset, "algorithm": config.learner.algorithm}
    stored |= {"step_log": config.step_log, "with_person": config.with_person} | config.environment
    environment = {key: check_environment(config.task, environment).get(key, environment[key]) for key in environment}
    wanted = {**as_arguments(environment), **given} | ({} if task is None else {"task": task})
    for key, value in wanted.items():
        if key == "episodes" and value < config.episodes:
            raise InputError(f"the run in {folder.path} has {config.episodes} episodes: it can only be given more")
        if key != "episodes" and stored.get(key) != value:
            raise InputError(
                f"the run in {folder.path} has {key} {stored.get(key)!r}, not {value!r}: leave {key} out, or train anew"
            )
    stored_learner = {key: value for key, value in asdict(config.learner).items() if key != "algorithm"}
    learner = resolve_preset(config.preset, config.learner.algorithm, stored_learner | dict(settings or {}))
    if learner != config.learner:
        raise InputError(f"the run in {folder.path} has other learner settings: leave --set out, or train anew")
    return replace(config, episodes=given.get("episodes", config.episodes), versions=_versions(folder, config))


def _versions(folder: RunFolder, config: RunConfig) -> dict[str, str]:
    """Of the run so far and from now on; where they differ it is said, as the result may then be another one."""
    told = {}
    for name, now in installed_versions().items():
        before = config.versions.get(name, now)
        told[name] = before if before.split(", then ")[-1] == now else f"{before}, then {now}"
    if changed := [f"{name} {words}" for name, words in told.items() if words != config.versions.get(name, words)]:
        print(f"the run in {folder.path} goes on with other versions: {'; '.join(changed)}", file=sys.stderr)
    return config.versions | told
