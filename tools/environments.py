"""Tasks by name: the one place where tools ask which there are and what they take."""

import hashlib
import inspect
import sys
import traceback
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from importlib import import_module
from importlib.util import find_spec, module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any, cast

import gymnasium
from gymnasium.envs.registration import load_env_creator
from threadpoolctl import threadpool_limits

from guiderail.diagrams.envs.options import Options, validate_options
from guiderail.diagrams.stations.registry import STATIONS
from guiderail.diagrams.tasks.registry import TASKS, environment_id, is_task_folder, register_task_folder
from guiderail.models.common.errors import InputError, brief
from guiderail.models.common.registry import did_you_mean
from guiderail.models.common.yaml import parse_yaml

_IMPORTED: dict[Path, bytes] = {}
"""What each file said when it was imported."""
IMPORTED = ", or --import the file that registers it"  # how a name is found that nothing installed has


def known_tasks() -> list[str]:
    """The tasks that there are: those that are declared, and environments that somebody registered as guiderail's."""
    registered = (spec.name for spec in gymnasium.registry.values() if spec.namespace == "guiderail")
    return sorted({*TASKS.names(), *registered})


def import_modules(modules: Iterable[str]) -> tuple[str, ...]:
    """Imports modules or files (.py) that register tasks, guidance, stations or learners; returns how to name them.

    A task folder, which `guiderail onboard` makes, counts as one. A file or a folder is named by its absolute path, so
    that whoever goes on with a run elsewhere on the machine finds it.

    Raises:
        InputError: if there is no such module or file, or it can't be imported.
    """
    names = []
    for module in modules:
        path = Path(module)
        if is_task_folder(path):
            register_task_folder(path)
            names.append(str(path.resolve()))
        elif path.suffix == ".py" and path.is_file():
            names.append(_import_file(path))
        elif _is_module(module):
            names.append(_imported(module, partial(import_module, module)).__name__)
        else:
            raise InputError(f"--import takes a module or a file (.py), and there is none for {brief(module)}")
    return tuple(names)


def task_named(typed: str) -> tuple[str, tuple[str, ...]]:
    """A task's name for what a person typed, its own name or a task folder's path, and what a run has to import for it.

    Raises:
        InputError: if something in the folder makes no sense.
    """
    if typed in TASKS.names() or not is_task_folder(typed):
        return typed, ()
    name = register_task_folder(typed)
    return name, (str(Path(typed).resolve()),)


def task_content(task: str, environment: Mapping[str, Any], imports: Iterable[str]) -> str:
    """A digest of the files that a task is made of, as they are now; empty where there are none but installed ones.

    Args:
        task: its name.
        environment: its options: of those that name a file, such as demonstrations, the file counts.
        imports: what registers it, as `import_modules` names it: of files, what they say counts.

    Raises:
        InputError: if it is of a folder that is none any more, or a file cannot be read.
    """
    folder = getattr(TASKS.get(task), "folder", None) if task in TASKS.names() else None
    told = ""
    if folder is not None:
        from guiderail.diagrams.tasks.part.file import task_folder_digest  # Drake takes a second

        told = task_folder_digest(folder)
    named = [*imports, *(value for _, value in sorted(environment.items()) if isinstance(value, str))]
    files = [path for path in map(Path, named) if path.is_absolute() and folder not in path.parents and path.is_file()]
    if not files:
        return told
    digest = hashlib.blake2b(told.encode(), digest_size=16)
    for file in files:
        digest.update(_read(file))
    return digest.hexdigest()


def _read(file: Path) -> bytes:
    try:
        content = file.read_bytes()
    except OSError as error:
        raise InputError(f"{file} cannot be read ({error.strerror}): restore it") from error
    return len(content).to_bytes(8, "big") + content


def _is_module(name: str) -> bool:
    """Whether there is a module of that name; one whose package can't be imported is there."""
    try:
        return find_spec(name) is not None
    except ModuleNotFoundError as error:
        return not f"{name}.".startswith(f"{error.name}.")
    except (ImportError, ValueError, TypeError):  # no name at all, or a relative one
        return False


def _import_file(path: Path) -> str:
    """Runs a file, which finds those beside it as a program would; once, as long as it stays what it is."""
    path = path.resolve()
    content = path.read_bytes()
    if _IMPORTED.get(path) == content:
        return str(path)
    name = f"guiderail_imported_{path.stem}"
    spec = spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    module = sys.modules[name] = module_from_spec(spec)
    beside = str(path.parent)
    sys.path.insert(0, beside)
    try:
        _imported(path.name, partial(spec.loader.exec_module, module))
    finally:
        sys.path.remove(beside)
    _IMPORTED[path] = content
    return str(path)


def _imported(what: str, load: Callable[[], Any]) -> Any:
    """What is imported; whatever is wrong in it gets a sentence with its place."""
    try:
        return load()
    except InputError:
        raise
    except Exception as error:
        place = traceback.extract_tb(error.__traceback__)[-1]
        where = f"{Path(place.filename).name}, line {place.lineno}: " if place.filename.endswith(".py") else ""
        words = " ".join(str(error).split())
        raise InputError(f"importing {what} failed: {where}{type(error).__name__}: {words}") from error


