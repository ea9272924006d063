"""Declaration of a study: the content of its YAML file, validated with one-sentence errors."""

from __future__ import annotations

import itertools
import math
import re
import string
from collections.abc import Callable, Sequence
from pathlib import Path, PurePath
from typing import Annotated, Any

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    PrivateAttr,
    ValidationError,
    ValidatorFunctionWrapHandler,
    field_validator,
    model_validator,
)

from guiderail.models.common.errors import InputError, brief
from guiderail.models.common.registry import did_you_mean
from guiderail.models.common.yaml import load_yaml
from guiderail.tools.environments import task_named
from guiderail.tools.evaluation.episode import HELD_OUT_SEED

Integer = Annotated[int, Field(strict=True)]  # without `strict`, YAML's `true` would be 1
FolderName = Annotated[str, Field(pattern=r"^[\w-][\w.-]*\z", max_length=100)]
LEARNED = "learned"


def _placeholder_check(**examples: Any) -> Callable[[str], str]:
    """Return a validator of file names with placeholders in braces; `examples` has a value for each placeholder."""

    def check(name: str) -> str:
        known = ", ".join(f"{{{word}}}" for word in examples)
        try:
            fields = [field[1:] for field in string.Formatter().parse(name) if field[1] is not None]
        except ValueError:
            raise ValueError(f"{name!r} has a brace without its counterpart: the placeholders are {known}") from None
        # Format specifications (which could set a width of gigabytes), conversions and attributes are not allowed.
        if any(word not in examples or specification or conversion for word, specification, conversion in fields):
            raise ValueError(f"{name!r} has an unknown or formatted placeholder: the placeholders are {known}")
        path = PurePath(name.format(**examples))
        if path.is_absolute() or ".." in path.parts or not path.parts or "\0" in name:
            raise ValueError(f"{name!r} would be outside the study's folder: name a path inside it")
        return name

    return check


_check_run_name = _placeholder_check(method="skgrl", seed=0, episodes=60, algorithm="tqc")
_check_file = _placeholder_check(name="held_out", after_episodes=60, episodes=100, digest="0a")
_check_init_from = _placeholder_check(seed=0)
RunName = Annotated[str, AfterValidator(_check_run_name)]
EvaluatedFile = Annotated[str, AfterValidator(_check_file)]


def _check_distinct_seeds(seeds: tuple[int, ...]) -> tuple[int, ...]:
    if repeated := [seed for seed in seeds if seeds.count(seed) > 1]:
        raise ValueError(f"the seed {repeated[0]} is given twice: give each seed once")
    return seeds


Seed = Annotated[int, Field(strict=True, ge=0, lt=2**31)]
SweepValue = Annotated[float, Field(allow_inf_nan=False)]
Seeds = Annotated[tuple[Seed, ...], Field(min_length=1), AfterValidator(_check_distinct_seeds)]


