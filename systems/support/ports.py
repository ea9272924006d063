"""Getters of ports."""

from collections.abc import Callable

from pydrake.systems.framework import InputPort, LeafSystem, OutputPort


def input_getter(name: str, description: str) -> Callable[[LeafSystem], InputPort]:
    """Return a method that returns the input port `name`, for the body of a system's class.

    Args:
        name: Name of the port, which the system stores as `_<name>_port`.
        description: Signal, shape and unit, for the method's docstring.
    """

    def getter(self: LeafSystem) -> InputPort:
        return getattr(self, f"_{name}_port")

    getter.__name__, getter.__doc__ = f"get_{name}_input_port", f"Return the port of the {description}."
    return getter


def output_getter(name: str, description: str) -> Callable[[LeafSystem], OutputPort]:
    """Return a method that returns the output port `name`; see `input_getter`."""

    def getter(self: LeafSystem) -> OutputPort:
        return getattr(self, f"_{name}_port")

    getter.__name__, getter.__doc__ = f"get_{name}_output_port", f"Return the port of the {description}."
    return getter
