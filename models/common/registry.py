"""Plug-ins: one table of names and string targets, for this package, its siblings and installed packages.

`BUILT_IN` has the plug-ins of this package. Another package declares plug-ins in the group "guiderail" of its entry
points, as "KIND:NAME" = "module:attribute":

    [project.entry-points.guiderail]
    "station:mujoco" = "guiderail_mujoco.station:MujocoStation"

The kind learner_config names the class of a learner's settings in a module that does not import PyTorch, so that they
can be checked before this slow import.
"""

import difflib
import logging
import sys
from collections.abc import Callable, Iterable, Iterator
from functools import cached_property, partial
from importlib import import_module, metadata
from importlib.util import find_spec
from inspect import getattr_static, signature
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any, Generic, TypeVar, overload

from guiderail.models.common.errors import InputError, brief, naming_failures

GROUP = "guiderail"  # group of the entry points of all plug-ins
SIBLINGS = {
    "hardware": ("deploy", "train-on-robot", "teleoperate", "sim-driver", "safety-monitor", "station:hardware"),
    "parts": ("create-task", "create-tasks"),
    "studies": ("study", "ensemble", "robustness", "converge", "passport", "certify", "report", "benchmark",
                "learner:ppo"),
    "data": ("dataset", "template"),
    "lerobot": ("learner:bc", "learner:chunk", "learner:distillation", "guidance:base_policy",
                "guidance:kgrl_base_policy", "guidance:residual_base_policy"),
    "mujoco": ("station:mujoco", "station:pybullet", "station:sapien"),
    "cpp": ("export",),
    "calibration": ("calibrate", "probe"),
}  # fmt: skip
"""Commands and named plug-ins of each sibling distribution guiderail-NAME, by NAME, for the line that installs it."""


_DIAGRAMS, _LEARNING, _ROBOTS = "guiderail.diagrams", "guiderail.tools.learning", "guiderail.models.robots"
BUILT_IN = {
    "task:BncConnector": f"{_DIAGRAMS}.tasks.bnc_connector:BncConnector",
    "task:GridClamp": f"{_DIAGRAMS}.tasks.grid_clamp:GridClamp",
    "task:NarrowPassage": f"{_DIAGRAMS}.tasks.narrow_passage:NarrowPassage",
    "task:Pouring": f"{_DIAGRAMS}.tasks.pouring:Pouring",
    "station:arm": f"{_DIAGRAMS}.stations.arm:ArmStation",
    "station:gantry": f"{_DIAGRAMS}.stations.gantry:GantryStation",
    "station:plane": f"{_DIAGRAMS}.stations.plane:PlaneStation",
    "station:pouring": f"{_DIAGRAMS}.stations.pouring:PouringStation",
    "guidance:kgrl": f"{_DIAGRAMS}.guidance.primitive:kgrl",
    "guidance:kmp": f"{_DIAGRAMS}.guidance.primitive:kmp",
    "guidance:none": f"{_DIAGRAMS}.guidance.sct:unguided",
    "guidance:residual": f"{_DIAGRAMS}.guidance.primitive:residual",
    "guidance:residual_cbf": f"{_DIAGRAMS}.guidance.primitive:residual_cbf",
    "guidance:residual_covariance": f"{_DIAGRAMS}.guidance.primitive:residual_covariance",
    "guidance:residual_tangent": f"{_DIAGRAMS}.guidance.primitive:residual_tangent",
    "guidance:safe_residual": f"{_DIAGRAMS}.guidance.primitive:safe_residual",
    "guidance:sct": f"{_DIAGRAMS}.guidance.sct:sct",
    "guidance:skgrl": f"{_DIAGRAMS}.guidance.primitive:skgrl",
    "robot:iiwa14": f"{_ROBOTS}.catalog:IIWA14",
    "robot:panda": f"{_ROBOTS}.catalog:PANDA",
    "robot:ur5e": f"{_ROBOTS}.catalog:UR5E",
    "end_effector:connector_tool": f"{_ROBOTS}.catalog:CONNECTOR_TOOL",
    "end_effector:parallel_gripper": f"{_ROBOTS}.catalog:PARALLEL_GRIPPER",
    "kernel:matern52": "guiderail.models.primitives.kernels:Matern52",
    "kernel:squared_exponential": "guiderail.models.primitives.kernels:SquaredExponential",
    "learner:crossq": f"{_LEARNING}.off_policy:CrossQLearner",
    "learner:sac": f"{_LEARNING}.off_policy:SacLearner",
    "learner:td3": f"{_LEARNING}.off_policy:Td3Learner",
    "learner:tqc": f"{_LEARNING}.off_policy:TqcLearner",
    "learner_config:crossq": f"{_LEARNING}.learner_config:OffPolicyConfig",
    "learner_config:sac": f"{_LEARNING}.learner_config:OffPolicyConfig",
    "learner_config:td3": f"{_LEARNING}.learner_config:OffPolicyConfig",
    "learner_config:tqc": f"{_LEARNING}.learner_config:OffPolicyConfig",
}
"""Plug-ins of this package: "module:attribute" by "kind:name"."""


