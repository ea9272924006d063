"""Run: its configuration, resolved from choices or from the run to resume, and the files of its folder.

The files are readable without the program that wrote them.
"""

from __future__ import annotations

import hashlib
import json
import logging
import platform
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, field, make_dataclass, replace
from functools import cache, cached_property
from importlib import metadata
from pathlib import Path
from typing import Annotated, Any, TypedDict, Unpack

import filelock
import pandas as pd
import yaml
from pydantic import ConfigDict, Field, SkipValidation
from pydantic.dataclasses import dataclass
from safetensors import SafetensorError, safe_open

from guiderail.diagrams.envs.options import flat_options
from guiderail.diagrams.tasks.registry import TASKS
from guiderail.models.common.errors import InputError, brief
from guiderail.models.common.yaml import load_yaml
from guiderail.tools.environments import check_environment, flat_environment, resolve_environment, task_content
from guiderail.tools.evaluation.episode import check_seed
from guiderail.tools.evaluation.metrics import check_rows
from guiderail.tools.files import (
    LOCK,
    refuse_existing_run,
    refuse_links,
    remove_partial_files,
    write_atomically,
    write_error,
)
from guiderail.tools.imports import import_stored, is_trusted
from guiderail.tools.learning.learner import LEARNERS, LearnerConfig
from guiderail.tools.learning.learner_config import (
    MAX_EPISODES,
    check_episodes,
    config_values,
    default_preset,
    make_config,
    resolve_preset,
)
from guiderail.tools.tables import read_table, table_text

PACKAGES = ("guiderail", "drake", "numpy", "scipy", "gymnasium", "torch", "stable-baselines3", "sb3-contrib", "daqp")
# Options that may change within a run: corrections add via-points, and a robot may have another address when resumed.
CHANGING = ("via_points", "robot_url", "robot_timeout")
_LOGGER = logging.getLogger(__name__)
_version = cache(metadata.version)  # cached, because it reads files


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class SetMember:
    """Environment of a set that a run trains in."""

    name: str  # name in the column `environment` of the table of episodes
    task: str  # name of the task
    environment: dict[str, Any]  # arguments of gymnasium.make
    task_content: str = ""  # digest of the files that define the task; empty if there are none


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class RunConfig:
    """Configuration of a run, with everything resolved: the same configuration gives the same run."""

    task: str  # name of the task
    environment: dict[str, Any]  # arguments of gymnasium.make
    learner: SkipValidation[LearnerConfig]  # all settings, an instance of the learner's `Config`
    preset: str | None  # preset that the learner's settings were derived from
    # Planned number of episodes. `stop_after_successes` may end training earlier; the table `episodes.csv` has one row
    # for each finished episode.
    episodes: Annotated[int, Field(ge=1, le=MAX_EPISODES, strict=True)]
    seed: Annotated[int, Field(ge=0, lt=2**31, strict=True)]  # seed of all random numbers
    versions: dict[str, str] = field(default_factory=dict)  # versions of the packages that the result depends on
    imports: tuple[str, ...] = ()  # modules, files or task folders that register the task, the learner, …
    step_log: bool = True  # True if every control step is written to the step log
    task_content: str = ""  # digest of the files that define the task; empty if there are none
    human_in_the_loop: bool = False  # True if a supervisor corrects the policy; see the option via_points
    simulated_driver: bool | None = None  # on a hardware station: True for a simulated driver, False for a robot
    source: str = ""  # in a study, state of the run that `init_from` named when training began; see `RunFolder.state`
    # Environments of a set, of which each episode has another one; `task` and `environment` are those of the first.
    # Empty for a single environment.
    members: tuple[SetMember, ...] = ()

    @cached_property
    def resolved(self) -> Any:
        """Environment as `make_environment` takes it: the validated `EnvConfig` of a registered task, or options."""
        return resolve_environment(self.task, self.environment)

    @property
    def action_repeat(self) -> int:
        """Control steps that an action lasts; in a set, the rounded mean over its environments."""
        environments = [member.environment for member in self.members] or [self.environment]
        return round(sum(int(each.get("action_repeat", 1)) for each in environments) / len(environments))

    @property
    def identity(self) -> str:
        """JSON text of all settings that determine an episode; a resumed run may change others, such as `episodes`."""
        environment = {name: value for name, value in self.environment.items() if name not in CHANGING}
        learner = config_values(self.learner) | ({"init_from": self.source} if self.source else {})
        members = [asdict(member) for member in self.members]
        return json.dumps([self.task, self.seed, environment, learner, *members], sort_keys=True)

    def refuse_changed_task(self, path: Path, otherwise: str = "train again in another folder") -> None:
        """Raise an InputError if the task's files have changed since the run in the folder `path` began.

        The message ends with `otherwise`, the alternative to restoring the files.
        """
        own = SetMember(self.task, self.task, self.environment, self.task_content)
        for member in self.members or (own,):
            current = task_content(member.task, member.environment, self.imports)
            if member.task_content and member.task_content != current:
                imported = "".join(f" or {Path(module).name}" for module in self.imports if module.endswith(".py"))
                raise InputError(
                    f"the files of {member.task}{imported} are not those that the run in {path} began with: restore "
                    f"them, or {otherwise}"
                )


