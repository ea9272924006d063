"""Typer application of the `guiderail` command: shared arguments, their parsing, and printed results."""

import json
import math
import re
import sys
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import MISSING, dataclass, fields, is_dataclass
from importlib import import_module
from inspect import Parameter, Signature, signature
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, get_type_hints

import typer
import typer.core

from guiderail.models.common.errors import InputError
from guiderail.models.common.registry import find_plugins

SEED = 1_000_000  # default seed of the first held-out episode
COLUMN = 19  # width of a value in a table with several columns [characters]


def print_message(sentence: str) -> None:
    """Print a message on standard error."""
    print(f"guiderail: {sentence}", file=sys.stderr, flush=True)


def print_progress(text: str) -> None:
    """Print a line on standard output at once."""
    print(text, flush=True)


def to_json(result: Mapping[str, Any]) -> str:
    """Return a result as JSON, with null for NaN and infinite numbers, which JSON does not have."""
    text = json.dumps(dict(result), default=_plain)
    return json.dumps(json.loads(text, parse_constant=lambda name: None))


def _plain(value: Any) -> Any:
    """Convert a mapping, NumPy number or NumPy array to an object that JSON can represent; anything else to text."""
    if isinstance(value, Mapping):
        return dict(value)
    return value.tolist() if hasattr(value, "tolist") else str(value)


def print_result(result: Mapping[str, Any], as_json: bool, space: str = " ") -> None:
    """Print a result as one JSON object, or as a table with a column for every baseline policy in `baselines`.

    Args:
        result: Values by name.
        as_json: Print JSON.
        space: Text that replaces an underscore in the names of the values, except in JSON.
    """
    if as_json:
        typer.echo(to_json(result))
        return
    from guiderail.tools.evaluation.metrics import STATISTICS, SYMBOLS, VIOLATION, violation_text
    from guiderail.tools.tables import cell

    def text_of(key: str, value: Any) -> str:
        is_violation = units.get(key) == VIOLATION and isinstance(value, float)
        return violation_text(value, cell(value)) if is_violation else cell(value)

    columns = [*result.get("baselines", ())]
    labels = {key: key if " " in key else key.replace("_", space) for key in result}
    units = {key: STATISTICS[key].unit for key in {*result} & {*STATISTICS}}
    labels |= {key: f"{labels[key]} [{unit}]" for key, unit in units.items() if unit in SYMBOLS}
    width = max(len(label) for label in labels.values())
    if columns:
        titles = ["policy", *("demonstration alone" if name == "demonstration" else name for name in columns)]
        typer.echo("  ".join([" " * width, *(f"{title:<{COLUMN}}" for title in titles)]).rstrip())
    for key, value in result.items():
        if key == "baselines" or any(
            key.startswith(f"{name}_") and key.removeprefix(f"{name}_") in result
            for name in (*columns, "demonstration")
        ):
            continue
        values = [value, *(result[f"{name}_{key}"] for name in columns if f"{name}_{key}" in result)]
        cells = [text_of(key, entry) for entry in values]
        typer.echo("  ".join([f"{labels[key]:<{width}}", *(f"{text:<{COLUMN}}" for text in cells)]).rstrip())


# Commands import their tools when they are called, because PyTorch and Drake take seconds to import.

app = typer.Typer(pretty_exceptions_enable=False, rich_markup_mode=None)


def _names(place: str) -> Callable[[], list[str]]:
    """Return a function that lists names: those of a registry or collection, or those that a function returns.

    `place` is "module:attribute".
    """

    def list_names() -> list[str]:
        module, _, attribute = place.partition(":")
        value = getattr(import_module(module), attribute)
        value = getattr(value, "names", value)
        return list(value() if callable(value) else value)

    return list_names


