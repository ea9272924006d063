"""Reader of YAML files: templates, tasks, run configurations and studies.

Values are null, booleans, numbers, texts, lists and mappings as in YAML 1.2's core schema, except that integers are
decimal without leading zeros: `yes` and `010` are texts, `1e-3` is a number. Time and memory of reading are bounded for
any content.
"""

import re
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from textwrap import shorten
from typing import Any, NoReturn

from ruamel.yaml import YAML
from ruamel.yaml.error import MarkedYAMLError
from ruamel.yaml.events import AliasEvent, CollectionEndEvent, CollectionStartEvent, MappingStartEvent, ScalarEvent
from ruamel.yaml.nodes import ScalarNode
from ruamel.yaml.parser import Parser
from ruamel.yaml.reader import ReaderError
from ruamel.yaml.resolver import VersionedResolver

from guiderail.models.common.errors import InputError, brief
from guiderail.models.common.files import read_bytes

MAX_SIZE = 100_000  # largest size of a file [bytes]; a template has about 5,000
MAX_ENTRIES = 10_000  # largest number of entries; an alias counts as many as its content
MAX_DEPTH = 30  # largest depth of nested lists and mappings; the innermost values count as a level

_TAG = "tag:yaml.org,2002:"
_PATTERNS = {  # pattern of plain scalars of each type, and their possible first characters
    "null": (r"~|null|Null|NULL|", ["~", "n", "N", ""]),
    "bool": (r"true|True|TRUE|false|False|FALSE", list("tTfF")),
    "int": (r"[-+]?(0|[1-9][0-9]*)", list("-+0123456789")),
    "float": (
        r"[-+]?([0-9]+\.[0-9]*|\.[0-9]+|[0-9]+(?=[eE]))([eE][-+]?[0-9]+)?|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)",
        list("-+.0123456789"),
    ),
    "timestamp": (r"[0-9]{4}-[0-9]{1,2}-[0-9]{1,2}([Tt ].*)?", list("0123456789")),  # recognized, then refused
    "merge": (r"<<", ["<"]),
}


def load_yaml(path: str | Path, what: str = "file") -> Any:
    """Read a YAML file of at most `MAX_SIZE` bytes; `what` is its kind for messages, such as "template".

    Raises:
        InputError: As `parse_yaml`, or if the file cannot be read or is not in UTF-8.
    """
    path = Path(path)
    return parse_content(read_bytes(path, what, MAX_SIZE), path, what)


def parse_content(content: bytes, path: Path, what: str = "file") -> Any:
    """Read the content of a YAML file as `load_yaml`.

    Raises:
        InputError: As `parse_yaml`, or if the content is not in UTF-8.
    """
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"the {what} '{path}' can't be read: it is not text in UTF-8") from error
    return parse_yaml(text, str(path))


def parse_yaml(text: str, where: str = "text") -> Any:
    """Read one YAML document as Python's own types; `where` is its name for messages.

    Raises:
        InputError: If the text is not YAML or not a single document, has a tag, a date, a duplicate key or a key that
            is not text, or is too large or too deep.
    """
    with _naming_errors(text, where):
        return _make_yaml().load(text)


def check_yaml(text: str, where: str, tags: Collection[str]) -> None:
    """Check that YAML documents are within the limits of `parse_yaml`, and have no tags except `tags`.

    Raises:
        InputError: As `parse_yaml`, except for several documents, unknown aliases, wrong merges (`<<`) and integers of
            thousands of digits.
    """
    with _naming_errors(text, where):
        for _ in _make_yaml(tags).parse(text):
            pass


@contextmanager
def _naming_errors(text: str, where: str) -> Iterator[None]:
    """Raise an `InputError` with the name `where` if the text is too long or reading it raises an error."""
    if len(text) > MAX_SIZE:
        raise InputError(f"{where} is longer than {MAX_SIZE} characters: leave out what is not needed")
    try:
        yield
    except _RefusedError as error:
        raise InputError(f"{where}, {error}") from error
    except ReaderError as error:
        raise InputError(f"{where} is not YAML: it holds a character that can't be printed") from error
    except MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line = f" in line {mark.line + 1}" if mark is not None else ""
        words = shorten(", ".join(part for part in (error.context, error.problem) if part), 200)
        raise InputError(f"{where} is not YAML: {words}{line}") from error
    except ValueError as error:  # an integer of more digits than Python reads
        raise InputError(f"{where} holds a number of thousands of digits: shorten it") from error


class _Resolver(VersionedResolver):
    """Resolver of plain scalars by `_PATTERNS`, regardless of the YAML version that a document declares."""

    processing_version = (1, 2)
    versioned_resolver: dict[str, list[tuple[str, re.Pattern[str]]]] = {}  # noqa: RUF012 (ruamel.yaml's interface)


