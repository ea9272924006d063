"""The kinds of input mapping, active constraint and transition distance: one class and one registration each.

A kind is a frozen dataclass whose fields are exactly what a template file may say about it, units in their names. It
registers itself under the word that the file uses:

    @register(ACTIVE_CONSTRAINTS, "half_space")
    @dataclass(frozen=True)
    class HalfSpace(ActiveConstraint): ...
"""

import dataclasses
import difflib
from collections.abc import Callable, Iterable, Mapping
from typing import Any, TypeVar

import numpy as np

from guiderail.models.common.errors import InputError, brief

INPUT_MAPPINGS: dict[str, type] = {}
ACTIVE_CONSTRAINTS: dict[str, type] = {}
TRANSITION_DISTANCES: dict[str, type] = {}

Kind = TypeVar("Kind", bound=type)


def register(registry: dict[str, type], name: str) -> Callable[[Kind], Kind]:
    """Makes a dataclass available to template files under `name`; a name is given once."""

    def add(kind: Kind) -> Kind:
        if name in registry:
            raise ValueError(f"{name} is already registered, by {registry[name].__name__}")
        registry[name] = kind
        return kind

    return add


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """The end of a sentence about an unknown name: the nearest known one, else all of them."""
    known = sorted(known)
    near = difflib.get_close_matches(name, known, n=1)
    return f"did you mean {near[0]}?" if near else f"known are {', '.join(known) or 'none'}"


def build(registry: dict[str, type], data: Any, where: str, number: Callable[[Any, str], Any]) -> Any:
    """Makes one mapping, constraint or distance from what the file says.

    Args:
        registry: the kinds to choose from.
        data: a mapping with `kind` and the fields of that kind.
        where: the place in the file, for the messages.
        number: turns an entry (a number, an expression, a list of them) into numbers; called for numeric fields only.

    Raises:
        InputError: if the kind or a field is unknown, missing, or not what the kind accepts.
    """
    if not isinstance(data, Mapping) or "kind" not in data:
        raise InputError(f"{where} must be a mapping with a 'kind', such as {sorted(registry)[0]}, not {brief(data)}.")
    name = data["kind"]
    if not isinstance(name, str) or name not in registry:
        raise InputError(f"{where}: unknown kind {brief(name)}; {did_you_mean(str(name), registry)}.")
    kind = registry[name]
    fields = {field.name: field for field in dataclasses.fields(kind)}
    where = f"{where} ({name})"
    values: dict[str, Any] = {}
    for key, value in data.items():
        if key == "kind":
            continue
        if key not in fields:
            raise InputError(f"{where}: unknown field {brief(key)}; {did_you_mean(str(key), fields)}.")
        values[key] = convert(fields[key].type, value, f"{where}, {key}", registry, number)
    missing = [
        field.name
        for field in fields.values()
        if field.name not in values
        and field.default is dataclasses.MISSING
        and field.default_factory is dataclasses.MISSING
    ]
    if missing:
        raise InputError(f"{where}: {missing[0]} is missing; give it a value.")
    try:
        return kind(**values)
    except InputError as error:
        raise InputError(f"{where}: {error}") from error


def convert(
    annotation: Any, value: Any, where: str, registry: dict[str, type], number: Callable[[Any, str], Any]
) -> Any:
    """What a field of the type `annotation` makes of an entry of the file."""
    if annotation is str:
        if not isinstance(value, str):
            raise InputError(f"{where} must be a name, not {brief(value)}.")
        return value
    if annotation is bool:
        if not isinstance(value, bool):
            raise InputError(f"{where} must be true or false, not {brief(value)}.")
        return value
    if annotation == tuple[int, ...]:
        if not isinstance(value, list) or not all(type(entry) is int for entry in value):
            raise InputError(f"{where} must be a list of whole numbers, not {brief(value)}.")
        return tuple(value)
    if annotation is float:
        return number(value, where)
    if annotation == tuple[float, ...]:
        if not isinstance(value, list):
            raise InputError(f"{where} must be a list of numbers, not {brief(value)}.")
        return tuple(number(entry, where) for entry in value)
    if annotation == tuple[tuple[float, ...], ...]:
        if not isinstance(value, list) or not all(isinstance(row, list) for row in value):
            raise InputError(f"{where} must be a list of lists of numbers, not {brief(value)}.")
        return tuple(tuple(number(entry, where) for entry in row) for row in value)
    return build(registry, value, where, number)  # a kind inside a kind, such as `scaled`


def require(condition: Any, sentence: str) -> None:
    """Refuses a field of a kind with a sentence that names the remedy."""
    if not condition:
        raise InputError(sentence)


def require_three(values: tuple[float, ...], name: str) -> None:
    """Refuses a field that is no position, direction or set of angles."""
    require(len(values) == 3, f"{name} must be three numbers, not {brief(values)}.")


def interpolate(x: float, xs: tuple[float, ...], ys: tuple[float, ...]) -> float:
    """Piecewise linear through (xs, ys), constant beyond both ends."""
    return float(np.interp(x, xs, ys))