REGISTRIES = {
    "tasks": "guiderail.diagrams.tasks.registry:TASKS",
    "guidance": "guiderail.diagrams.guidance.registry:GUIDANCE",
    "stations": "guiderail.diagrams.stations.registry:STATIONS",
    "robots": "guiderail.models.robots.robot:ROBOTS",
    "kernels": "guiderail.models.primitives.kernels:KERNELS",
    "learners": "guiderail.tools.learning.learner:LEARNERS",
} | {name: point.value for name, point in find_plugins("registry")}
"""Module and name of each registry that `guiderail list` prints; siblings add theirs as plug-ins of this kind."""

LISTED: dict[str, Callable[[], list[str]]] = {
    **{key: _names(place) for key, place in REGISTRIES.items()},
    "tasks": _names("guiderail.diagrams.tasks.registry:known_tasks"),
    "presets": _names("guiderail.tools.learning.learner_config:PRESETS"),
}
"""Lists that `guiderail list` prints, by name."""


def find_broken(key: str) -> dict[str, str]:
    """Return the unusable entry points of a list in `LISTED`: error message by name."""
    if key not in REGISTRIES:
        return {}
    module, _, attribute = REGISTRIES[key].partition(":")
    return dict(getattr(import_module(module), attribute).broken)


CHOICES: dict[str, Callable[[], list[str]]] = LISTED | {
    "log_formats": _names("guiderail.tools.learning.learner:LOG_FORMATS"),
    "pictures": _names("guiderail.tools.files:PICTURES"),
    "videos": _names("guiderail.tools.files:VIDEOS"),
    "baselines": _names("guiderail.tools.evaluation.baselines:BASELINES"),
    "pretrained": _names("guiderail.tools.pretrained:pretrained_names"),
    "listed": lambda: [*LISTED, *LISTED["tasks"]()],
}
"""Choices that `{name}` in a help text expands to, and that a shell completes."""


class Command(typer.core.TyperCommand):
    """Command whose help text expands `{name}` to the choices that exist when the help is printed.

    An empty argument is refused, because as a path it would be the current folder. An option that takes one value is
    refused if it is given twice with different values.
    """

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the arguments; raise an `InputError` if an argument is empty, or an option is given twice."""
        for before, word in pairwise(["", *args]):
            option = before if word == "" else word.removesuffix("=") if re.fullmatch("--[^=]+=", word) else None
            if option is not None:
                name = option if option.startswith("--") else "an argument"
                raise InputError(f"{name} is empty: give a value, or leave it out")
        for parameter in self.params:
            _refuse_repetition(parameter, args)
        return super().parse_args(ctx, args)

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Expand the choices, then format the options."""
        for parameter in self.params:
            if text := getattr(parameter, "help", None):
                parameter.help = expand_choices(text)  # type: ignore[attr-defined]
        super().format_options(ctx, formatter)


def _refuse_repetition(parameter: Any, words: Sequence[str]) -> None:
    """Raise an InputError if an option that takes one value has two values, or a switch is given on and off."""
    on, off = set(parameter.opts), set(parameter.secondary_opts)
    if parameter.param_type_name != "option" or parameter.multiple:
        return
    words = words[: words.index("--")] if "--" in words else words
    if parameter.is_flag:
        if on.intersection(words) and off.intersection(words):
            raise InputError(f"{parameter.opts[0]} and {parameter.secondary_opts[0]} contradict each other: give one")
        return
    values = option_values(words, on)
    for value in values[1:]:
        check_same(parameter.opts[0], values[0], value)


def option_values(words: Sequence[str], names: Collection[str]) -> list[str]:
    """Return the values of an option in their order, given as `--option value` or `--option=value` by its `names`."""
    return [
        word.partition("=")[2] if "=" in word else following
        for word, following in pairwise([*words, ""])
        if word.partition("=")[0] in names
    ]


def expand_choices(text: str) -> str:
    """Return a help text in which every `{name}` of `CHOICES` is replaced by its choices, comma-separated."""
    for name, list_names in CHOICES.items():
        if f"{{{name}}}" in text:
            text = text.replace(f"{{{name}}}", ", ".join(list_names()))
    return text


