"""Protocol of the benchmark, its methods, and the studies that they are run as.

A protocol is a data file with a version. It fixes the tasks, their options, the budgets of episodes and the seeds, and
names the options that a method may choose. A changed protocol has another version, so that results stay comparable.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, ValidationError, model_validator

from guiderail.diagrams.tasks.registry import TASKS, content_digest
from guiderail.models.common.errors import InputError, brief
from guiderail.models.common.registry import did_you_mean
from guiderail.models.common.yaml import load_yaml
from guiderail.tools.environments import flat_environment, task_named
from guiderail_studies.declaration import (
    LEARNED,
    EvalSet,
    FolderName,
    Integer,
    LearnerChoice,
    Method,
    Seed,
    Seeds,
    Strict,
    Study,
    sentence,
)

PROTOCOLS, METHODS, PARTS = (Path(__file__).parent / name for name in ("protocols", "methods.yaml", "parts"))
EVALUATED_FILE = "evaluated.csv"  # file of the evaluated episodes in a run's folder
FLOORS = {"scripted": "", "uniform_random": "uniform_random", "constant": "constant", "demonstration": "zero"}
"""Policies without learning by name; the scripted policy is named by the task."""
_PLAIN_NAME = re.compile(r"\w[\w.-]*")
Rate = Annotated[float, Field(ge=0, le=1)]


class ProtocolTask(Strict):
    """Task of a protocol."""

    task: str  # registered name, or name of a folder in `PARTS`
    description: str  # one sentence
    env: dict[str, Any]  # options of the environment that are fixed
    episodes: Integer = Field(ge=1)  # training episodes of a run
    core_seconds: float = Field(gt=0)  # CPU time of a run of the reference method with its evaluation [s]
    floor_env: dict[str, Any]  # options that the policies without learning choose
    scripted: str  # name of the scripted policy
    reset: dict[str, Any] = Field(default_factory=dict)  # options of the resets of the policies without learning
    floors: dict[str, Rate] = Field(
        default_factory=dict
    )  # measured success rates of the policies without learning, by name


class Protocol(Strict):
    """Protocol: what is fixed, what a method may choose, and how results are measured."""

    version: Integer
    reference: FolderName  # method that others are compared with
    seeds: Seeds  # seeds of training
    episodes: Integer = Field(ge=1)  # held-out episodes of each run
    first_seed: Seed  # seed of the first held-out episode; episode i has first_seed + i
    floor_episodes: Integer = Field(ge=1)  # episodes of each policy without learning
    max_random: Rate  # largest success rate of uniform random actions in a task
    min_scripted: Rate  # smallest success rate of the scripted policy in a task
    choices: tuple[str, ...]  # options of the environment that a method may choose, without those of structured entries
    tasks: dict[FolderName, ProtocolTask] = Field(min_length=1)

    def select(self, names: Sequence[str] | None) -> list[str]:
        """Return names of tasks, all by default; raise an InputError if a name is unknown."""
        for name in names or ():
            if name not in self.tasks:
                raise InputError(f"protocol {self.version} has no task {name!r}: {did_you_mean(name, self.tasks)}")
        return list(self.tasks) if names is None else list(dict.fromkeys(names))

    def resolve_task(self, name: str) -> tuple[str, tuple[str, ...]]:
        """Return the registered name of a task and the imports that it needs.

        Raises:
            InputError: If the task is a part, and guiderail-parts is not installed.
        """
        folder = PARTS / self.tasks[name].task
        return task_named(str(folder) if folder.is_dir() else self.tasks[name].task)

    def check_choices(self, name: str, env: Mapping[str, Any]) -> dict[str, Any]:
        """Return the options that a method chooses, with entries of structured options as options.

        Raises:
            InputError: If an option is fixed by the protocol or is not among its choices, or a value is a path: an
                environment is described by values alone.
        """
        task, fixed = self.resolve_task(name)[0], self.tasks[name].env
        fixed_names = {*flat_environment(task, fixed)}
        flat = flat_environment(task, env)
        for option, value in flat.items():
            if option in fixed_names:
                raise InputError(f"protocol {self.version} fixes the option {option} of {name}: leave it out")
            if option.partition(".")[0] not in self.choices:
                raise InputError(
                    f"protocol {self.version} does not let a method choose {brief(option)}: its choices are "
                    f"{', '.join(self.choices)}"
                )
            if not _is_plain(value):
                raise InputError(f"{option} of {name} is a name, a number or a list of them, not {brief(value)}")
        return flat

    def task_digest(self, name: str) -> str:
        """Return the digest of everything in the protocol that the results on a task depend on."""
        task = self.tasks[name].model_dump(include={"task", "env", "episodes"})
        common = self.model_dump(mode="json", include={"version", "episodes", "first_seed"})
        content = content_digest(TASKS.get(self.resolve_task(name)[0]))
        text = json.dumps([common, task, content], sort_keys=True)
        return hashlib.blake2b(text.encode(), digest_size=8).hexdigest()


def _is_plain(value: Any) -> bool:
    if isinstance(value, str):
        return bool(_PLAIN_NAME.fullmatch(value)) and not value.endswith(".py")
    if isinstance(value, list | tuple):
        return all(map(_is_plain, value))
    return value is None or isinstance(value, bool | int | float)


class TaskChoice(Strict):
    """Choices of a method for one task, in addition to those for all tasks."""

    env: dict[str, Any] = Field(default_factory=dict)
    learner: LearnerChoice = LearnerChoice()


class BenchmarkMethod(Strict):
    """Method of the benchmark: options of the environment and a learner.

    A task that `tasks` does not name is run with the choices for all tasks.
    """

    name: FolderName  # name in the tables
    description: str = Field("", max_length=300)  # one sentence
    env: dict[str, Any] = Field(default_factory=dict)  # options of the environment that the method chooses
    learner: LearnerChoice = LearnerChoice()  # default: the task's own
    # Choices by task; null: the method does not apply to the task.
    tasks: dict[str, TaskChoice | None] = Field(default_factory=dict)
    cost: float = Field(1.0, gt=0)  # CPU time of a run as a multiple of the reference method's
    # Files or modules that register the learner or the guidance; paths are relative to the working directory.
    imports: tuple[str, ...] = ()

    def environment(self, task: str) -> dict[str, Any]:
        """Return the options of the environment that the method chooses for a task."""
        own = self.tasks.get(task)
        return self.env | (own.env if own is not None else {})

    def applies(self, task: str) -> bool:
        """Return True if the method is run on a task."""
        return self.tasks.get(task, TaskChoice()) is not None

    def learner_of(self, task: str) -> LearnerChoice:
        """Return the choice of the learner for a task."""
        own = (self.tasks.get(task) or TaskChoice()).learner
        given = self.learner.model_dump(exclude_unset=True) | own.model_dump(exclude_unset=True)
        settings = self.learner.settings | own.settings
        return LearnerChoice.model_validate(given | ({"settings": settings} if settings else {}))

    @model_validator(mode="after")
    def _check_episodes(self) -> BenchmarkMethod:
        for choice in (self.learner, *(own.learner for own in self.tasks.values() if own is not None)):
            if choice.episodes is not None:
                raise ValueError("the protocol fixes the number of training episodes: leave episodes out")
            if "init_from" in choice.settings:
                raise ValueError("a run of the benchmark starts from no other run: leave init_from out")
        return self


@cache
def load_protocol(version: int | str) -> Protocol:
    """Return the protocol with a version.

    Raises:
        InputError: If there is no protocol with this version.
    """
    file = PROTOCOLS / f"{version}.yaml"
    if file.parent != PROTOCOLS or not file.is_file():
        known = ", ".join(sorted(path.stem for path in PROTOCOLS.glob("*.yaml")))
        raise InputError(f"there is no protocol {brief(version)}: the versions are {known}")
    return Protocol.model_validate(load_yaml(file, "protocol"))


def shipped_methods() -> dict[str, BenchmarkMethod]:
    """Return the methods of this package by name."""
    methods = load_yaml(METHODS, "methods")
    return {name: BenchmarkMethod.model_validate({"name": name, **values}) for name, values in methods.items()}


def check_method_name(method: BenchmarkMethod, source: Path) -> None:
    """Raise an InputError if a method of this package has the same name and other choices.

    The page compares all methods with a method of this package, which it finds by its name.
    """
    shipped, choices = shipped_methods().get(method.name), {"env", "learner", "tasks"}
    if shipped is not None and method.model_dump(include=choices) != shipped.model_dump(include=choices):
        raise InputError(f"{source}: the method {method.name} of this package has other choices: give another name")


def load_method(name_or_file: str) -> BenchmarkMethod:
    """Return a method of this package by name, or read the YAML file of a method.

    Raises:
        InputError: If there is no such method, or the file is not valid, names a task of no protocol, or has the name
            of another method of this package.
    """
    if not name_or_file.endswith((".yaml", ".yml")):
        methods = shipped_methods()
        if name_or_file not in methods:
            hint = did_you_mean(name_or_file, methods, ", or give the YAML file of a method")
            raise InputError(f"there is no method {brief(name_or_file)}: {hint}")
        return methods[name_or_file]
    file = Path(name_or_file)
    if not file.is_file():
        raise InputError(f"there is no file {file}: name the YAML file of a method")
    content = load_yaml(file, "method")
    if not isinstance(content, dict):
        raise InputError(f"{file} is no method: it needs at least name")
    try:
        method = BenchmarkMethod.model_validate({"name": file.stem, **content})
    except ValidationError as error:
        raise InputError(f"{file}: {sentence(error, (BenchmarkMethod, TaskChoice, LearnerChoice))}") from error
    check_method_name(method, file)
    known = {name for path in PROTOCOLS.glob("*.yaml") for name in load_protocol(path.stem).tasks}
    if unknown := sorted(set(method.tasks) - known):
        raise InputError(f"{file}: no protocol has a task {unknown[0]!r}: {did_you_mean(unknown[0], known)}")
    return method


def make_study(
    protocol: Protocol, task: str, methods: Mapping[str, Method], imports: Sequence[str] = (), **changes: Any
) -> Study:
    """Return the study of methods on one task of a protocol; `changes` are further fields of the study."""
    name, own_imports = protocol.resolve_task(task)
    held_out = EvalSet(
        name="held out",
        episodes=protocol.episodes,
        first_seed=protocol.first_seed,
        file=EVALUATED_FILE,
    )
    values = {
        "name": task,
        "task": name,
        "env": protocol.tasks[task].env,
        "methods": methods,
        "seeds": protocol.seeds,
        "eval_set": (held_out,),
        "imports": (*own_imports, *imports),
    }
    return Study.model_validate(values | changes)


def method_study(protocol: Protocol, task: str, method: BenchmarkMethod, seeds: Sequence[int]) -> Study:
    """Return the study of a method on one task.

    Raises:
        InputError: If the method chooses an option that the protocol does not let it choose.
    """
    env = protocol.check_choices(task, method.environment(task))
    learner = method.learner_of(task).model_copy(update={"episodes": protocol.tasks[task].episodes})
    declared = Method(env=env, learner=learner, policy=LEARNED)
    return make_study(protocol, task, {method.name: declared}, method.imports, seeds=tuple(seeds), folder="{seed}")


def floor_study(protocol: Protocol, task: str, episodes: int) -> Study:
    """Return the study of the policies without learning on one task; each episode has other hidden offsets."""
    declared = protocol.tasks[task]
    methods = {
        name: Method(env=declared.floor_env, policy=policy or declared.scripted) for name, policy in FLOORS.items()
    }
    held_out = EvalSet(name="held out", episodes=episodes, first_seed=protocol.first_seed, options=declared.reset)
    return make_study(protocol, task, methods, seeds=(0,), eval_set=(held_out,), folder="{method}")