for _name, (_pattern, _first) in _PATTERNS.items():
    for _character in _first:
        _entry = f"{_TAG}{_name}", re.compile(rf"(?:{_pattern})\Z")
        _Resolver.versioned_resolver.setdefault(_character, []).append(_entry)


def _make_yaml(tags: Collection[str] = ()) -> YAML:
    yaml = YAML(typ="safe", pure=True)
    yaml.Resolver, yaml.Parser = _Resolver, type("_TagParser", (_Parser,), {"tags": tags})
    return yaml


class _RefusedError(Exception):
    """Error for valid YAML that exceeds the reader's limits or uses a refused feature."""


class _Collection:
    """List or mapping that is being read, with the numbers of its children, nested entries and nested levels."""

    def __init__(self, event: Any):
        self.anchor, self.is_mapping = event.anchor, isinstance(event, MappingStartEvent)
        self.children, self.entries, self.levels = 0, 1, 1
        self.keys: set[str] = set()


class _Parser(Parser):
    """Parser that checks each event before any object is built."""

    tags: Collection[str] = ()  # accepted tags

    def __init__(self, loader: Any):
        super().__init__(loader)
        self._num_entries = 0
        self._parents: list[_Collection] = []
        self._sizes: dict[str, tuple[int, int]] = {}  # entries and levels of anchored nodes
        self._anchored: dict[str, Any] = {}  # events of anchored nodes
        loader.composer.warn_double_anchors = False  # an alias refers to the last anchor of its name

    def get_event(self) -> Any:
        event = super().get_event()
        entries, levels = 0, 0
        is_key = bool(self._parents) and self._parents[-1].is_mapping and self._parents[-1].children % 2 == 0
        if isinstance(event, CollectionEndEvent):
            collection = self._parents.pop()
            entries, levels = self._sizes[collection.anchor] = collection.entries, collection.levels
        elif isinstance(event, AliasEvent):
            if any(parent.anchor == event.anchor for parent in self._parents):
                _refuse(f"{brief(event.anchor)} contains itself: leave this alias out", event)
            if is_key and event.anchor in self._anchored:
                self._check_key(self._anchored[event.anchor], event)
            entries, levels = self._sizes.get(event.anchor, (1, 1))
            self._num_entries += entries
        elif isinstance(event, ScalarEvent | CollectionStartEvent):
            _check_node(event, self.resolver, self.tags)
            if is_key:
                self._check_key(event, event)
            self._anchored[event.anchor] = event
            self._num_entries += 1
            if isinstance(event, CollectionStartEvent):
                self._parents.append(_Collection(event))
            else:
                entries, levels = self._sizes[event.anchor] = 1, 1
        if len(self._parents) + levels > MAX_DEPTH:
            _refuse(f"more than {MAX_DEPTH} levels are inside each other: flatten lists and mappings", event)
        if self._num_entries > MAX_ENTRIES:
            _refuse(f"there are more than {MAX_ENTRIES} entries, aliases counted: leave out what is not needed", event)
        if entries and self._parents:
            parent = self._parents[-1]
            parent.children, parent.entries = parent.children + 1, parent.entries + entries
            parent.levels = max(parent.levels, levels + 1)
        return event

    def _check_key(self, node: Any, event: Any) -> None:
        """Refuse a node that cannot be a key of the innermost mapping; `event`, for the message, may be an alias."""
        kind, keys = _kind(node, self.resolver), self._parents[-1].keys
        if kind not in ("str", "merge"):
            key = "a list or a mapping" if kind == "collection" else brief(node.value)
            _refuse(f"the key {key} is not text: put it in quotes", event)
        if node.value in keys:  # YAML readers differ in which of the two values they use
            _refuse(f'duplicate key "{brief(node.value)[1:-1]}": leave one of the two out', event)
        keys.add(node.value)


def _check_node(event: Any, resolver: Any, tags: Collection[str]) -> None:
    if event.tag is not None and event.tag not in tags:
        _refuse(f"the tag {brief(event.tag)} has no meaning here: leave it out", event)
    if _kind(event, resolver) == "timestamp":
        _refuse(f"{brief(event.value)} is a date, or a subtraction: put it in quotes", event)


def _kind(event: Any, resolver: Any) -> str:
    if not isinstance(event, ScalarEvent):
        return "collection"
    return str(resolver.resolve(ScalarNode, event.value, event.implicit)).removeprefix(_TAG)


def _refuse(problem: str, event: Any) -> NoReturn:
    raise _RefusedError(f"line {event.start_mark.line + 1}: {problem}")