def command(
    example: str, name: str | None = None, group: typer.Typer = app
) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Return a decorator that registers a function as a command of a group.

    `name` is the function's name by default. `example` is a command line without `guiderail`. A parameter that is a
    dataclass of options stands for the options that are its fields.
    """
    register = group.command(name, cls=Command, epilog=f"Example: guiderail {example}")

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        register(_with_single_options(function))
        return function

    return decorate


def _with_single_options(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function that takes each field of a dataclass among the parameters as a parameter of its own."""
    hints = get_type_hints(function, include_extras=True)
    groups: dict[str, Any] = {name: hint for name, hint in hints.items() if is_dataclass(hint)}
    parameters: dict[str, Parameter] = {}
    for parameter in signature(function).parameters.values():
        kind: Any = groups.get(parameter.name)
        if kind is None:
            parameters[parameter.name] = parameter.replace(annotation=hints[parameter.name])
            continue
        annotations = get_type_hints(kind, include_extras=True)
        for field in fields(kind):
            default = Parameter.empty if field.default is MISSING else field.default
            annotation = annotations[field.name]
            parameters[field.name] = Parameter(field.name, parameter.kind, default=default, annotation=annotation)

    def call(**values: Any) -> Any:
        for name, kind in groups.items():
            values[name] = kind(**{field.name: values.pop(field.name) for field in fields(kind)})
        return function(**values)

    ordered = sorted(parameters.values(), key=lambda parameter: parameter.default is not Parameter.empty)
    call.__signature__ = Signature(ordered)  # type: ignore[attr-defined]
    call.__annotations__ = {name: parameter.annotation for name, parameter in parameters.items()}
    call.__name__, call.__doc__, call.__module__ = function.__name__, function.__doc__, function.__module__
    return call


def command_group(name: str, text: str) -> typer.Typer:
    """Return a new group of commands, such as `guiderail dataset`, with its help text."""
    group = typer.Typer(help=text, rich_markup_mode=None)
    app.add_typer(group, name=name)
    return group


def option(text: str, *names: str, choices: str | None = None, **more: Any) -> Any:
    """Return an option with its help text; `choices` is the key in `CHOICES` for shell completion."""
    return typer.Option(*names, help=text, autocompletion=_completion(choices), **more)


def argument(text: str, metavar: str, choices: str | None = None) -> Any:
    """Return an argument with its help text; `choices` is the key in `CHOICES` for shell completion."""
    return typer.Argument(help=text, metavar=metavar, autocompletion=_completion(choices))


def _completion(choices: str | None) -> Callable[[str], list[str]] | None:
    if choices is None:
        return None
    return lambda incomplete: [name for name in CHOICES[choices]() if name.startswith(incomplete)]


Json = Annotated[bool, option("Print one JSON object.", "--json")]
Subject = Annotated[
    str,
    argument(
        "Folder of a run, or pretrained:NAME ({pretrained}); a policy of any origin, with --task; or a task, with "
        "--policy: {tasks}.",
        "RUN|POLICY|TASK",
    ),
]
Seed = Annotated[int, option("Seed of the first held-out episode; episode i has seed + i.")]
Env = Annotated[
    list[str] | None,
    option(
        "Option of the environment, such as station=arm or action_dims=[0,1,2]; repeatable. "
        "guiderail list TASK lists them.",
        "--env",
        metavar="key=value",
    ),
]


def import_option(content: str) -> Any:
    """Return the option --import for modules that register `content`."""
    return option(f"Module or file (.py) that registers {content}.", "--import", metavar="MODULE")


Imports = Annotated[
    list[str] | None,
    import_option("a task, guidance, a station or a learner; a run stores the module's name or the file's path"),
]
TaskImports = Annotated[list[str] | None, import_option("the task")]


def _trust(context: typer.Context, value: bool) -> bool:
    """If the option is given, allow a file's imports until the command ends; return the option's value."""
    if value:
        from guiderail.tools.imports import trust_imports

        context.with_resource(trust_imports())
    return value


