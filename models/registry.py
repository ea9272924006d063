"""Open lists: things that are found by name, this package's own and those of whoever adds some."""

from __future__ import annotations

import difflib
import pkgutil
from collections.abc import Callable, Iterable
from importlib import import_module, metadata
from typing import Generic, TypeVar, overload

from guiderail.models.errors import InputError

Entry = TypeVar("Entry")


class Registry(Generic[Entry]):
    """Entries by name. Nothing is imported before a name is asked for.

    An entry is added by whoever defines it, with `register` as a decorator or a call. The modules of `package` are
    imported when the list is first looked at, so that a new one costs one file; an installed package adds its own by
    an entry point of the group `entry_points`, and a file that is not installed by being imported.
    """

    def __init__(self, noun: str, *, package: str | None = None, entry_points: str | None = None):
        """
        Args:
            noun: what an entry is, for sentences: "task", "robot".
            package: the import name of a package whose modules register entries.
            entry_points: the group of entry points that name further ones.
        """
        self.noun = noun
        self._package, self._group = package, entry_points
        self._entries: dict[str, Entry] = {}
        self._looked = False

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
        known = self._entries.get(name)
        if known is not None and _origin(known) != _origin(value):
            raise InputError(f"there is a {self.noun} {name!r} already, from {_origin(known)}: choose another name")
        self._entries[name] = value
        return value

    def get(self, name: str) -> Entry:
        """The entry of that name.

        Raises:
            InputError: if there is none; the sentence has the nearest name, or all of them.
        """
        if name not in self._entries:
            self._look()
        if name not in self._entries:
            raise InputError(f"there is no {self.noun} {name!r}: {did_you_mean(name, self.names())}")
        return self._entries[name]

    def names(self) -> list[str]:
        """The names of all entries, sorted."""
        self._look()
        return sorted(self._entries)

    def _look(self) -> None:
        if self._looked:
            return
        self._looked = True
        if self._package is not None:
            package = import_module(self._package)
            for module in pkgutil.iter_modules(package.__path__, f"{self._package}."):
                import_module(module.name)
        for point in metadata.entry_points(group=self._group) if self._group else ():
            if point.name not in self._entries:
                self._load(point)

    def _load(self, point: metadata.EntryPoint) -> None:
        value = point.load()
        if point.name not in self._entries:  # its module may have registered it while it was imported
            self.register(point.name, value)


def did_you_mean(name: object, known: Iterable[str]) -> str:
    """The end of a sentence about an unknown name: the nearest known one, else all of them."""
    known = sorted(known)
    lower = {word.lower(): word for word in known}
    near = difflib.get_close_matches(str(name).lower(), lower, n=1)
    return f"did you mean {lower[near[0]]}?" if near else f"choose one of {', '.join(known) or 'none'}"


def _origin(value: object) -> str:
    """Where something was defined: a module that is imported again defines the same things again."""
    return f"{getattr(value, '__module__', type(value).__module__)}.{getattr(value, '__qualname__', repr(value))}"
