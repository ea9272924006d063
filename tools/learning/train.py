"""Python API of training: `train` resolves and checks a configuration, trains the run and returns it."""

from __future__ import annotations

import logging
import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches
from inspect import signature
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import gymnasium
import pandas as pd

from guiderail.diagrams.tasks.registry import environment_id, is_task_folder
from guiderail.models.common.errors import InputError, brief
from guiderail.models.common.yaml import load_yaml
from guiderail.models.policy import Policy
from guiderail.tools.environments import check_environment, register_environment, task_named, warn_of_deviation
from guiderail.tools.evaluation.metrics import own_episodes, reports_success, summary
from guiderail.tools.evaluation.policies import is_policy_file
from guiderail.tools.evaluation.subject import counts_collisions
from guiderail.tools.imports import import_modules
from guiderail.tools.learning.environment_set import Variants, find_members, load_variants
from guiderail.tools.learning.learner import check_log_formats
from guiderail.tools.learning.learner_config import OffPolicyConfig
from guiderail.tools.learning.run_folder import (
    Choices,
    RunConfig,
    RunFolder,
    SetMember,
    configure,
    resumed_config,
    warn_of_unfinished_source,
)
from guiderail.tools.progress import EpisodeProgress

if TYPE_CHECKING:
    from guiderail.tools.learning.episodes import Supervise

# Statistics of a run's summary.
SUMMARY = (
    "episodes", "episodes_to_convergence", "success_rate", "success_rate_last_10", "mean_return_last_10",
    "max_commanded_violation", "peak_force", "collisions", "wall_time",
)  # fmt: skip

# Statistics that an environment of another package may lack, by their column.
_OF_TASKS = {"max_commanded_violation", "peak_force", "collisions"}

_LOGGER = logging.getLogger(__name__)


@dataclass(frozen=True)
class Run:
    """Training run, read from its folder. Functions that accept the folder also accept the run.

    Attributes:
        path: Folder of the run.
        pictures: Paths of the pictures drawn after training, by name; if a page could not be drawn, the reason.
    """

    path: Path
    pictures: Mapping[str, str] = field(default_factory=dict)

    def __fspath__(self) -> str:
        """Return the path of the folder."""
        return str(self.path)

    @property
    def config(self) -> RunConfig:
        """Configuration, with everything resolved."""
        return RunFolder(self.path).config()

    @property
    def episodes(self) -> pd.DataFrame:
        """Training episodes, one row each; the columns are described by `guiderail list metrics`."""
        return RunFolder(self.path).episodes()

    @property
    def policy(self) -> Policy:
        """Learned deterministic policy, evaluated by NumPy."""
        return Policy.load(self.path)

    @property
    def summary(self) -> dict[str, Any]:
        """Statistics of training, and the paths of the pictures; `collisions` is None if the task declares none."""
        rows = self.episodes
        config = load_yaml(self.path / "config.yaml", "configuration")  # `self.config` would import modules
        missing = () if environment_id(config["task"]) != config["task"] else _OF_TASKS - {*rows}
        known = [name for name in SUMMARY if name not in missing]
        recent, values = own_episodes(rows)["success"].tail(10), summary(rows, known)
        if not counts_collisions(config["task"]):
            values["collisions"] = None
        note = f"{recent.sum()} of the last {len(recent)}, with exploration" if len(recent) else "only demonstrations"
        if not reports_success(rows):
            values |= dict.fromkeys(("episodes_to_convergence", "success_rate", "success_rate_last_10"))
            note = "the environment reports none"
        trust = " --trust-imports" if _names_code(config) else ""
        note += f"; evaluate the deterministic policy with guiderail evaluate {shlex.quote(str(self.path))}{trust}"
        return {"run": str(self.path), **values, "success_in_training": note, **self.pictures}


def _names_code(config: Mapping[str, Any]) -> bool:
    """Return True if a run's configuration names code, which a new process loads only within `trust_imports`."""
    values = [value for value in config["environment"].values() if isinstance(value, str)]
    has_code = any(is_policy_file(value) and not value.endswith(".onnx") for value in values)
    return has_code or not all(map(is_task_folder, config["imports"]))


