"""Input ports that are declared by name and size, and read by name."""

from collections.abc import Callable, Iterable, Mapping
from inspect import signature
from typing import Any

import numpy as np
from pydrake.systems.framework import Context, DependencyTicket, InputPort, LeafSystem

from guiderail.models.common.errors import InputError


class SignalPorts:
    """The signals of a system whose input ports are not known before it is constructed: one vector port per name."""

    def __init__(self, system: LeafSystem, *signals: Mapping[str, int]):
        """
        Args:
            system: under construction; the ports are declared in it, in the order in which names first appear.
            signals: name to size, at least 1; those that name the same signal share its port.

        Raises:
            InputError: if a size is below 1, or a signal is given two sizes.
        """
        sizes: dict[str, int] = {}
        for name, size in (item for mapping in signals for item in mapping.items()):
            if size < 1:
                raise InputError(f"signal '{name}' needs a size of at least 1, not {size}")
            if sizes.setdefault(name, size) != size:
                raise InputError(f"signal '{name}' can't be of size {sizes[name]} and {size}: give it one size")
        self._ports = {name: system.DeclareVectorInputPort(name, size) for name, size in sizes.items()}

    @property
    def tickets(self) -> set[DependencyTicket]:
        """What depends on all of them."""
        return {port.ticket() for port in self._ports.values()}

    def port(self, name: str) -> InputPort:
        """The port of this name.

        Raises:
            InputError: if there is none.
        """
        if name not in self._ports:
            raise InputError(f"there is no signal '{name}', only {', '.join(self._ports) or 'none at all'}")
        return self._ports[name]

    def eval(self, context: Context) -> dict[str, np.ndarray]:
        """All of them by name; `context` is the system's."""
        return {name: port.Eval(context) for name, port in self._ports.items()}


def check_takes(function: Callable[..., Any], names: Iterable[str], what: str) -> None:
    """Refuses a function that can't be called with signals by these names, before anything moves.

    Args:
        function: what is called with them.
        names: of the signals.
        what: the function is, in a sentence.

    Raises:
        InputError: if it takes other names.
    """
    try:
        takes = signature(function)
    except (ValueError, TypeError):
        return  # one that is written in C doesn't say
    names = list(names)
    try:
        takes.bind(**dict.fromkeys(names))
    except TypeError:
        raise InputError(
            f"{what} is called with its signals by name, {', '.join(names) or 'none'}, and takes "
            f"{', '.join(takes.parameters) or 'none'}: give its function and its inputs the same names"
        ) from None