def find_plugins(kind: str) -> Iterator[tuple[str, metadata.EntryPoint]]:
    """Yield the name and the entry point of each plug-in of a kind, those of this package first, without importing it.

    The entry points of this package belong to no distribution.
    """
    for point in _all_plugins():
        prefix, _, name = point.name.partition(":")
        if prefix == kind and name:
            yield name, point


def _all_plugins() -> Iterator[metadata.EntryPoint]:
    yield from (metadata.EntryPoint(name, target, GROUP) for name, target in BUILT_IN.items())
    yield from metadata.entry_points(group=GROUP)  # reads a file of each distribution, so only if it is needed


def load_plugin(kind: str, name: str, sibling: str) -> Any:
    """Import a plug-in and return its object; `sibling` is the distribution that has it.

    Raises:
        MissingSiblingError: If there is no such plug-in.
    """
    for found, point in find_plugins(kind):
        if found == name:
            return point.load()
    raise MissingSiblingError(f"this {kind}", sibling)


def is_packaged(point: metadata.EntryPoint) -> bool:
    """Return True if an entry point belongs to guiderail or to a sibling distribution."""
    return point.dist is None or point.dist.name in {f"guiderail-{name}" for name in SIBLINGS}


def is_sibling_module(module: str) -> bool:
    """Return True if a module, given by its dotted name, belongs to guiderail or to one of its siblings."""
    top = module.partition(".")[0]
    return top == "guiderail" or top in {f"guiderail_{name}" for name in SIBLINGS}


def require_sibling(name: str, what: str) -> None:
    """Raise a MissingSiblingError unless the sibling distribution guiderail-NAME is installed; `what` needs it."""
    if find_spec(f"guiderail_{name}") is None:
        raise MissingSiblingError(what, name)


class MissingSiblingError(InputError):
    """Error for a feature of a sibling distribution that is not installed; the message has the line that installs it.

    Args:
        what: Feature that needs the distribution, such as "guiderail deploy".
        name: Name of the distribution, without "guiderail-".
    """

    def __init__(self, what: str, name: str):
        super().__init__(f'{what} needs guiderail-{name}, which is not installed: pip install "guiderail[{name}]"')


Entry = TypeVar("Entry")
_LOGGER = logging.getLogger(__name__)
_NO_VALUE: Any = object()  # default of `register`, because None is refused like any other value


