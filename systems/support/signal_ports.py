"""Input ports that are declared by name and size, and read by name."""

from collections.abc import Mapping

import numpy as np
from pydrake.systems.framework import Context, DependencyTicket, InputPort, LeafSystem

from guiderail.models.errors import InputError


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
