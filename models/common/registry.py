"""Open lists: things that are found by name, this package's own and those of whoever adds some."""

from __future__ import annotations

import ast
import difflib
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import cached_property, partial
from importlib import import_module, metadata
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Generic, TypeVar, overload

from guiderail.models.common.errors import InputError, brief

Entry = TypeVar("Entry")


class Registry(Generic[Entry]):
    """Entries by name; a name costs no import, an entry that of its own module.

    An entry is added by whoever defines it, with `register` as a decorator or a call. A new module of `package` is
    found by being there; an installed package adds its own by an entry point of the group `entry_points`, and a file
    that is not installed by being imported.
    """

    def __init__(
        self,
        noun: str,
        *,
        package: str | Sequence[str] = (),
        decorator: str | None = None,
        entry_points: str | None = None,
    ):
        """
        Args:
            noun: what an entry is, for sentences: "task", "robot".
            package: import name of the package, or of each package, whose modules register entries.
            decorator: the function by whose calls, with a name as first argument, they do that: it is looked for in
                their text. Unless given they are all imported when the list is first looked at.
            entry_points: the group of entry points that name further ones.
        """
        self.noun = noun
        self._packages = (package,) if isinstance(package, str) else tuple(package)
        self._decorator, self._group = decorator, entry_points
        self._entries: dict[str, Entry] = {}
        self._origins: dict[str, tuple[str, str]] = {}

    @overload
    def register(self, name: str, value: None = None) -> Callable[[Entry], Entry]: ...
    @overload
    def register(self, name: str, value: Entry) -> Entry: ...
    def register(self, name: str, value: Entry | None = None) -> Entry | Callable[[Entry], Entry]:
        """Adds an entry; without a value, a decorator that adds what it decorates.

        Raises:
            InputError: if the name is taken by something that was defined elsewhere.
        """
        if value is None:
            return lambda decorated: self.register(name, decorated)
        origin = _origin(value)
        known = self._origins.get(name, origin)
        if name in self._entries and known != origin:
            raise InputError(f"there is a {self.noun} {name!r} already, from {known[0]}: choose another name")
        self._entries[name], self._origins[name] = value, origin
        return value

    def get(self, name: str) -> Entry:
        """The entry of that name.

        Raises:
            InputError: if there is none, the sentence has the nearest name or all of them; or if it is no word.
        """
        if not isinstance(name, str):
            raise InputError(f"a {self.noun} is named by a word, not {brief(name)}: {did_you_mean('', self.names())}")
        if name not in self._entries and name in self._modules:
            import_module(self._modules[name])
        if name not in self._entries and name in self._points:
            value = self._points[name].load()
            if name not in self._entries:  # its module may have registered it while it was imported
                self.register(name, value)
        if name not in self._entries:
            raise InputError(f"there is no {self.noun} {brief(name)}: {did_you_mean(name, self.names())}")
        return self._entries[name]

    def names(self) -> list[str]:
        """The names of all entries, sorted."""
        return sorted({*self._modules, *self._points, *self._entries})

    @cached_property
    def _modules(self) -> dict[str, str]:
        """The module of each name that the package's own modules register."""
        files = {
            ".".join((package, *file.relative_to(folder).with_suffix("").parts)): file
            for package in self._packages
            for folder in _folders(package)
            for file in sorted(folder.rglob("*.py"))
            if file.stem != "__init__"
        }
        if self._decorator is None:
            for module in files:
                import_module(module)
            return {}
        return {
            name: module
            for module, file in files.items()
            for name in _registered(file.read_text(encoding="utf-8"), self._decorator)
        }

    @cached_property
    def _points(self) -> dict[str, metadata.EntryPoint]:
        return {point.name: point for point in metadata.entry_points(group=self._group)} if self._group else {}


def did_you_mean(name: object, known: Iterable[str], otherwise: str = "") -> str:
    """The end of a sentence about an unknown name: the nearest known one, else all of them and what else helps."""
    known = sorted(known)
    lower = {word.lower(): word for word in known}
    near = difflib.get_close_matches(str(name).lower(), lower, n=1)
    return f"did you mean {lower[near[0]]}?" if near else f"choose one of {', '.join(known) or 'none'}{otherwise}"


def _folders(package: str) -> list[Path]:
    spec = find_spec(package)
    return [Path(folder) for folder in (spec.submodule_search_locations or ())] if spec is not None else []


def _registered(source: str, decorator: str) -> Iterator[str]:
    """The names with which a module's text calls `decorator`."""
    if not re.search(rf"\b{decorator}\(\s*[\"']", source):  # parsing takes longer
        return
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Call) and getattr(node.func, "id", None) == decorator and node.args:
            name = node.args[0]
            if isinstance(name, ast.Constant) and isinstance(name.value, str):
                yield name.value


def _origin(value: object) -> tuple[str, str]:
    """Where something was defined, a file or a module, and as what: imported again, it is the same thing again.

    An entry that is a record is told by what it builds with. A module's file counts, not its name: the same file can be
    imported under several.
    """
    defined: Any = value if hasattr(value, "__qualname__") else getattr(value, "build", value)
    while isinstance(defined, partial):
        defined = defined.func
    named = hasattr(defined, "__qualname__")
    module = str(getattr(defined, "__module__", None) or type(defined).__module__)
    file = getattr(defined, "__globals__", {}).get("__file__") or getattr(sys.modules.get(module), "__file__", None)
    return str(Path(file).resolve()) if file else module, defined.__qualname__ if named else repr(value)