def train(
    task: str | gymnasium.Env | Sequence[str | gymnasium.Env] | None = None,
    guidance: str | None = None,
    *,
    out: Path | str,
    variants: Variants | Path | str | None = None,
    episodes: int | None = None,
    seed: int | None = None,
    algorithm: str | None = None,
    preset: str | None = None,
    settings: Mapping[str, Any] | None = None,
    log: str | Sequence[str] = (),
    callbacks: Any = None,
    resume: bool = False,
    pictures: bool = True,
    **options: Any,
) -> Run:
    """Train a policy and write its run folder.

    Args:
        task: Name of the task, or the path of a task folder; with `resume` it may be left out. An environment of
            another package: its id, or an environment such as a `GuidedEnv`, with a limit of steps. Its observations
            and actions are vectors (Box). The run of an environment that is given as an object can be evaluated and
            resumed in this process only. A list of these is a set: each episode is in another one of its environments,
            which have equal spaces and the same guidance.
        guidance: Name of the guidance; None for the task's default.
        out: Folder of the run; with `resume`, the folder of the run to continue.
        variants: Options of environments by a name, or a YAML file of them, for a set of environments: each task is
            combined with each variant. The option `task` of a variant names another task.
        episodes: Total number of episodes; None for 60.
        seed: Seed of all random numbers, in [0, 2³¹); None for 0.
        algorithm: Registered name of the learner; None for the preset's, or without a preset the task's.
        preset: Name of the learner's preset; None for the algorithm's default, or without an algorithm the task's.
        settings: Settings of the learner by name; they override the settings of the preset and of the task.
        log: Formats of a learning log in the folder's `logs/`: tensorboard, wandb, csv, json, log or stdout; none by
            default.
        callbacks: Callback of Stable-Baselines3, or a list of them; if one returns False, training ends after the
            episode.
        resume: Continue a run that was stopped; the result is that of an uninterrupted run. `episodes` may be changed
            to any number of at least the finished episodes, because training does not depend on the planned number.
        pictures: Draw the learning curve and the replay page after training.
        **options: Options of the environment, such as `station`, `reward` or `fixture_offset`.

    Returns:
        The run: its path, configuration, table of episodes and policy.

    Raises:
        InputError: If a name is unknown, a value is out of range, the folder is not empty, an argument contradicts the
            run to resume, an episode fails, or learning diverges.
    """
    given: list[Any] = list(task) if isinstance(task, list | tuple) else [] if task is None else [task]
    tasks = [register_environment(each) if isinstance(each, gymnasium.Env) else each for each in given]
    for each in tasks or ([] if resume and task is None else [task]):
        if not isinstance(each, str | PathLike):
            raise InputError(
                f"training needs the name of a task or its folder, an environment, or the id of an environment "
                f"registered with Gymnasium, not {brief(each)}"
            )
    names = [task_named(str(each)) for each in tasks]
    environment = options if guidance is None else {"guidance": guidance, **options}
    if names:
        _refuse_misspelled(names[0][0], environment, options)
    choices = {"algorithm": algorithm, "preset": preset, "settings": settings, "episodes": episodes, "seed": seed}
    return Training(
        Path(out),
        [name for name, _ in names],
        environment,
        cast(Choices, {key: value for key, value in choices.items() if value is not None}),
        variants=variants,
        imports=[folder for _, folders in names for folder in folders],
        resume=resume,
        log=log,
        callbacks=callbacks,
        pictures=pictures,
    ).start()


def _refuse_misspelled(task: str, environment: Mapping[str, Any], options: Mapping[str, Any]) -> None:
    """Raise an InputError if the environment refuses its options, and an option resembles an argument of `train`."""
    for name in options:
        if near := get_close_matches(name.lower(), signature(train).parameters.keys() - {"task", "options"}, 1, 0.8):
            try:
                check_environment(task, environment)
            except InputError:
                raise InputError(f"train has no argument {name!r}: did you mean {near[0]}?") from None


