"""YAML that a person wrote: templates, run configurations and studies.

It is read as YAML 1.2's core schema has it, of numbers, texts, lists and mappings alone: `yes` is a text, `1e-3` a
number, and `010` is a text rather than eight. Whatever a text holds, reading it takes a bounded time and memory.
"""

import re
from pathlib import Path
from typing import Any, NoReturn

import yaml

from guiderail.models.common.errors import InputError, brief
from guiderail.models.common.files import read_bytes

LARGEST_TEXT = 100_000  # [bytes] a template has five thousand
MOST_NODES = 10_000  # with every alias counted as what it stands for
DEEPEST = 30  # lists and mappings inside each other

_TOO_DEEP = f"more than {DEEPEST} lists or mappings are inside each other: flatten them"
_CORE = "tag:yaml.org,2002:"


def load_yaml(path: str | Path, what: str = "file") -> Any:
    """Reads a YAML file; `what` names its kind in messages.

    Raises:
        InputError: as `parse_yaml`, or if the file can't be read.
    """
    path = Path(path)
    data = read_bytes(path, what, LARGEST_TEXT)
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"the {what} '{path}' can't be read: it is no text in UTF-8") from error
    return parse_yaml(text, path.name)


def parse_yaml(text: str, where: str = "text") -> Any:
    """What one YAML document says, in Python's own types; `where` names it in messages.

    Raises:
        InputError: if it is no YAML, has a tag, a key twice, a key that is no text, or is too large or too deep.
    """
    if len(text) > LARGEST_TEXT:
        raise InputError(f"{where} is longer than {LARGEST_TEXT} characters: leave out what is not needed")
    try:
        return yaml.load(text, Loader=_Loader)
    except _RefusedError as error:
        raise InputError(f"{where}, {error}") from error
    except yaml.reader.ReaderError as error:
        raise InputError(f"{where} is not YAML: it holds a character that can't be printed") from error
    except yaml.MarkedYAMLError as error:
        said = ", ".join(part for part in (error.context, error.problem) if part)
        raise InputError(f"{where} is not YAML: {said}{_at(error.problem_mark or error.context_mark)}") from error
    except ValueError as error:  # an integer of more digits than Python reads
        raise InputError(f"{where} holds a number of thousands of digits: shorten it") from error


class _RefusedError(Exception):
    """YAML that is sound, and not what anyone writes."""


def _at(mark: Any) -> str:
    return f" in line {mark.line + 1}" if mark is not None else ""


class _Loader(yaml.SafeLoader):
    """PyYAML's safe loader, with YAML 1.2's numbers, and with limits that hold before anything is built."""

    yaml_implicit_resolvers = {}  # noqa: RUF012  (PyYAML's own way: filled below, and not its base's)

    def __init__(self, stream: str):
        super().__init__(stream)
        self._nodes, self._depth = 0, 0
        self._sizes: dict[yaml.Node, tuple[int, int]] = {}  # nodes and levels below, of what is complete

    def compose_node(self, parent: Any, index: Any) -> Any:
        event = self.peek_event()
        if getattr(event, "tag", None) is not None:
            _refuse(f"the tag {brief(event.tag)} says nothing here: leave it out", event)
        self._depth += 1
        if self._depth > DEEPEST:
            _refuse(_TOO_DEEP, event)
        node: Any = super().compose_node(parent, index)
        self._depth -= 1
        if node.tag == f"{_CORE}timestamp":
            _refuse(f"{brief(node.value)} is a date, or a subtraction: put it in quotes", event)
        if isinstance(event, yaml.AliasEvent):
            if node not in self._sizes:
                _refuse(f"{brief(event.anchor)} contains itself: write out what it stands for", event)
            size, levels = self._sizes[node]
            if self._depth + levels > DEEPEST:
                _refuse(_TOO_DEEP, event)
            self._nodes += size
        else:
            inside = [self._sizes[child] for child in _children(node)]
            self._sizes[node] = 1 + sum(size for size, _ in inside), 1 + max((n for _, n in inside), default=0)
            self._nodes += 1
        if self._nodes > MOST_NODES:
            _refuse(f"there are more than {MOST_NODES} entries, aliases counted: leave out what is not needed", event)
        return node

    def compose_mapping_node(self, anchor: Any) -> yaml.MappingNode:
        node = super().compose_mapping_node(anchor)
        seen = set()
        for key, _ in node.value:
            if key.tag not in (f"{_CORE}str", f"{_CORE}merge"):
                said = brief(key.value) if isinstance(key, yaml.ScalarNode) else "a list or a mapping"
                _refuse(f"{said} as a key is no text: put it in quotes", key)
            if key.value in seen:
                _refuse(f"the key {brief(key.value)} is there twice: keep one", key)
            seen.add(key.value)
        return node


def _refuse(problem: str, at: Any) -> NoReturn:
    """`at` is the event or the node that is refused."""
    raise _RefusedError(f"line {at.start_mark.line + 1}: {problem}")


def _children(node: yaml.Node) -> list[yaml.Node]:
    if isinstance(node, yaml.MappingNode):
        return [child for pair in node.value for child in pair]
    return node.value if isinstance(node, yaml.SequenceNode) else []


for _name, _pattern, _first in (
    ("null", r"~|null|Null|NULL|", ["~", "n", "N", ""]),
    ("bool", r"true|True|TRUE|false|False|FALSE", list("tTfF")),
    ("int", r"[-+]?(0|[1-9][0-9]*)", list("-+0123456789")),
    (
        "float",
        r"[-+]?([0-9]+\.[0-9]*|\.[0-9]+|[0-9]+(?=[eE]))([eE][-+]?[0-9]+)?|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)",
        list("-+.0123456789"),
    ),
    ("timestamp", r"[0-9]{4}-[0-9]{1,2}-[0-9]{1,2}([Tt ].*)?", list("0123456789")),  # to be refused
    ("merge", r"<<", ["<"]),
):
    _Loader.add_implicit_resolver(f"{_CORE}{_name}", re.compile(rf"(?:{_pattern})\Z"), _first)
