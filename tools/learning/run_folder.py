"""What a run leaves behind: one folder, readable without the program that wrote it."""

import platform
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, field, replace
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Annotated, Any

import filelock
import pandas as pd
import yaml
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from guiderail.models.common.errors import InputError, brief
from guiderail.models.common.yaml import load_yaml
from guiderail.tools.environments import check_environment, import_modules, task_content
from guiderail.tools.evaluation.metrics import check_rows
from guiderail.tools.files import LOCK, remove_parts, write_atomically
from guiderail.tools.learning.config import LearnerConfig
from guiderail.tools.tables import read_table, table_text

PACKAGES = ("guiderail", "drake", "numpy", "scipy", "gymnasium", "torch", "stable-baselines3", "sb3-contrib", "daqp")


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class RunConfig:
    """Everything that decides how a run goes, resolved: the same file gives the same run."""

    task: str  # its name
    environment: dict[str, Any]  # arguments of gymnasium.make
    learner: LearnerConfig  # every setting
    preset: str  # the learner's settings started from it
    episodes: Annotated[int, Field(ge=1, le=10**9, strict=True)]  # how many in all
    seed: Annotated[int, Field(ge=0, lt=2**31, strict=True)]  # of everything random
    versions: dict[str, str] = field(default_factory=dict)  # that the result depends on
    imports: tuple[str, ...] = ()  # modules or files that register what is used here
    step_log: bool = True  # whether every control step is written down
    task_content: str = ""  # the digest of the files that the task is made of; empty where there are none
    with_person: bool = False  # whether a person watches; what was corrected is in the environment's via_points

    @property
    def action_repeat(self) -> int:
        """Control steps that an action lasts."""
        return int(self.environment.get("action_repeat", 1))

    def refuse_changed_task(self, path: Path) -> None:
        """Raises an InputError if the task's files are not those with which the run in that folder began."""
        now = task_content(self.task, self.environment, self.imports)
        if self.task_content and self.task_content != now:
            raise InputError(
                f"the files of {self.task} are not those that the run in {path} began with: restore them, or train "
                "anew in another folder"
            )


def installed_versions() -> dict[str, str]:
    """The versions that a result depends on."""
    return {"python": platform.python_version()} | {name: _version(name) for name in PACKAGES}


@cache
def _version(name: str) -> str:
    """Of a package: what an interpreter imported stays what it is, and a study asks a thousand times."""
    return metadata.version(name)