TrustImports = Annotated[
    bool,
    option(
        "Execute the modules and files that config.yaml or a study names under imports. By default they are refused.",
        "--trust-imports",
        callback=_trust,
    ),
]
Guidance = Annotated[
    str | None, option("Guidance: {guidance}.  [default: that of the task or run]", choices="guidance")
]
Station = Annotated[str | None, option("Station: {stations}.  [default: that of the task or run]", choices="stations")]
Algorithm = Annotated[str | None, option("Learning algorithm: {learners}.  [default: the task's]", choices="learners")]
Preset = Annotated[str | None, option("Settings of the learner: {presets}.  [default: the task's]", choices="presets")]
Settings = Annotated[
    list[str] | None,
    option("Setting of the learner, such as batch_size=128; repeatable.", "--set", metavar="name=value"),
]
WriteStepLog = Annotated[
    bool | None,
    option("Write every control step into the run's steps/.  [default: yes]", "--step-log/--no-step-log"),
]
Baselines = Annotated[
    str | None,
    option(
        "Baseline policies that are evaluated on the same episodes, comma-separated: scripted, {baselines}; or none. "
        "If the guidance has a demonstration, the demonstration alone is always evaluated; it equals the policy zero.  "
        "[default: uniform_random, constant (only in evaluate), scripted (if the task has such a policy), and zero (if "
        "there is no demonstration)]"
    ),
]
PolicyTask = Annotated[str | None, option("Task that a POLICY without a run acts in: {tasks}.", choices="tasks")]
PolicyTasks = Annotated[
    list[str] | None,
    option(
        "Task that a POLICY without a run acts in: {tasks}; repeatable, to evaluate it in each.",
        "--task",
        choices="tasks",
    ),
]
TrustPolicy = Annotated[
    bool,
    option(
        "Read a policy from a file that can execute code: a .zip of Stable-Baselines3 or TorchScript.", "--trust-policy"
    ),
]
Processes = Annotated[
    int | None,
    option("Largest number of processes; results do not depend on it.  [default: the number of cores]"),
]


@dataclass(frozen=True)
class EnvironmentOptions:
    """Options of the environment of train and evaluate."""

    env: Env = None
    guidance: Guidance = None
    difficulty: Annotated[str | None, option("Difficulty: standard or hard, if the task has one.")] = None
    action_repeat: Annotated[int | None, option("Control steps per action.")] = None
    reward: Annotated[
        str | None,
        option("Reward, such as sparse, shaped, aligned or hand_shaped; guiderail list TASK lists those of a task."),
    ] = None
    observation: Annotated[
        str | None,
        option("Observation, such as state, center_of_pressure or image; guiderail list TASK lists those of a task."),
    ] = None
    fixture_offset: Annotated[
        str | None, option("When the offset of the fixture is sampled: per_run, per_episode or none.")
    ] = None
    station: Station = None

    def parse(self) -> dict[str, Any]:
        """Return the options of the environment that are given; see `parse_environment`."""
        return parse_environment(**vars(self))


@dataclass(frozen=True)
class RunOptions:
    """Options of a run that is trained in simulation or on a robot."""

    out: Annotated[Path | None, option("Folder of the run; it must not exist, except with --resume.")] = None
    algorithm: Algorithm = None
    episodes: Annotated[
        int | None,
        option("Total number of episodes; --resume can change it, but not below the episodes done.  [default: 60]"),
    ] = None
    seed: Annotated[int | None, option("Seed of all random numbers.  [default: 0]")] = None
    preset: Preset = None
    setting: Settings = None
    step_log: WriteStepLog = None
    resume: Annotated[bool, option("Resume the run in --out.", "--resume")] = False
    imports: Imports = None
    trust_imports: TrustImports = False
    as_json: Json = False

    @property
    def folder(self) -> Path:
        """Folder of the run; an InputError if none is given."""
        if self.out is None:
            raise InputError("the run needs a folder: name one with --out RUN")
        return self.out

    def choices(self) -> dict[str, Any]:
        """Return what is chosen of the run, by the names of `guiderail.tools.learning.run_folder.Choices`."""
        values = {name: getattr(self, name) for name in ("algorithm", "preset", "episodes", "seed", "step_log")}
        settings = parse_pairs(self.setting, "--set", "batch_size=128")
        return {name: value for name, value in {**values, "settings": settings}.items() if value is not None}