class Registry(Generic[Entry]):
    """View of the plug-ins of one kind.

    Entries have two sources: the plug-ins of the kind `plugin` in the table (see `plugins`), whose modules are imported
    when their entry is needed, and calls of `register`. A plug-in of another package with the name of an entry of
    guiderail is ignored, with a warning, so that an installed package cannot replace this entry.

    Args:
        noun: Kind of the entries for messages, such as "task".
        plugin: Kind of the plug-ins in the table, such as "task"; none by default.
        check: Function that is called with name and entry before the entry is added, and may raise an `InputError`.
    """

    def __init__(
        self,
        noun: str,
        *,
        plugin: str | None = None,
        check: Callable[[str, Any], None] = lambda name, value: None,
    ):
        self.noun = noun
        self._plugin, self._check = plugin, check
        self._entries: dict[str, Entry] = {}
        self._origins: dict[str, tuple[str, str]] = {}
        self._loaded: set[str] = set()  # names whose entry points were loaded

    @overload
    def register(self, name: str) -> Callable[[Entry], Entry]: ...
    @overload
    def register(self, name: str, value: Entry) -> Entry: ...
    def register(self, name: str, value: Any = _NO_VALUE) -> Any:
        """Add an entry; without a value, return a decorator that adds the decorated object.

        Raises:
            InputError: If the name is not a text (as for a decorator without parentheses) or is blank, the registry's
                `check` refuses the entry, or the name belongs to an object that is defined elsewhere or to a module of
                guiderail that is not imported yet.
        """
        self.check_name(name)
        if value is _NO_VALUE:
            return lambda decorated: self.register(name, decorated)
        self._check(name, value)
        origin = _origin(value)
        existing = self._origins.get(name, origin)
        is_used, place = name in self._entries and existing != origin, existing[0]
        if name not in self._entries and name in self._packaged:
            place = self._packaged[name].module
            # The declaring module registers the name while it is imported, or if it is executed as `__main__`.
            is_used = place not in sys.modules and origin[0] != _file(place)
        if is_used:
            raise InputError(f"there is a {self.noun} {name!r} already, from {place}: choose another name")
        self._entries[name], self._origins[name] = value, origin
        return value

    def check_name(self, name: object) -> None:
        """Raise an InputError unless `name` is a text that is not blank."""
        if not (isinstance(name, str) and name.strip()):
            raise InputError(f'a {self.noun} is registered by a name, as in @register_...("name"), not {brief(name)}')

    def get(self, name: str) -> Entry:
        """Return the entry of a name.

        Raises:
            InputError: If there is no such entry, the name is not a string, or an entry point of that name cannot be
                loaded or is not the only entry of that name.
        """
        if not isinstance(name, str):
            raise InputError(f"a {self.noun} is named by a word, not {brief(name)}: {did_you_mean('', self.names())}")
        if name not in self._entries and name in self._packaged:
            value = getattr(import_module(self._packaged[name].module), self._packaged[name].attr)
            if name not in self._entries:  # importing the module may have registered it
                self.register(name, value)
        if name in self._points and name not in self._loaded:
            for point in self._points[name]:
                if self.is_packaged(name):
                    _LOGGER.warning(
                        "the %s %r of %s is ignored, because guiderail has one of this name: rename or uninstall it",
                        self.noun, name, _package_of(point),
                    )  # fmt: skip
                else:
                    self._load(name, point)
            self._loaded.add(name)
        if name not in self._entries:
            self.refuse_missing(name)
            raise InputError(f"there is no {self.noun} {brief(name)}: {did_you_mean(name, self.names())}")
        return self._entries[name]

    def _load(self, name: str, point: metadata.EntryPoint) -> None:
        """Load the plug-in of a name; raise an InputError if this fails, or if another object has the name."""
        try:
            with naming_failures(f"importing {point.value}"):
                value = point.load()
            if name not in self._entries:  # importing the module may have registered it
                self.register(name, value)
            entry, place = self._entries[name], self._origins[name][0]
            is_same = value is entry or value is getattr(entry, "build", None) or isinstance(value, ModuleType)
            if not is_same and _origin(value) != self._origins[name]:
                raise InputError(f"there is another {self.noun} {name!r}, from {place}: rename one, or uninstall it")
        except InputError as error:
            raise InputError(f"the {self.noun} {name!r} of {_package_of(point)} cannot be used: {error}") from error

    def refuse_missing(self, name: str) -> None:
        """Raise a MissingSiblingError if there is no entry of this name, but a sibling has one."""
        for sibling, provided in SIBLINGS.items():
            if f"{self._plugin}:{name}" in provided and name not in self.names():
                raise MissingSiblingError(f"the {self.noun} {name!r}", sibling)

    def names(self) -> list[str]:
        """Return the names of all entries, sorted."""
        return sorted({*self._packaged, *self._points, *self._entries})

    @cached_property
    def broken(self) -> dict[str, str]:
        """Error message of each unusable entry point of another package by name; this attribute loads all of them."""
        messages = {}
        for name in self._points:
            try:
                self.get(name)
            except InputError as error:
                messages[name] = str(error)
        return messages

    def usable(self) -> list[str]:
        """Return the names of all entries except the `broken` ones, sorted."""
        return [name for name in self.names() if name not in self.broken]

    def entries(self) -> dict[str, Entry]:
        """Import and return all usable entries by name, without those of siblings whose dependencies are missing."""
        entries = {}
        for name in self.usable():
            try:
                entries[name] = self.get(name)
            except ModuleNotFoundError:
                if self._packaged[name].dist is None:
                    raise
        return entries

    def name_of(self, value: object) -> str | None:
        """Return the name under which an object is registered, or that of its entry point; None if there is neither."""
        declared = f"{getattr(value, '__module__', '')}:{getattr(value, '__qualname__', '')}"
        points = ((name, point) for name, points in self._points.items() for point in points)
        names = (name for name, entry in self._entries.items() if entry is value)
        return next(names, next((name for name, point in points if point.value == declared), None))

    def is_loaded(self, name: str) -> bool:
        """Return True if the entry of a name was registered or imported in this process."""
        return name in self._entries

    def is_packaged(self, name: str) -> bool:
        """Return True if the name is that of a plug-in of guiderail or of a sibling distribution."""
        return name in self._packaged

    @cached_property
    def _packaged(self) -> dict[str, metadata.EntryPoint]:
        """Entry points of guiderail and of its siblings by name."""
        return {name: point for name, point in self._plugins if is_packaged(point)}

    @cached_property
    def _points(self) -> dict[str, list[metadata.EntryPoint]]:
        """Entry points of other packages by name, without duplicates of the same value."""
        points: dict[str, dict[str, metadata.EntryPoint]] = {}
        for name, point in self._plugins:
            if not is_packaged(point):
                points.setdefault(name, {}).setdefault(point.value, point)
        return {name: list(by_value.values()) for name, by_value in points.items()}

    @cached_property
    def _plugins(self) -> list[tuple[str, metadata.EntryPoint]]:
        """Name and entry point of every plug-in of this kind."""
        return [] if self._plugin is None else list(find_plugins(self._plugin))


