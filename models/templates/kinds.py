"""Registries of the kinds of input mapping, active constraint and transition distance.

A kind is a frozen dataclass whose fields are the entries that a template file may give. The name of an entry with a
unit contains the unit. A kind is registered under the name that the file uses:

    @register(ACTIVE_CONSTRAINTS, "half_space")
    @dataclass(frozen=True)
    class HalfSpace(ActiveConstraint): ...
"""

import math
from collections.abc import Callable
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
        ValueError: If the name is taken.
    """

    def add(kind: Kind) -> Kind:
        if name in registry:
            raise ValueError(f"{name} is already registered, by {registry[name].__name__}")
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