def task_options(task: str) -> dict[str, Any]:
    """What a task's environment takes, with its defaults; `inspect.Parameter.empty` where it has none.

    Raises:
        InputError: for an unknown task.
    """
    if task in TASKS.names():
        return check_environment(task, {})
    if task not in known_tasks():
        raise InputError(f"there is no task {brief(task)}: {did_you_mean(task, known_tasks(), IMPORTED)}")
    entry = gymnasium.spec(environment_id(task)).entry_point
    creator = load_env_creator(entry) if isinstance(entry, str) else cast(Any, entry)
    taken = inspect.signature(creator).parameters.items()
    return {name: parameter.default for name, parameter in taken if name not in ("self", "render_mode")}


def check_environment(task: str, arguments: Mapping[str, Any]) -> dict[str, Any]:
    """The arguments of a task's environment, its defaults filled in.

    Raises:
        InputError: for an unknown task, or an argument that it does not take.
    """
    if task in TASKS.names():
        from guiderail.diagrams.envs.config import EnvConfig  # Drake takes a second, and a list of names should not

        return EnvConfig.resolve(task, arguments).options
    options = task_options(task)
    for name, value in arguments.items():
        if name not in options:
            raise InputError(f"{task} has no option {brief(name)}: {did_you_mean(name, options)}")
        if not _is_like(value, options[name]):
            raise InputError(f"{task}'s {name} cannot be {brief(value)}: give a value such as {options[name]!r}")
    given = {name: arguments.get(name, default) for name, default in options.items()}
    return {name: value for name, value in given.items() if value is not inspect.Parameter.empty}


def check_reset(task: str, options: Mapping[str, Any]) -> None:
    """Refuses options that no reset of a task takes; of an environment that is no task's, whatever it takes is its own.

    Raises:
        InputError: for an unknown option, or a value of another kind or out of range.
    """
    if task in TASKS.names():
        validate_options(TASKS.get(task).Reset, options, f"a reset of {task}")


def beyond_defaults(task: str, environment: Mapping[str, Any]) -> dict[str, Any]:
    """Those of an environment's arguments that it would not have anyway.

    Args:
        task: its name.
        environment: all of its arguments.

    Returns:
        Guidance, station and difficulty that are not the task's own, and what differs from what these three stand for.

    Raises:
        InputError: for an unknown task, or if one of the three is unknown.
    """
    chosen = {key: environment[key] for key in ("guidance", "station", "difficulty") if key in environment}
    usual = check_environment(task, chosen) | {key: check_environment(task, {}).get(key) for key in chosen}
    unlike = object()
    return {key: value for key, value in environment.items() if usual.get(key, unlike) != value}


def changed_environment(task: str, environment: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """A run's arguments of its environment, with others in their place.

    Another difficulty is other settings: those that the run has of its own difficulty alone make way for them. Another
    station has no options of the run's station that it doesn't know.

    Args:
        task: the run's.
        environment: all of its arguments.
        changes: the others.

    Raises:
        InputError: if there is no such difficulty.
    """
    gone = _of_the_station_alone(environment.get("station"), changes.get("station"))
    environment = {key: value for key, value in environment.items() if key not in gone}
    own = environment.get("difficulty")
    if changes.get("difficulty", own) == own:
        return {**environment, **changes}
    return check_environment(task, {**beyond_defaults(task, environment), **changes})


def _of_the_station_alone(own: Any, other: Any) -> set[str]:
    """The options that a station has and another one doesn't."""
    if other in (None, own) or not {own, other} <= {*STATIONS.names()}:
        return set()
    mine, its = ((STATIONS.get(name).options or Options).model_fields for name in (own, other))
    return {*mine} - {*its}


def _is_like(value: Any, default: Any) -> bool:
    """Whether a value has the type of a default, as far as that says anything."""
    if default is None or default is inspect.Parameter.empty:
        return True
    if isinstance(default, float):
        return isinstance(value, int | float) and not isinstance(value, bool)
    if isinstance(default, tuple):
        return isinstance(value, tuple | list)
    return isinstance(value, type(default)) and isinstance(value, bool) == isinstance(default, bool)


def as_value(text: str) -> Any:
    """A typed value: what YAML reads; what is no YAML is a word."""
    try:
        return _numbers(parse_yaml(text))
    except InputError:
        return text


def _numbers(value: Any) -> Any:
    if isinstance(value, list):
        return tuple(_numbers(one) for one in value)
    try:
        return float(value) if isinstance(value, str) else value
    except ValueError:
        return value


def make_environment(task: str, arguments: Mapping[str, Any], render_mode: str | None = None) -> gymnasium.Env:
    """The environment of a task. From here on this process calculates with one thread.

    Matrices are small here. Where another process wants the cores too, threads that wait for each other take eighty
    times as long (a movement primitive with a history: 78 s for 1), and sums would depend on how many there are.

    Raises:
        InputError: for an unknown task or argument, or a pairing that makes no sense.
    """
    threadpool_limits(1)
    arguments = check_environment(task, arguments)
    return gymnasium.make(environment_id(task), disable_env_checker=True, render_mode=render_mode, **arguments)