class Strict(BaseModel):
    """Base class of the declarations: unknown keys are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class LearnerChoice(Strict):
    """Learner of a method, by default that of the task."""

    algorithm: str | None = None  # registered name of the learner
    preset: str | None = None  # preset of the learner's settings
    settings: dict[str, Any] = {}  # settings that override the preset's
    episodes: Integer | None = Field(default=None, ge=1)  # training episodes; default: the largest of after_episodes

    @field_validator("settings")
    @classmethod
    def _check_settings(cls, settings: dict[str, Any]) -> dict[str, Any]:
        if "init_from" in settings:
            if not isinstance(settings["init_from"], str):
                raise ValueError(f"init_from names the folder of a run, not {brief(settings['init_from'])}")
            _check_init_from(settings["init_from"])
        return settings


class Method(Strict):
    """Environment and policy that a study compares with others."""

    env: dict[str, Any] = {}  # options of the environment, in addition to the study's
    learner: LearnerChoice = LearnerChoice()  # overrides the study's; null: the task's algorithm or preset
    policy: str = LEARNED  # "learned", "best_constant", or the name of a baseline or scripted policy
    grid: tuple[float, ...] = (-1.0, 0.0, 1.0)  # values of each action component that best_constant tries
    seeds: Seeds | None = None  # default: the study's; one seed is enough for a policy without learning


class EvalSet(Strict):
    """Held-out episodes on which a policy is evaluated."""

    name: str = "held out"  # name in the table
    env: dict[str, Any] = {}  # options of the environment that differ from training
    sampled: dict[str, tuple[float, float]] = {}  # options that are resampled uniformly from a range
    every: Integer = Field(default=4, ge=1)  # number of consecutive episodes with the same sample
    options: dict[str, Any] = {}  # options of each reset
    episodes: Integer = Field(default=100, ge=1)  # number of episodes
    first_seed: Seed = HELD_OUT_SEED  # seed of the first episode; episode i has first_seed + i
    file: EvaluatedFile = "{name}-{after_episodes}-{digest}.csv"  # file of the episodes in the run's folder

    @field_validator("sampled")
    @classmethod
    def _check_ranges(cls, value: dict[str, tuple[float, float]]) -> dict[str, tuple[float, float]]:
        for name, (low, high) in value.items():
            if not -math.inf < low <= high < math.inf:
                raise ValueError(f"the range of {name} is two finite numbers, the smaller first, not {low}, {high}")
        return value


class Sweep(Strict):
    """Quantity of the environment that makes the task harder; results of the policies are plotted over its values."""

    quantity: str  # name and unit, the label of the axis
    at: dict[SweepValue, dict[str, Any]] = Field(min_length=1)  # options of the environment by value, easiest first
    options: dict[str, Any] = {}  # options of each reset
    episodes: Integer = Field(default=40, ge=1)  # number of episodes at each value

    @field_validator("at", mode="wrap")
    @classmethod
    def _check_distinct_values(cls, given: Any, validate: ValidatorFunctionWrapHandler) -> dict[float, dict[str, Any]]:
        values: dict[float, dict[str, Any]] = validate(given)
        if len(values) < len(given):
            equal = next(keys for keys in itertools.combinations(given, 2) if float(keys[0]) == float(keys[1]))
            raise ValueError(f"{equal[0]!r} and {equal[1]!r} are one value of the sweep: give it once")
        return values

    def eval_set(self, value: float) -> EvalSet:
        """Return the evaluation set of one value."""
        name = f"{self.quantity} {value:g}"
        file = re.sub(r"\W+", "_", self.quantity).strip("_") + f"-{value:g}-{{after_episodes}}-{{digest}}.csv"
        return EvalSet(name=name, env=self.at[value], options=self.options, episodes=self.episodes, file=file)


class _SeedChoice(Strict):
    """Seeds that replace those of a study."""

    seeds: Seeds


class Ratio(Strict):
    """Ratio of a column's value for one method to its value for another method."""

    of: str  # name of the column
    method: str  # method of the numerator
    against: str  # method of the denominator


