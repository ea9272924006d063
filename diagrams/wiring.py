"""Addition of a system to a diagram together with its connections."""

from __future__ import annotations

from typing import TypeVar

from pydrake.systems.framework import DiagramBuilder, OutputPort, System

AnySystem = TypeVar("AnySystem", bound=System)


def add_system(
    builder: DiagramBuilder, name: str, system: AnySystem, /, *ports: OutputPort, **named_ports: OutputPort
) -> AnySystem:
    """Add a named system, connect output ports to its inputs by order or by name, and return the system."""
    builder.AddNamedSystem(name, system)
    for index, port in enumerate(ports):
        builder.Connect(port, system.get_input_port(index))
    for input_name, port in named_ports.items():
        builder.Connect(port, system.GetInputPort(input_name))
    return system
