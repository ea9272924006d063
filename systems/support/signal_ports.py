"""Input ports declared and read by signal name."""

from collections.abc import Callable, Iterable, Mapping
from inspect import signature
from typing import Any

import numpy as np
from pydrake.systems.framework import Context, DependencyTicket, InputPort, LeafSystem

from guiderail.models.common.errors import InputError


class SignalPorts:
    """Vector input ports of a system, one per signal named in a constructor argument.

    Args:
        system: System under construction; ports are declared in the order in which names first appear.
        signals: Mappings from name to size, at least 1. Equal names share one port.

    Raises:
        InputError: If a size is below 1, or a signal has two sizes.
    """

    def __init__(self, system: LeafSystem, *signals: Mapping[str, int]):
        sizes: dict[str, int] = {}
        for name, size in (item for mapping in signals for item in mapping.items()):
            if size < 1:
                raise InputError(f"signal '{name}' needs a size of at least 1, not {size}")
            if sizes.setdefault(name, size) != size:
                raise InputError(f"signal '{name}' can't be of size {sizes[name]} and {size}: give it one size")
        self._ports = {name: system.DeclareVectorInputPort(name, size) for name, size in sizes.items()}

    @property
    def tickets(self) -> set[DependencyTicket]:
        """Tickets of all ports."""
        return {port.ticket() for port in self._ports.values()}

    def port(self, name: str) -> InputPort:
        """Return the port of the signal `name`.

        Raises:
            InputError: If there is no such signal.
        """
        if name not in self._ports:
            raise InputError(f"there is no signal '{name}', only {', '.join(self._ports) or 'none at all'}")
        return self._ports[name]

    def eval(self, context: Context) -> dict[str, np.ndarray]:
        """Return the values of all signals by name; `context` is the context of the system."""
        return {name: port.Eval(context) for name, port in self._ports.items()}


def check_takes(function: Callable[..., Any], names: Iterable[str], what: str) -> None:
    """Raise an `InputError` if a function does not accept `names` as keyword arguments; `what` is its description."""
    try:
        takes = signature(function)
    except (ValueError, TypeError):
        return  # functions written in C may have no signature
    names = list(names)
    try:
        takes.bind(**dict.fromkeys(names))
    except TypeError:
        raise InputError(
            f"{what} is called with its signals by name, {', '.join(names) or 'none'}, and takes "
            f"{', '.join(takes.parameters) or 'none'}: give its function and its inputs the same names"
        ) from None
