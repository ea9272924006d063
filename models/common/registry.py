"""Plugin registry: entries by name, from this package, from entry points, or registered at runtime."""

import ast
import difflib
import logging
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from functools import cached_property, partial
from importlib import import_module, metadata
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import Any, Generic, NamedTuple, TypeVar, overload

from guiderail.models.common.errors import InputError, brief, naming_failures
from guiderail.models.common.plugins import find_plugins, is_from_sibling

Entry = TypeVar("Entry")
_LOGGER = logging.getLogger(__name__)
_NO_VALUE: Any = object()  # default of `register`, because None is refused like any other value


class Registry(Generic[Entry]):
    """Registry of entries by name.

    Entries have three sources: calls of `register` in the modules of `package`, plug-ins of the kind `plugin` in
    installed packages (see `plugins`), and calls of `register` in any other imported module. Plug-ins of the sibling
    distributions of guiderail count as entries of `package`. Another plug-in with the name of an entry of `package` is
    ignored, with a warning, so that an installed package cannot replace this entry.

    `get` imports the module of an entry. If `decorator` is given, no module is imported to list the names.

    Args:
        noun: Kind of the entries for messages, such as "task".
        package: Import name of the package, or of each package, whose modules register entries.
        decorator: Name of the function that registers an entry under its first argument; calls of this function are
            found in the modules' source. Without `decorator`, all modules are imported at the first use.
        plugin: Kind of the plug-ins, such as "task"; none by default.
        check: Function that is called with name and entry before the entry is added, and may raise an `InputError`.
    """

    def __init__(
        self,
        noun: str,
        *,
        package: str | Sequence[str] = (),
        decorator: str | None = None,
        plugin: str | None = None,
        check: Callable[[str, Any], None] = lambda name, value: None,
    ):
        self.noun = noun
        self._packages = (package,) if isinstance(package, str) else tuple(package)
        self._decorator, self._plugin, self._check = decorator, plugin, check
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
                the package that is not imported yet.
        """
        self.check_name(name)
        if value is _NO_VALUE:
            return lambda decorated: self.register(name, decorated)
        self._check(name, value)
        origin = _origin(value)
        existing = self._origins.get(name, origin)
        is_used, place = name in self._entries and existing != origin, existing[0]
        if self._decorator is not None and name not in self._entries and name in self._declarations:
            place = self._declarations[name].module
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
        if name not in self._entries and name in self._declarations:
            import_module(self._declarations[name].module)
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

    def names(self) -> list[str]:
        """Return the names of all entries, sorted."""
        return sorted({*self._declarations, *self._points, *self._entries})

    @cached_property
    def broken(self) -> dict[str, str]:
        """Error message of each entry point that cannot be used, by name; this attribute loads all entry points."""
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

    def name_of(self, value: object) -> str | None:
        """Return the name under which an object is registered, or that of its entry point; None if there is neither."""
        declared = f"{getattr(value, '__module__', '')}:{getattr(value, '__qualname__', '')}"
        points = ((name, point) for name, points in self._points.items() for point in points)
        names = (name for name, entry in self._entries.items() if entry is value)
        return next(names, next((name for name, point in points if point.value == declared), None))

    def is_packaged(self, name: str) -> bool:
        """Return True if a module of the package, or of a sibling distribution, registers the name."""
        return name in self._declarations

    def declared(self, name: str, keyword: str) -> Any:
        """Return an attribute of an entry: a keyword argument of its decorator, or an attribute of its class.

        A literal is read from the source of the entry's module. If the value is a name that this module imports from
        another module, only the other module is imported. Otherwise, the entry's module is imported.
        """
        values = self._declarations[name].values if name in self._declarations else {}
        if name in self._entries or keyword not in values:
            return getattr(self.get(name), keyword)
        value = values[keyword]
        return getattr(import_module(value.module), value.name) if isinstance(value, _ImportedName) else value

    def declares(self, name: str, keyword: str) -> bool:
        """Return True if `declared` does not import the entry's module."""
        return name in self._entries or (name in self._declarations and keyword in self._declarations[name].values)

    @cached_property
    def _declarations(self) -> dict[str, "_Declaration"]:
        """Declaration of each name that the modules of the package register."""
        files = {
            ".".join((package, *file.relative_to(folder).with_suffix("").parts)): file
            for package in self._packages
            for folder in _folders(package)
            for file in sorted(folder.rglob("*.py"))
            if file.stem != "__init__"
        }
        if self._decorator is None:
            values = {id(value): module for module in files for value in vars(import_module(module)).values()}
            entries = self._entries.items()
            return {name: _Declaration(values[id(entry)], {}) for name, entry in entries if id(entry) in values}
        modules = {point.module for _, point in self._plugins if is_from_sibling(point)}
        files |= {module: Path(file) for module in modules if (file := _file(module)) is not None}
        return {
            name: _Declaration(module, values)
            for module, file in files.items()
            for name, values in _registered(file.read_text(encoding="utf-8"), self._decorator)
        }

    @cached_property
    def _points(self) -> dict[str, list[metadata.EntryPoint]]:
        """Entry points by name, without those of siblings and without duplicates of the same value."""
        points: dict[str, dict[str, metadata.EntryPoint]] = {}
        for name, point in self._plugins:
            if self._decorator is None or not is_from_sibling(point):
                points.setdefault(name, {}).setdefault(point.value, point)
        return {name: list(by_value.values()) for name, by_value in points.items()}

    @cached_property
    def _plugins(self) -> list[tuple[str, metadata.EntryPoint]]:
        """Name and entry point of every plug-in of this registry's kind."""
        return [] if self._plugin is None else list(find_plugins(self._plugin))


