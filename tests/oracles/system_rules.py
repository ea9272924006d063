"""Rules that every LeafSystem of the project satisfies, for the tests of the core and of its siblings.

- Each port has a typed and documented getter, and the docstring of the class lists all ports.
- Outputs declare their prerequisites and depend only on inputs, parameters and discrete state.
- The source raises only `InputError`, `PolicyError`, `DivergedError` and `AttributeError`.
"""

import ast
import inspect
import re

from pydrake.common.value import Value
from pydrake.systems.framework import CacheIndex, DiscreteStateIndex, InputPort, OutputPort, ValueProducer


def classes(path):
    """Return the syntax trees of the classes of a file."""
    return [node for node in ast.parse(path.read_text()).body if isinstance(node, ast.ClassDef)]


def system_names(path):
    """Return the names of the classes of a file that derive from LeafSystem."""
    return [c.name for c in classes(path) if any(isinstance(b, ast.Name) and b.id == "LeafSystem" for b in c.bases)]


def ports(system):
    """Yield kind ("input" or "output"), name and port of each port of a system."""
    for kind in ("input", "output"):
        for index in range(getattr(system, f"num_{kind}_ports")()):
            port = getattr(system, f"get_{kind}_port")(index)
            yield kind, port.get_name(), port


def getters(system, kind):
    """Return the getters of ports of a kind that the class of the system defines, by name."""
    return {name: getattr(system, name) for name in vars(type(system)) if re.fullmatch(rf"get_\w+_{kind}_port", name)}


def check_getters(system):
    """Check that every port has a typed and documented getter."""
    for kind, name, port in ports(system):
        methods = getters(system, kind)
        method = methods.get(f"get_{name}_{kind}_port")
        if method is not None:
            result = method()
        else:
            # Ports whose names are constructor arguments share a getter with the argument `name`.
            (method,) = (m for m in methods.values() if "name" in inspect.signature(m).parameters)
            result = method(name)
        assert result is port
        assert inspect.signature(method).return_annotation is (InputPort if kind == "input" else OutputPort)
        assert inspect.getdoc(method)


def check_documented_ports(system):
    """Check that the docstring of the class lists the ports of the system."""
    (block,) = re.findall(r"\.\. pydrake_system::\n\n((?:    .*\n)+)", inspect.getdoc(type(system)) + "\n")
    assert re.search(r"name: (\w+)", block)[1] == type(system).__name__
    for kind in ("input", "output"):
        documented = re.search(rf"{kind}_ports:\n((?: *- .*\n)+)", block)
        lines = re.findall(r"- (.*)", documented[1]) if documented else []
        actual = [name for k, name, _ in ports(system) if k == kind]
        named = [line.split(" (")[0] for line in lines if not line.startswith("one per ")]
        assert actual[: len(named)] == named
        assert len(actual) == len(named) or len(named) < len(lines)


def check_prerequisites(system):
    """Check that outputs depend only on declared inputs, parameters and discrete state.

    Default prerequisites would cause an evaluation at every plant step and false direct feedthrough.
    """
    nothing, parameters = system.nothing_ticket(), system.all_parameters_ticket()
    probe = system.DeclareCacheEntry(
        "probe", ValueProducer(allocate=lambda: Value(0), calc=lambda context, value: None), {nothing}
    )
    entries = [system.get_cache_entry(CacheIndex(i)) for i in range(int(probe.cache_index()))]
    declared = {int(e.ticket()): e for e in entries if int(e.ticket()) > int(system.configuration_ticket())}
    sources = {int(nothing), int(parameters)}
    sources |= {int(port.ticket()) for kind, _, port in ports(system) if kind == "input"}
    states = range(system.CreateDefaultContext().num_discrete_state_groups())
    sources |= {int(system.discrete_state_ticket(DiscreteStateIndex(i))) for i in states}
    outputs = [e for e in entries if e.description().startswith("output port ")]
    assert len(outputs) == system.num_output_ports()
    pending = list(outputs)
    while pending:
        entry = pending.pop()
        assert not entry.has_default_prerequisites(), entry.description()
        for ticket in map(int, entry.prerequisites()):
            if ticket in declared:
                pending.append(declared[ticket])
            else:
                assert ticket in sources, f"{entry.description()} depends on ticket {ticket}"


def check_source(path):
    """Check that a file gives prerequisites and raises only errors for users."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
            name = node.func.attr
            if name in ("DeclareVectorOutputPort", "DeclareAbstractOutputPort", "DeclareCacheEntry"):
                assert "prerequisites_of_calc" in {keyword.arg for keyword in node.keywords}, f"line {node.lineno}"
        if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call):
            exceptions = ("InputError", "PolicyError", "DivergedError", "AttributeError")
            assert node.exc.func.id in exceptions, f"line {node.lineno}"


RULES = (check_getters, check_documented_ports, check_prerequisites)