class RunFolder:
    """The files of one run.

    `config.yaml` is there from the start, `steps/` gets a file as each episode ends, `episodes.csv` and `checkpoint/`
    grow together after it, the rest is written when the run ends. Every file is replaced whole.
    """

    def __init__(self, path: Path | str):
        """
        Args:
            path: the folder; it need not exist.
        """
        self.path = Path(path)

    @property
    def checkpoint(self) -> Path:
        """The file that `--resume` goes on from."""
        return self.path / "checkpoint" / "state.safetensors"

    @property
    def steps(self) -> Path:
        """The folder with every control step; see `guiderail.tools.evaluation.step_log`."""
        return self.path / "steps"

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Keeps every other process from writing into the run; a killed one's lock holds nobody back.

        Raises:
            InputError: if another process writes into it, or nobody can.
        """
        lock = filelock.FileLock(self.path / LOCK, timeout=0)
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            lock.acquire()
        except filelock.Timeout:
            raise InputError(f"another process writes into {self.path}: wait for it, or name another folder") from None
        except OSError as error:
            raise InputError(
                f"{self.path} cannot be written ({error.strerror}): choose a folder with room to write"
            ) from error
        try:
            remove_parts(self.path)
            yield
        finally:
            (self.path / LOCK).unlink(missing_ok=True)
            lock.release()

    def create(self, config: RunConfig) -> None:
        """Starts a run.

        Raises:
            InputError: if the folder holds something already.
        """
        self.refuse_existing()
        self.write_config(config)

    def remove_unbegun(self, *, made: bool) -> None:
        """Removes what `create` wrote of a run of which nothing else was written; otherwise nothing.

        Args:
            made: whether the folder itself is to go too.
        """
        if [one.name for one in self.path.iterdir() if not one.name.startswith(".")] != ["config.yaml"]:
            return
        (self.path / "config.yaml").unlink()
        if made:
            (self.path / LOCK).unlink(missing_ok=True)
            with suppress(OSError):  # somebody keeps something in it
                self.path.rmdir()

    def refuse_existing(self) -> None:
        """Raises an InputError if the folder holds something already, but for hidden files."""
        # Such as what is left of a run that was killed before it had a configuration: nothing that could go on.
        try:
            is_taken = self.path.exists() and (
                not self.path.is_dir() or any(not one.name.startswith(".") for one in self.path.iterdir())
            )
        except OSError as error:
            raise InputError(f"{brief(self.path)} is no folder for a run: {error.strerror}") from error
        if is_taken:
            raise InputError(f"{self.path} already exists: name another folder, or go on with that run by --resume")

    def refuse_another(self, wanted: RunConfig, also: Sequence[str] = ()) -> None:
        """A run with other settings is neither trained further nor judged as if it were this one.

        Raises:
            InputError: if task, environment, learner, seed, the files of the task or one of `also` differs.
        """
        found = self.config()
        found.refuse_changed_task(self.path)
        # An option that a run is older than had its default then.
        found = replace(found, environment=as_arguments(check_environment(found.task, found.environment)))
        for key in ("task", "environment", "learner", "seed", *also):
            if getattr(found, key) != getattr(wanted, key):
                raise InputError(f"{self.path} holds a run with another {key}: name another folder with --out")

    def write_config(self, config: RunConfig) -> None:
        """Replaces `config.yaml`."""
        values = asdict(config) | {"learner": asdict(config.learner) | {"net_arch": list(config.learner.net_arch)}}
        values["imports"] = list(config.imports)
        write_atomically(self.path / "config.yaml", yaml.safe_dump(values, sort_keys=False).encode())

    def config(self) -> RunConfig:
        """The configuration that the run was started with.

        Raises:
            InputError: if this is no run, or its configuration makes no sense.
        """
        file = self.path / "config.yaml"
        try:
            is_run = file.is_file()
        except OSError as error:
            raise InputError(f"{brief(self.path)} cannot be read: {error.strerror}") from error
        if not is_run:
            raise InputError(
                f"{self.path} is not a run: it has no config.yaml; give a folder that guiderail train made"
            )
        try:
            values = load_yaml(file, "configuration")
            values["learner"] = LearnerConfig(**values["learner"])
            values["environment"] = as_arguments(values["environment"])
            config = RunConfig(**values)
        except InputError:
            raise
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise InputError(f"{file} is damaged or of another version: restore it, or train anew") from error
        import_modules(config.imports)
        return config

    def remove_policy(self) -> None:
        """Removes the policy, if there is one: what learns on has another by the end."""
        for name in ("policy.json", "policy.safetensors"):
            (self.path / name).unlink(missing_ok=True)

    def write_episodes(self, rows: Sequence[Mapping[str, Any]]) -> None:
        """Replaces `episodes.csv`. Numbers are written so that reading them gives the same number."""
        write_atomically(self.path / "episodes.csv", table_text(rows).encode())

    def episodes(self) -> pd.DataFrame:
        """The table `episodes.csv`.

        Raises:
            InputError: if the file is missing or no such table.
        """
        return check_rows(read_table(self.path / "episodes.csv"), self.path / "episodes.csv")


def as_arguments(environment: Mapping[str, Any]) -> dict[str, Any]:
    """An environment's arguments as they are passed: YAML knows lists only, arguments are tuples."""
    return {key: tuple(value) if isinstance(value, list) else value for key, value in dict(environment).items()}
