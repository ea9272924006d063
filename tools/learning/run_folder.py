"""What a run leaves behind: one folder, readable without the program that wrote it."""

import csv
import io
import platform
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Any

import yaml

from guiderail.models.errors import InputError
from guiderail.tools.files import write_atomically
from guiderail.tools.learning.presets import Preset, resolve_preset

PACKAGES = ("guiderail", "drake", "numpy", "scipy", "gymnasium", "torch", "stable-baselines3", "sb3-contrib", "daqp")


@dataclass(frozen=True)
class RunConfig:
    """Everything that decides how a run goes, resolved: the same file gives the same run."""

    task: str
    environment: dict[str, Any]  # arguments of gymnasium.make
    learner: Preset
    preset: str  # the learner's settings started from it
    episodes: int
    seed: int
    versions: dict[str, str] = field(default_factory=dict)

    @property
    def hold(self) -> int:
        """Control steps that an action lasts."""
        return int(self.environment.get("hold", 1))


def installed_versions() -> dict[str, str]:
    """The versions that a result depends on."""
    return {"python": platform.python_version()} | {name: metadata.version(name) for name in PACKAGES}


class RunFolder:
    """The files of one run.

    `config.yaml` is there from the start, `episodes.csv` and `checkpoint/` grow together at the end of an episode, the
    rest is written when the run ends. Every file is replaced whole.
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

    def create(self, config: RunConfig) -> None:
        """Starts a run.

        Raises:
            InputError: if the folder holds something already.
        """
        self.refuse_existing()
        self.write_config(config)

    def refuse_existing(self) -> None:
        """Raises an InputError if the folder holds something already."""
        if self.path.exists() and (not self.path.is_dir() or any(self.path.iterdir())):
            raise InputError(f"{self.path} already exists: name another folder, or go on with that run by --resume")

    def refuse_another(self, wanted: RunConfig, also: Sequence[str] = ()) -> None:
        """A run with other settings is neither trained further nor judged as if it were this one.

        Raises:
            InputError: if task, environment, learner, seed or one of `also` differs.
        """
        found = self.config()
        for key in ("task", "environment", "learner", "seed", *also):
            if getattr(found, key) != getattr(wanted, key):
                raise InputError(f"{self.path} holds a run with another {key}: name another folder with --out")

    def write_config(self, config: RunConfig) -> None:
        """Replaces `config.yaml`."""
        values = asdict(config) | {"learner": asdict(config.learner) | {"units": list(config.learner.units)}}
        write_atomically(self.path / "config.yaml", yaml.safe_dump(values, sort_keys=False).encode())

    def config(self) -> RunConfig:
        """The configuration that the run was started with.

        Raises:
            InputError: if this is no run, or its configuration makes no sense.
        """
        file = self.path / "config.yaml"
        if not file.is_file():
            raise InputError(
                f"{self.path} is not a run: it has no config.yaml; give a folder that guiderail train made"
            )
        try:
            values = yaml.safe_load(file.read_text(encoding="utf-8"))
            learner = dict(values["learner"])
            # A setting that did not exist yet was off, as its default is, whatever the preset has become since.
            settings = {key: value for key, value in (asdict(Preset()) | learner).items() if key != "algorithm"}
            config = RunConfig(
                task=str(values["task"]),
                environment=as_arguments(values["environment"]),
                learner=resolve_preset(values["preset"], learner["algorithm"], settings),
                preset=values["preset"],
                episodes=int(values["episodes"]),
                seed=int(values["seed"]),
                versions=dict(values["versions"]),
            )
        except (yaml.YAMLError, UnicodeDecodeError, KeyError, TypeError, ValueError) as error:
            raise InputError(f"{file} is damaged or of another version: restore it, or train anew") from error
        if config.episodes < 1 or config.seed < 0:
            raise InputError(f"{file} asks for {config.episodes} episodes with seed {config.seed}: restore it")
        return config

    def write_episodes(self, rows: Sequence[Mapping[str, Any]]) -> None:
        """Replaces `episodes.csv`. Numbers are written so that reading them gives the same number."""
        write_atomically(self.path / "episodes.csv", table_text(rows).encode())

    def episodes(self) -> list[dict[str, Any]]:
        """The rows of `episodes.csv`, numbers as numbers.

        Raises:
            InputError: if the file is missing or no such table.
        """
        return read_table(self.path / "episodes.csv")


def as_arguments(environment: Mapping[str, Any]) -> dict[str, Any]:
    """An environment's arguments as they are passed: YAML knows lists only, arguments are tuples."""
    return {key: tuple(value) if isinstance(value, list) else value for key, value in dict(environment).items()}


def table_text(rows: Sequence[Mapping[str, Any]]) -> str:
    """Rows as CSV; the first row names the columns."""
    text = io.StringIO()
    if rows:
        writer = csv.DictWriter(text, fieldnames=list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows({key: _written(value) for key, value in row.items()} for row in rows)
    return text.getvalue()


def read_table(path: Path) -> list[dict[str, Any]]:
    """The rows of a CSV file, with what looks like a number as a number.

    Raises:
        InputError: if the file is missing or is no table.
    """
    if not path.is_file():
        raise InputError(f"{path} is missing: the run has no finished episode yet, or the file was moved")
    try:
        rows = list(csv.DictReader(path.read_text(encoding="utf-8").splitlines()))
        if any(None in row or None in row.values() for row in rows):
            raise ValueError("rows of unequal length")
        return [{key: _read(value) for key, value in row.items()} for row in rows]
    except (csv.Error, ValueError) as error:
        raise InputError(f"{path} is not a table of episodes: restore it, or train anew") from error


def _written(value: Any) -> Any:
    """A cell: an exact number, nothing for what is unknown."""
    if isinstance(value, bool):
        return int(value)
    return "" if value is None else repr(float(value)) if isinstance(value, float) else value


def _read(cell: str) -> Any:
    """What a cell says."""
    for kind in (int, float):
        try:
            return kind(cell)
        except ValueError:
            continue
    return cell


def converged_after(successes: Iterable[bool], in_a_row: int = 10) -> int | None:
    """How many episodes it took until the following ten all succeeded (the thesis's figure 3.8); None if never."""
    run = 0
    for index, success in enumerate(successes):
        run = run + 1 if success else 0
        if run == in_a_row:
            return index + 1 - in_a_row
    return None