def installed_versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that a result depends on."""
    return {"python": platform.python_version()} | {name: _version(name) for name in PACKAGES}


class RunFolder:
    """Files of one run.

    `config.yaml` is written at the start, a file in `steps/` at the end of each episode, `checkpoint/` and then
    `episodes.csv` at each checkpoint, and the policy at the end of the run. Each of them is replaced as a whole.

    Attributes:
        path: The folder.
        checkpoint: File that `--resume` continues from.
        steps: Folder of the step log; see `guiderail.tools.evaluation.step_log`.
        logs: Folder of the learning logs, such as those of TensorBoard.
    """

    def __init__(self, path: Path | str):
        """Construct the interface of the folder `path`, which may be missing."""
        self.path = Path(path)
        self.checkpoint = self.path / "checkpoint" / "state.safetensors"
        self.steps, self.logs = self.path / "steps", self.path / "logs"

    @property
    def state(self) -> str:
        """Name of the folder, number of episodes and digest of the policy, which identify a finished run."""
        policy = hashlib.blake2b((self.path / "policy.safetensors").read_bytes(), digest_size=8).hexdigest()
        return f"{self.path.name}, {len(self.episodes())} episodes, policy {policy}"

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Lock the run against other processes; the lock of a killed process has no effect."""
        refuse_links(self.path)
        lock = filelock.FileLock(self.path / LOCK, timeout=0)
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            lock.acquire()
        except filelock.Timeout:
            raise InputError(f"another process writes into {self.path}: wait for it, or name another folder") from None
        except OSError as error:
            raise write_error(self.path, error) from error
        try:
            remove_partial_files(self.path)
            yield
        finally:
            (self.path / LOCK).unlink(missing_ok=True)
            lock.release()

    def create(self, config: RunConfig) -> None:
        """Write the configuration of a new run; raise an InputError if the folder is not empty."""
        self.refuse_existing()
        self.write_config(config)

    def remove_unstarted(self, *, remove_folder: bool) -> None:
        """Remove the configuration of a run that has written nothing else, and with `remove_folder` the folder too."""
        if [file.name for file in self.path.iterdir() if not file.name.startswith(".")] != ["config.yaml"]:
            return
        (self.path / "config.yaml").unlink()
        if remove_folder:
            (self.path / LOCK).unlink(missing_ok=True)
            with suppress(OSError):  # the folder has hidden files of the user
                self.path.rmdir()

    def refuse_existing(self) -> None:
        """Raise an InputError if the folder holds anything but hidden files."""
        refuse_existing_run(self.path)

    def write_config(self, config: RunConfig) -> None:
        """Replace `config.yaml`."""
        values = asdict(config) | {"learner": config_values(config.learner)}
        values["imports"] = list(config.imports)
        if config.simulated_driver is None:
            del values["simulated_driver"]
        if not config.source:
            del values["source"]
        values["members"] = [asdict(member) for member in config.members]
        if not config.members:
            del values["members"]
        write_atomically(self.path / "config.yaml", yaml.safe_dump(values, sort_keys=False).encode())

    def config(self, *, runs_code: bool = True) -> RunConfig:
        """Read the configuration of the run, and import the modules that register its task and learner.

        Args:
            runs_code: False if the configuration is only shown: code that is not trusted is then not imported, and the
                settings of an unknown learner are not checked.
        """
        file = self.path / "config.yaml"
        refuse_links(self.path)
        try:
            is_run = file.is_file()
        except OSError as error:
            raise InputError(f"{brief(self.path)} cannot be read: {error.strerror}") from error
        if not is_run and (self.path / "policy.json").is_file():
            raise InputError(f"{self.path.name} is a policy without a run: name the task in which it acts (--task)")
        if not is_run:
            raise InputError(
                f"{self.path} is not a run: it has no config.yaml; give a folder that guiderail train wrote"
            )
        try:
            values = load_yaml(file, "configuration")
            values["environment"] = as_arguments(values["environment"])
            for member in values.get("members", ()):
                member["environment"] = as_arguments(member["environment"])
            settings = dict(values["learner"])
            config = RunConfig(**values)
            algorithm = settings.pop("algorithm")
            if runs_code or is_trusted():
                import_stored(config.imports, file)
            elif config.imports and algorithm not in LEARNERS.names():
                return replace(config, learner=_shown_settings(algorithm, settings))
            return replace(config, learner=make_config(algorithm, settings))
        except InputError:
            raise
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise InputError(f"{file} is damaged or of another version: restore it, or train again") from error

    def remove_policy(self) -> None:
        """Remove the policy, if there is one, because further training changes it."""
        for name in ("policy.json", "policy.safetensors"):
            (self.path / name).unlink(missing_ok=True)

    def write_episodes(self, rows: Sequence[Mapping[str, Any]]) -> None:
        """Replace `episodes.csv`; numbers are written such that they are read back bit for bit."""
        write_atomically(self.path / "episodes.csv", table_text(rows).encode())

    def num_saved_episodes(self) -> int:
        """Return the number of episodes in the checkpoint, 0 without one; raise an InputError if it is damaged."""
        if not self.checkpoint.is_file():
            return 0
        try:
            with safe_open(self.checkpoint, framework="numpy") as file:
                return len(json.loads(file.metadata()["values"])["rows"])
        except (SafetensorError, ValueError, KeyError, TypeError, OSError, RecursionError) as error:
            raise InputError(
                f"the checkpoint {self.checkpoint} is damaged: restore a copy, or train again in another folder"
            ) from error

    def episodes(self) -> pd.DataFrame:
        """Read `episodes.csv`; raise an InputError if it is missing or not a table of episodes."""
        return check_rows(read_table(self.path / "episodes.csv"), self.path / "episodes.csv")


