"""What a study's YAML file may say, and one sentence where it says something else."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    ValidationError,
    ValidationInfo,
    field_validator,
    model_validator,
)

from guiderail.models.common.errors import InputError
from guiderail.models.common.registry import did_you_mean
from guiderail.models.common.yaml import load_yaml
from guiderail.tools.evaluation.evaluate import HELD_OUT_SEED
from guiderail.tools.evaluation.metrics import statistics_of

Whole = Annotated[int, Field(strict=True)]  # YAML's `true` would be 1 otherwise
FolderName = Annotated[str, Field(pattern=r"^[\w.-]+$")]
LEARNED = "learned"


def _filled_in(**words: Any) -> AfterValidator:
    """A name whose words in braces are some of these, each with something that could stand there."""

    def checked(name: str) -> str:
        try:
            name.format(**words)
        except (LookupError, ValueError, TypeError, AttributeError):
            known = ", ".join(f"{{{word}}}" for word in words)
            raise ValueError(f"{name!r} has braces that nothing fills: it may have {known}") from None
        return name

    return AfterValidator(checked)


RunName = Annotated[str, _filled_in(method="skgrl", seed=0, episodes=60, algorithm="tqc")]
EvaluatedFile = Annotated[str, _filled_in(name="held_out", after_episodes=60, episodes=100, digest="0a")]


class _Strict(BaseModel):
    """Base of the declarations: unknown keys are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class LearnerChoice(_Strict):
    """How it is learned; what is left out is the task's own."""

    algorithm: str | None = None  # a learner's name
    preset: str | None = None  # of the learner's settings
    settings: dict[str, Any] = {}  # in place of the preset's
    episodes: Whole | None = Field(default=None, ge=1)  # of training; the last mark unless given


class Method(_Strict):
    """Who acts, through what."""

    env: dict[str, Any] = {}  # in place of the study's, or besides
    learner: LearnerChoice = LearnerChoice()  # in place of the study's
    policy: str = LEARNED  # or a null policy, best_constant, rule, or a rule's name
    grid: tuple[float, ...] = (-1.0, 0.0, 1.0)  # of each number of an action, for best_constant
    seeds: tuple[Whole, ...] | None = None  # the study's unless given: what doesn't depend on them needs one


class EvalSet(_Strict):
    """Held-out episodes that a policy is judged on."""

    name: str = "held out"  # in the table
    env: dict[str, Any] = {}  # other arguments than where it learned
    sampled: dict[str, tuple[float, float]] = {}  # arguments that are uniform in a range, anew every few episodes
    every: Whole = Field(default=4, ge=1)
    options: dict[str, Any] = {}  # of each reset
    episodes: Whole = Field(default=100, ge=1)  # how many
    first_seed: Whole = Field(default=HELD_OUT_SEED, ge=0)  # of the first episode; each has the next
    file: EvaluatedFile = "{name}-{after_episodes}-{digest}.csv"  # in the run's folder: what was evaluated already


class Sweep(_Strict):
    """One number of the environment made harder and harder: judged at each of its values, and drawn."""

    quantity: str  # what is varied, with its unit, under the picture
    at: dict[float, dict[str, Any]] = Field(min_length=1)  # the environment's arguments by its value, the easiest first
    options: dict[str, Any] = {}  # of each reset
    episodes: Whole = Field(default=40, ge=1)  # at each value

    def eval_set(self, value: float) -> EvalSet:
        """What is judged at one of its values."""
        name = f"{self.quantity} {value:g}"
        file = re.sub(r"\W+", "_", self.quantity).strip("_") + f"-{value:g}-{{after_episodes}}-{{digest}}.csv"
        return EvalSet(name=name, env=self.at[value], options=self.options, episodes=self.episodes, file=file)


class Ratio(_Strict):
    """A column of one method as a part of another's."""

    of: str  # the column
    method: str  # whose part is stated
    against: str  # of whose