def parse_pairs(given: list[str] | None, option: str, example: str) -> dict[str, str]:
    """Return the `key=value` pairs of a repeated option as a dictionary; `example` is a valid pair, for the message."""
    pairs: dict[str, str] = {}
    for pair in given or []:
        if "=" not in pair:
            raise InputError(f"{option} takes name=value, such as {example}, not {pair!r}")
        name, value = (part.strip() for part in pair.split("=", 1))
        check_same(name, pairs.setdefault(name, value), value)
    return pairs


def check_same(name: str, value: Any, other: Any) -> None:
    """Raise an InputError if an option that was given twice has two values."""
    if value != other:
        raise InputError(f"{name} is given as {value} and as {other}: give it once")


def parse_floats(text: str, count: int, option: str) -> list[float]:
    """Return `count` finite numbers from a comma-separated list."""
    from guiderail.models.common.arrays import parse_number

    try:
        numbers = [parse_number(number) for number in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != count or not all(map(math.isfinite, numbers)):
        raise InputError(f"{option} takes {count} numbers separated by commas, not {text!r}")
    return numbers


def parse_integers(text: str | None, option: str) -> list[int] | None:
    """Return integers from a comma-separated list; None for None."""
    if text is None:
        return None
    if not re.fullmatch(r"\s*[-+]?[0-9]{1,18}\s*(,\s*[-+]?[0-9]{1,18}\s*)*", text):
        raise InputError(f"{option} takes whole numbers separated by commas, such as 0,1, not {text!r}")
    return [int(number) for number in text.split(",")]


def parse_environment(env: list[str] | None, **options: Any) -> dict[str, Any]:
    """Return the options of an environment: values of `--env`, read as YAML, and all `options` that are not None."""
    environment = {name: value for name, value in options.items() if value is not None}
    if env:
        from guiderail.tools.environments import as_value

        pairs = parse_pairs(env, "--env", "station=arm")
        for name, value in ((name, as_value(text)) for name, text in pairs.items()):
            check_same(name, environment.setdefault(name, value), value)
    return environment


def import_files(imports: Sequence[str] | None) -> None:
    """Import the modules and files that are given by `--import`."""
    if imports:
        from guiderail.tools.imports import import_modules

        import_modules(imports)


def find_task(name_or_folder: str, imports: Sequence[str] | None = None) -> tuple[str, tuple[str, ...]]:
    """Import modules, and register the task if it is given by its folder.

    Returns:
        Name of the task, and the imports that a run must store. A text that is no folder is returned unchanged.
    """
    import_files(imports)
    if not (Path(name_or_folder) / "task.yaml").is_file():
        return name_or_folder, ()
    from guiderail.tools.environments import task_named

    return task_named(name_or_folder)


def refuse_robot(station: Any, remedy: str) -> None:
    """Raise an InputError that names the remedy if `station` is a real robot."""
    if station is None:
        return
    stations = import_module("guiderail.diagrams.stations.registry").STATIONS
    if station in stations.names() and not stations.get(station).is_simulated:
        raise InputError(f"station={station} is a real robot, which a reset cannot move: use {remedy}")


def split_names(names: str | None) -> list[str] | None:
    """Split comma-separated names of baseline policies; "none" is an empty list, and None means the default set."""
    if names is None:
        return None
    return [] if names == "none" else [name.strip() for name in names.split(",")]