def _shown_settings(algorithm: str, settings: dict[str, Any]) -> LearnerConfig:
    """Return the stored settings of a learner whose code is not imported."""
    # A name of a structured setting has a dot, which the name of a field cannot have.
    entries = {name.replace(".", "_"): name for name in settings}
    own = [(name, Any) for name in entries if name not in LearnerConfig.__dataclass_fields__]
    namespace = {"entries": entries}
    kind = make_dataclass("ShownConfig", own, bases=(LearnerConfig,), namespace=namespace, frozen=True, kw_only=True)
    shown: LearnerConfig = kind(algorithm=algorithm, **{name: settings[entry] for name, entry in entries.items()})
    return shown


def as_arguments(environment: Mapping[str, Any]) -> dict[str, Any]:
    """Return the arguments of an environment with each list, as read from YAML, converted to a tuple."""
    return {key: tuple(value) if isinstance(value, list) else value for key, value in environment.items()}


DEFAULT_EPISODES, DEFAULT_SEED = 60, 0


class Choices(TypedDict, total=False):
    """Choices of a run; one that is missing has its default."""

    algorithm: str  # registered name of the learner; default: the preset's, without a preset the task's
    preset: str | None  # settings of the learner; default: `default_preset`, without an algorithm the task's
    settings: Mapping[str, Any] | None  # settings of the learner that override those of preset and task
    episodes: int
    seed: int
    step_log: bool
    human_in_the_loop: bool  # True if a supervisor corrects the policy


def configure(
    task: str,
    environment: Mapping[str, Any],
    *,
    imports: Sequence[str] = (),
    members: Sequence[SetMember] = (),
    **choices: Unpack[Choices],
) -> RunConfig:
    """Return a checked configuration with everything resolved.

    Args:
        task: Name of the task; with `members`, that of the first member.
        environment: Options of the environment; with `members`, those of the first member.
        imports: Modules, files and task folders that register the task, as `import_modules` returns them.
        members: Environments of a set.
        **choices: Choices of the run.
    """
    has_learner = choices.keys() & {"algorithm", "preset"} or task not in TASKS.names()
    declared: dict[str, Any] = {} if has_learner else dict(TASKS.get(task).learner)
    settings = flat_options(declared.pop("settings", {})) | flat_options(choices.get("settings") or {})
    chosen: dict[str, Any] = declared | choices | {"settings": settings}
    episodes, seed = check_episodes(chosen.get("episodes", DEFAULT_EPISODES)), chosen.get("seed", DEFAULT_SEED)
    learner = resolve_preset(chosen.get("preset"), chosen.get("algorithm"), settings)
    resolved = resolve_environment(task, environment)
    options = as_arguments(resolved if isinstance(resolved, Mapping) else resolved.options)
    config = RunConfig(
        task, options, learner, chosen.get("preset") or default_preset(learner.algorithm), episodes, check_seed(seed),
        installed_versions(), tuple(imports), chosen.get("step_log", True), task_content(task, options, imports),
        chosen.get("human_in_the_loop", False), members=tuple(members),
    )  # fmt: skip
    vars(config)["resolved"] = resolved  # the environment is not resolved again
    return config


def resumed_config(
    folder: RunFolder,
    task: str | None,
    environment: Mapping[str, Any],
    choices: Choices,
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
    arguments = {**as_arguments(environment), **choices} | ({} if task is None else {"task": task})
    settings = arguments.pop("settings", None)
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
    values = config_values(config.learner) | flat_options(settings or {})
    algorithm = values.pop("algorithm")
    if make_config(algorithm, values) != config.learner:
        raise InputError(
            f"the run in {folder.path} has other learner settings: leave --set out, or train again in another folder"
        )
    episodes = check_episodes(choices.get("episodes", config.episodes))
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