class Study(_Strict):
    """Methods × seeds × marks × what is judged on."""

    name: FolderName  # of the tables
    task: str  # of every method
    env: dict[str, Any] = {}  # options of the environment, of every method
    learner: LearnerChoice = LearnerChoice()  # of every method that learns
    methods: dict[FolderName, Method] = Field(min_length=1)  # by name, of a folder and a legend
    seeds: tuple[Whole, ...] = Field(min_length=1)  # of training
    after_episodes: tuple[
        Annotated[Whole, Field(ge=1)], ...
    ] = ()  # training episodes after which a policy is judged; all of them unless given
    eval_set: tuple[EvalSet, ...] = (EvalSet(),)  # each of them, after every mark
    sweeps: tuple[Sweep, ...] = ()  # of which each value is judged on, too
    statistics: tuple[str, ...] = ()  # of training, besides the usual ones
    ratios: tuple[Ratio, ...] = ()  # what is said beside the table
    folder: RunName = "{method}-{seed}"  # of a run
    imports: tuple[str, ...] = ()  # modules or files (.py) that register what is not installed

    @field_validator("statistics")
    @classmethod
    def _known(cls, names: tuple[str, ...], info: ValidationInfo) -> tuple[str, ...]:
        known = statistics_of(info.data.get("task", ""))
        for name in names:
            if name not in known:
                raise ValueError(f"there is no statistic {name!r}: {did_you_mean(name, known)}")
        return names

    @property
    def judgements(self) -> tuple[EvalSet, ...]:
        """All that is judged on, sweeps included."""
        return (*self.eval_set, *(sweep.eval_set(value) for sweep in self.sweeps for value in sweep.at))

    @model_validator(mode="after")
    def _is_told_apart(self) -> Study:
        names = [judged.name for judged in self.judgements]
        if twice := next((name for name in names if names.count(name) > 1), None):
            raise ValueError(f"two things that are judged on are called {twice!r}: give each a name of its own")
        for ratio in self.ratios:
            for method in (ratio.method, ratio.against):
                if method not in self.methods:
                    raise ValueError(f"a ratio is of no method {method!r}: {did_you_mean(method, self.methods)}")
        return self

    @model_validator(mode="after")
    def _reaches_its_marks(self) -> Study:
        learning = [method.learner for method in self.methods.values() if method.policy == LEARNED]
        lasting = [
            learner.episodes or self.learner.episodes or max(self.after_episodes, default=0) for learner in learning
        ]
        if beyond := [mark for mark in self.after_episodes if lasting and mark > max(lasting)]:
            raise ValueError(
                f"no method learns as long as the mark {beyond[0]}: leave it out, or give more than {max(lasting)} "
                "learner episodes"
            )
        return self

    def part_name(self, chosen: Study) -> str | None:
        """What the table of a part of this study is called; None for all of it, which has the study's own name."""
        methods = [] if chosen.methods.keys() == self.methods.keys() else list(chosen.methods)
        seeds = [] if chosen.seeds == self.seeds else [str(seed) for seed in chosen.seeds]
        return "-".join([self.name, *methods, *seeds]) if methods or seeds else None

    def only(self, methods: Sequence[str] | None = None, seeds: Sequence[int] | None = None) -> Study:
        """The same study with some of its methods, or with other seeds.

        Raises:
            InputError: for a method that it doesn't have.
        """
        chosen = self.methods if methods is None else {}
        for name in methods or ():
            if name not in self.methods:
                raise InputError(f"the study {self.name} has no method {name!r}: {did_you_mean(name, self.methods)}")
            chosen[name] = self.methods[name]
        return self.model_copy(update={"methods": chosen, "seeds": tuple(self.seeds if seeds is None else seeds)})


def load_study(file: Path | str) -> Study:
    """Read a study's YAML file.

    Args:
        file: Path of the file.

    Raises:
        InputError: If there is no such file, or its content is not a valid study.
    """
    path = Path(file)
    if not path.is_file():
        raise InputError(f"there is no file {path}: name a study's YAML file")
    data = load_yaml(path, "study")
    if not isinstance(data, dict):
        raise InputError(f"{path} is no study: it needs at least name, task, methods and seeds")
    try:
        return Study.model_validate(data)
    except ValidationError as error:
        raise InputError(f"{path}: {_sentence(error)}") from error


def _sentence(error: ValidationError) -> str:
    """What is wrong first, where, and what it may be."""
    first = error.errors()[0]
    where = ", ".join(str(part) for part in first["loc"])
    if first["type"] == "extra_forbidden":
        kinds = (Study, Method, LearnerChoice, EvalSet, Sweep, Ratio)
        known = {name for kind in kinds for name in kind.model_fields}
        return f"{where} is nothing that a study has: {did_you_mean(str(first['loc'][-1]), known)}"
    if first["type"] == "value_error":
        return str(first["ctx"]["error"])
    return f"{where}: {first['msg'][:1].lower()}{first['msg'][1:]}, not {first['input']!r}"[:300]