@dataclass(frozen=True)
class Training:
    """Training as `train` and the command line request it."""

    out: Path  # folder of the run
    tasks: Sequence[str] = ()  # names of tasks, several for a set of environments; empty with `resume`
    environment: Mapping[str, Any] = field(default_factory=dict)  # options of the environment
    choices: Choices = field(default_factory=Choices)  # choices of the run
    variants: Variants | Path | str | None = None  # options of environments by a variant's name, or their file
    imports: Sequence[str] = ()  # modules, files (.py) or task folders that register the task, the learner, …
    resume: bool = False  # True to continue the run in `out`
    log: str | Sequence[str] = ()  # formats of the learning log
    callbacks: Any = None  # callbacks of Stable-Baselines3
    pictures: bool = True  # True to draw the learning curve and the replay page
    open_supervision: Callable[[], Supervise] | None = None  # function that waits for a supervisor, or None

    def start(self) -> Run:
        """Train with a progress bar, and draw the learning curve and the replay page.

        A resumed run keeps its configuration; only `episodes` may change, to at least the number of finished episodes.
        The learner's `demonstrator`, by default the task's scripted policy, acts in its `demonstration_episodes`.
        """
        imports, formats = import_modules(self.imports), check_log_formats(self.log)
        folder = RunFolder(self.out)
        config = self._config(folder, imports)
        if not self.resume:
            if "demonstrations" in self.environment or any(map(is_task_folder, imports)):
                warn_of_deviation(config.resolved)
            warn_of_unfinished_source(config)
        # These import PyTorch: slow, so after the checks.
        from guiderail.tools.learning.episodes import make_demonstrator
        from guiderail.tools.learning.trainer import Observers, run_training

        demonstrator = make_demonstrator(config)
        supervise = self.open_supervision() if config.human_in_the_loop and self.open_supervision is not None else None
        label = f"{len(config.members)} environments" if config.members else config.task
        with EpisodeProgress(config.episodes, name=label) as progress:
            observers = Observers(progress.update, formats, self.callbacks)
            run_training(
                folder, config, resume=self.resume, demonstrator=demonstrator, supervise=supervise, observers=observers
            )
        if not self.pictures:
            return Run(self.out)
        _LOGGER.info("training is complete; drawing the learning curve and a replay page into %s", self.out)
        return Run(self.out, draw_pictures(self.out))

    def _config(self, folder: RunFolder, imports: Sequence[str]) -> RunConfig:
        """Return the configuration of the run, new or resumed."""
        choices = (
            self.choices if self.open_supervision is None else Choices({**self.choices, "human_in_the_loop": True})
        )
        task, environment = next(iter(self.tasks), None), self.environment
        members: tuple[SetMember, ...] = ()
        if len(self.tasks) > 1 or (self.variants is not None and self.tasks):
            members, folders = find_members(self.tasks, environment, load_variants(self.variants), imports)
            imports = tuple(dict.fromkeys((*imports, *folders)))
            task, environment = members[0].task, members[0].environment
        if self.resume:
            config = resumed_config(folder, task, environment, choices, members)
        elif task is None:
            raise InputError("training needs a task: name a task, such as guiderail train NarrowPassage --out RUN")
        else:
            folder.refuse_existing()
            config = configure(task, environment, imports=imports, members=members, **choices)
        num_demonstrated = config.learner.demonstration_episodes
        if isinstance(config.learner, OffPolicyConfig) and num_demonstrated >= config.episodes:
            _LOGGER.warning(
                "the demonstrator acts in every episode and the learned one in none, because demonstration_episodes "
                "is %d: give more than %d episodes",
                num_demonstrated,
                num_demonstrated,
            )
        return config


def draw_pictures(out: Path) -> dict[str, str]:
    """Draw the learning curve and the replay page of a run, and return their paths.

    If the replay page cannot be drawn on this machine, the reason is returned in place of its path.
    """
    from guiderail.tools.evaluation.subject import EpisodeSpec
    from guiderail.tools.visualization.figures import plot_run
    from guiderail.tools.visualization.replay import default_page, write_page

    try:
        curve = str(plot_run(out))
    except InputError as error:
        curve = f"none: {error}"
    try:
        write_page(page := default_page(out, {}), EpisodeSpec.of_policy(out))
        return {"curve": curve, "replay": str(page)}
    except InputError as error:
        return {"curve": curve, "replay": f"none: {error}"}