class Study(Strict):
    """Study: every method is trained with every seed and evaluated on every evaluation set.

    A policy is evaluated after each number of training episodes in `after_episodes`.
    """

    name: FolderName  # name of the tables
    task: str  # name of the task of every method; in a YAML file, the path of a task folder is allowed too
    env: dict[str, Any] = {}  # options of the environment of every method
    learner: LearnerChoice = LearnerChoice()  # learner of every method that learns
    methods: dict[FolderName, Method] = Field(min_length=1)  # methods by name; folders and legends have the names
    seeds: Seeds  # seeds of training
    after_episodes: tuple[Annotated[Integer, Field(ge=1)], ...] = ()  # when policies are evaluated; default: at the end
    eval_set: tuple[EvalSet, ...] = (EvalSet(),)  # evaluation sets
    sweeps: tuple[Sweep, ...] = ()  # quantities; each of their values adds an evaluation set
    statistics: tuple[str, ...] = ()  # statistics of training in addition to the usual ones
    ratios: tuple[Ratio, ...] = ()  # ratios reported next to the table
    folder: RunName = "{method}-{seed}"  # folder of a run
    # Modules, files (.py) or task folders that register the task, the learner, …; relative to the working directory.
    imports: tuple[str, ...] = ()
    _whole: dict[str, Method] = PrivateAttr(default_factory=dict)  # methods of the whole study if this is a subset

    @property
    def all_methods(self) -> dict[str, Method]:
        """Methods, including those that `subset` left out."""
        return self._whole or self.methods

    @property
    def eval_sets(self) -> tuple[EvalSet, ...]:
        """All evaluation sets, those of the sweeps included."""
        return (*self.eval_set, *(sweep.eval_set(value) for sweep in self.sweeps for value in sweep.at))

    @model_validator(mode="after")
    def _check_names(self) -> Study:
        names = [eval_set.name for eval_set in self.eval_sets]
        if repeated := next((name for name in names if names.count(name) > 1), None):
            raise ValueError(f"two evaluation sets are called {repeated!r}: give each a name of its own")
        for ratio in self.ratios:
            for method in (ratio.method, ratio.against):
                if method not in self.methods:
                    raise ValueError(f"a ratio has the unknown method {method!r}: {did_you_mean(method, self.methods)}")
        return self

    @model_validator(mode="after")
    def _check_after_episodes(self) -> Study:
        learners = [method.learner for method in self.methods.values() if method.policy == LEARNED]
        common = self.learner.episodes or max(self.after_episodes, default=0)
        episodes = [learner.episodes or common for learner in learners]
        if unreached := [number for number in self.after_episodes if episodes and number > max(episodes)]:
            raise ValueError(
                f"no method trains for {unreached[0]} episodes, only for {max(episodes)}: leave {unreached[0]} out of "
                f"after_episodes, or give the learner at least {unreached[0]} episodes"
            )
        return self

    def subset_name(self, subset: Study) -> str | None:
        """Return the name of a subset's table; None for the whole study, whose table has the study's name."""
        methods = [] if subset.methods.keys() == self.methods.keys() else list(subset.methods)
        seeds = [] if subset.seeds == self.seeds else [str(seed) for seed in subset.seeds]
        return "-".join([self.name, *methods, *seeds]) if methods or seeds else None

    def subset(self, methods: Sequence[str] | None = None, seeds: Sequence[int] | None = None) -> Study:
        """Return the study with some of its methods, or with other seeds.

        The seeds of a method that declares its own are not changed.

        Raises:
            InputError: If a method is unknown, or the seeds are not valid.
        """
        for name in methods or ():
            if name not in self.methods:
                raise InputError(f"the study {self.name} has no method {name!r}: {did_you_mean(name, self.methods)}")
        chosen = self.methods if methods is None else {name: self.methods[name] for name in methods}
        try:
            changed_seeds = self.seeds if seeds is None else _SeedChoice(seeds=tuple(seeds)).seeds
        except ValidationError as error:
            raise InputError(sentence(error)) from error
        subset = self.model_copy(update={"methods": chosen, "seeds": changed_seeds})
        subset._whole = self.all_methods
        return subset


def load_study(file: Path | str) -> Study:
    """Read a study's YAML file.

    The task may be the path of a task folder. This path and those in `imports` are relative to the working directory,
    as in `guiderail train`.

    Raises:
        InputError: If the file does not exist or is not a valid study, or if the task folder is not valid.
    """
    path = Path(file)
    if not path.is_file():
        raise InputError(f"there is no file {path}: name a study's YAML file")
    data = load_yaml(path, "study")
    if not isinstance(data, dict):
        raise InputError(f"{path} is no study: it needs at least name, task, methods and seeds")
    try:
        study = Study.model_validate(data)
    except ValidationError as error:
        raise InputError(f"{path}: {sentence(error)}") from error
    task, folders = task_named(study.task)
    return study.model_copy(update={"task": task, "imports": (*study.imports, *folders)})


def source_file(out: Path, study: str) -> Path:
    """Return the file, in a study's folder `out`, that stores the path of the study's YAML file."""
    return out / "logs" / f"{study}.json"


def sentence(error: ValidationError, kinds: tuple[type[Strict], ...] = ()) -> str:
    """Return the first validation error as one sentence; `kinds` are the declarations, by default those of a study."""
    first = error.errors()[0]
    where = " ".join(".".join(str(part) for part in first["loc"]).split())  # a key may have line breaks
    if first["type"] == "extra_forbidden":
        known = {
            n for kind in kinds or (Study, Method, LearnerChoice, EvalSet, Sweep, Ratio) for n in kind.model_fields
        }
        return f"a {'method' if kinds else 'study'} has no key {where}: {did_you_mean(str(first['loc'][-1]), known)}"
    if first["type"] == "value_error":
        return " ".join(str(first["ctx"]["error"]).split())
    return f"{where}: {first['msg'][:1].lower()}{first['msg'][1:]}, not {first['input']!r}"[:300]
