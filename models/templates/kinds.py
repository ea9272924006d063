"""Registries of the kinds of input mapping, active constraint and transition distance.

A kind is a frozen dataclass whose fields are the entries of a template file. The name of an entry with a unit contains
the unit. A kind is registered under its name in template files:

    @register(ACTIVE_CONSTRAINTS, "half_space")
    @dataclass(frozen=True)
    class HalfSpace(ActiveConstraint): ...
"""

import math
from collections.abc import Callable
from dataclasses import is_dataclass
from numbers import Real
from typing import Any, TypeVar

from guiderail.models.common.errors import InputError, brief

INPUT_MAPPINGS: dict[str, type] = {}
ACTIVE_CONSTRAINTS: dict[str, type] = {}
TRANSITION_DISTANCES: dict[str, type] = {}

Kind = TypeVar("Kind", bound=type)


def register(registry: dict[str, type], name: str) -> Callable[[Kind], Kind]:
    """Return a decorator that makes a dataclass available to template files as a `kind` of a registry.

    Raises:
        InputError: When the decorator is applied, if another kind has the name, the name is not a text or is empty, or
            the decorated object is not a dataclass or lacks a method.
    """

    def add(kind: Kind) -> Kind:
        require(isinstance(name, str) and name, f"a kind is registered by a name, not {brief(name)}")
        is_class = isinstance(kind, type) and is_dataclass(kind)
        require(is_class, f"the kind {name!r} must be a dataclass, not {brief(kind)}: add @dataclass(frozen=True)")
        missing = ", ".join(sorted(getattr(kind, "__abstractmethods__", ())))
        require(not missing, f"the kind {name!r} lacks {missing}: implement what its base class declares")
        existing = registry.get(name, kind)
        is_same = (existing.__module__, existing.__qualname__) == (kind.__module__, kind.__qualname__)
        require(is_same, f"there is a kind {name!r} already, {existing.__name__}: choose another name")
        registry[name] = kind
        return kind

    return add


def require(condition: Any, sentence: str) -> None:
    """Raise an `InputError` with `sentence` unless `condition` holds; for a kind's `__post_init__`."""
    if not condition:
        raise InputError(sentence)


def require_finite(value: float, name: str) -> None:
    """Raise an `InputError` unless a number is finite."""
    require(isinstance(value, Real) and math.isfinite(value), f"{name} must be finite, not {brief(value)}.")


def require_three(values: tuple[float, ...], name: str) -> None:
    """Raise an `InputError` unless a position, direction or set of angles has three numbers."""
    require(len(values) == 3, f"{name} must be three numbers, not {brief(values)}.")