class _Declaration(NamedTuple):
    """Module that registers an entry, and the attributes of the entry that can be read from the module's source."""

    module: str
    values: dict[str, Any]


class _ImportedName(NamedTuple):
    """Name that a module imports from the module `module`."""

    module: str
    name: str


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


def _folders(package: str) -> list[Path]:
    spec = find_spec(package)
    return [Path(folder) for folder in (spec.submodule_search_locations or ())] if spec is not None else []


def _file(module: str) -> str | None:
    """Return the path of a module's file, without importing the module; None if there is none."""
    spec = find_spec(module)
    return None if spec is None or spec.origin is None else str(Path(spec.origin).resolve())


def _registered(source: str, decorator: str) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the name and the values of each entry that the source registers with `decorator`.

    The values are the literals and imported names among the decorator's keyword arguments and the attributes of the
    decorated class.
    """
    if not re.search(rf"\b{decorator}\(\s*[\"']", source):  # faster than parsing
        return
    tree = ast.parse(source)
    imported = {
        alias.asname or alias.name: _ImportedName(node.module, alias.name)
        for node in tree.body
        if isinstance(node, ast.ImportFrom) and node.module and not node.level
        for alias in node.names
    }
    for statement in tree.body:
        roots = getattr(statement, "decorator_list", [statement])
        for node in (node for root in roots for node in ast.walk(root)):
            if not (isinstance(node, ast.Call) and getattr(node.func, "id", None) == decorator and node.args):
                continue
            name = node.args[0]
            if isinstance(name, ast.Constant) and isinstance(name.value, str):
                expressions = dict(_assignments(statement.body)) if isinstance(statement, ast.ClassDef) else {}
                expressions |= {str(argument.arg): argument.value for argument in node.keywords}
                values: dict[str, Any] = {}
                for attribute, value in expressions.items():
                    if isinstance(value, ast.Name) and value.id in imported:
                        values[attribute] = imported[value.id]
                    with suppress(ValueError):
                        values[attribute] = ast.literal_eval(value)
                yield name.value, values


def _assignments(body: Iterable[ast.stmt]) -> Iterator[tuple[str, ast.expr]]:
    """Yield the name and the assigned expression of each attribute in the body of a class."""
    for node in body:
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        value = getattr(node, "value", None)
        if len(targets) == 1 and isinstance(targets[0], ast.Name) and isinstance(value, ast.expr):
            yield targets[0].id, value


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