def check_kind(kind: type) -> Callable[[str, object], None]:
    """Return a `check` of a registry that refuses an entry that is no instance of `kind`, such as a plain function."""

    def check(name: str, entry: object) -> None:
        if not isinstance(entry, kind):
            raise InputError(f"the entry {name!r} is a {kind.__name__}, which a decorator makes, not {brief(entry)}")

    return check


def check_callable(name: str, value: object) -> None:
    """Raise an InputError unless a value is a function or a class; for the `check` of a registry."""
    if not callable(value):
        raise InputError(f"{brief(name)} is registered with a function or a class, not with {brief(value)}")


def check_class(name: str, value: object, kind: type) -> None:
    """Raise an InputError unless a value is a subclass of `kind` without abstract methods; see `check_callable`."""
    if not (isinstance(value, type) and issubclass(value, kind)):
        raise InputError(f"{brief(name)} is registered with a subclass of {kind.__name__}, not with {brief(value)}")
    missing = sorted(getattr(value, "__abstractmethods__", ()))
    if missing:
        raise InputError(f"the class {value.__name__} lacks {', '.join(missing)}: see `{kind.__name__}`")


def check_methods(kind: type, base: type) -> None:
    """Raise an InputError if a class redefines a public method of `base` so that callers of `base` cannot call it."""
    for name, expected in vars(base).items():
        own = getattr_static(kind, name)
        if name.startswith("_") or not (isinstance(expected, FunctionType) and isinstance(own, FunctionType)):
            continue
        parameters = signature(expected).parameters
        try:
            signature(own).bind(*parameters)
        except TypeError:
            raise InputError(
                f"{name} of {kind.__name__} must have the parameters ({', '.join(parameters)}), not "
                f"({', '.join(signature(own).parameters)})"
            ) from None


def did_you_mean(name: object, known: Iterable[str], otherwise: str = "") -> str:
    """Return the end of a message about an unknown name: the closest known name, or all names and `otherwise`."""
    known = sorted(known)
    by_lower = {word.lower(): word for word in known}
    closest = difflib.get_close_matches(str(name).lower(), by_lower, n=1)
    if closest:
        return f"did you mean {by_lower[closest[0]]}?"
    return (f"choose one of {', '.join(known)}" if known else "none is registered") + otherwise


def _package_of(point: metadata.EntryPoint) -> str:
    return f"the installed package {point.dist.name if point.dist else '?'}"


def _file(module: str) -> str | None:
    """Return the path of a module's file, without importing the module; None if there is none."""
    spec = find_spec(module)
    return None if spec is None or spec.origin is None else str(Path(spec.origin).resolve())


def _origin(value: object) -> tuple[str, str]:
    """Return the file or module in which an object is defined, and its qualified name.

    The origin stays the same if the module is imported again, possibly under another name. An entry with an attribute
    `build` has the origin of this attribute.
    """
    defined: Any = value if hasattr(value, "__qualname__") else getattr(value, "build", value)
    while isinstance(defined, partial):
        defined = defined.func
    named = hasattr(defined, "__qualname__")
    module = str(getattr(defined, "__module__", None) or type(defined).__module__)
    file = getattr(defined, "__globals__", {}).get("__file__") or getattr(sys.modules.get(module), "__file__", None)
    return str(Path(file).resolve()) if file else module, defined.__qualname__ if named else repr(value)
