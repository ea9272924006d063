"""Rules that every LeafSystem of the core and of the siblings satisfies; see `tests/systems/test_every_system.py`."""

import ast
import inspect
import re

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import CacheIndex, DiscreteStateIndex, InputPort, OutputPort, PortDataType, ValueProducer

from guiderail.models.common.errors import InputError
from oracles.prerequisites import changed_outputs

EXCEPTIONS = ("InputError", "PolicyError", "DivergedError", "AttributeError")


def check_system(system):
    """Check the ports and their getters, and the prerequisites of the outputs of a system."""
    check_getters(system)
    check_prerequisites(system)


def classes(path):
    """Return the syntax trees of the classes of a file."""
    return [node for node in ast.parse(path.read_text()).body if isinstance(node, ast.ClassDef)]


def system_names(path):
    """Return the names of the classes of a file that derive from LeafSystem or ConvertibleSystem."""
    bases = ("LeafSystem", "ConvertibleSystem")
    return [c.name for c in classes(path) if any(isinstance(b, ast.Name) and b.id in bases for b in c.bases)]


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


def check_prerequisites(system):
    """Check that outputs depend only on inputs, parameters and discrete state.

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
    """Check that a file's outputs and cache entries have prerequisites, and that it raises only `EXCEPTIONS`."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
            name = node.func.attr
            if name in ("DeclareVectorOutputPort", "DeclareAbstractOutputPort", "DeclareCacheEntry"):
                assert "prerequisites_of_calc" in {keyword.arg for keyword in node.keywords}, f"line {node.lineno}"
        if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call):
            assert node.exc.func.id in EXCEPTIONS, f"line {node.lineno}"


def check_start_time(make, inputs, period, steps):
    """Check that the first output is the same if the simulation starts `steps` control periods later."""
    expected = _run_six_steps(make, inputs, period, 0.0)
    assert len(np.unique(expected, axis=0)) > 1
    np.testing.assert_allclose(_run_six_steps(make, inputs, period, steps * period), expected, rtol=0.0, atol=1e-9)


def _run_six_steps(make, inputs, period, start):
    """Return the first output at the initialization at time `start` and in the middle of six control steps.

    Args:
        make: Function that returns the system.
        inputs: Values of the input ports by name.
        period: Control period [s].
        start: Start time [s].
    """
    system = make()
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    context.SetTime(start)
    for name, value in inputs.items():
        system.GetInputPort(name).FixValue(context, value)
    simulator.Initialize()
    values = [system.get_output_port(0).Eval(context)]
    for step in range(6):
        simulator.AdvanceTo(start + (step + 0.5) * period)
        values.append(system.get_output_port(0).Eval(context))
    return values


def check_stale_outputs(system):
    """Check that no output is stale after a change of any input, parameter or state on the same context."""
    stale, _ = changed_outputs(system)
    assert not stale


def check_start(system):
    """Check that a system whose last command is a state refuses to command without an initialization."""
    source = inspect.getsource(type(system))
    if "unset_state(" not in source and "LastValidPose(" not in source:
        return
    context = system.CreateDefaultContext()
    for kind, name, port in ports(system):
        if kind == "input" and port.get_data_type() == PortDataType.kVectorValued:
            # A command that is not finite is replaced by the last one.
            port.FixValue(context, np.full(port.size(), np.nan if name == "desired_pose" else 0.5))
    errors = []
    for kind, _, port in ports(system):
        if kind == "output":
            try:
                port.Eval(context)
            except InputError as error:
                errors.append(str(error))
    assert any("has no start: call Simulator.Initialize()" in error for error in errors), errors


RULES = (check_start, check_getters, check_prerequisites, check_stale_outputs)
"""Checks of one system."""
