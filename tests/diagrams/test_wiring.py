"""Connections that `add_system` makes, and terms of an observation."""

import numpy as np
import pytest
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import Adder, ConstantVectorSource, PassThrough

from guiderail.diagrams.envs.observation import Observation, ObservationTerm
from guiderail.diagrams.wiring import add_system


def test_add_system_connects_ports_in_order():
    builder = DiagramBuilder()
    first, second = (add_system(builder, name, ConstantVectorSource([x])) for name, x in (("one", 1.0), ("two", 2.0)))
    adder = Adder(2, 1)
    assert add_system(builder, "sum", adder, first.get_output_port(), second.get_output_port()) is adder
    diagram = builder.Build()
    context = adder.GetMyContextFromRoot(diagram.CreateDefaultContext())
    assert [adder.get_input_port(index).Eval(context) for index in range(2)] == [1.0, 2.0]
    assert diagram.GetSubsystemByName("sum") is adder


@pytest.mark.parametrize("waits", [False, True])
def test_observation_contains_a_signal_for_each_term(waits):
    sizes = dict.fromkeys(("observed", "scaled", "clipped", "motion_time"), 1)
    terms = [ObservationTerm(name, scale=scale) for scale in (1.0, 0.5) for name in (*sizes, "time", "phase")]
    observation = Observation(terms, sizes, duration=4.0, clip=100.0, waits=waits)
    context = observation.CreateDefaultContext()
    context.SetTime(2.0)
    for value, name in enumerate(sizes):
        observation.GetInputPort(name).FixValue(context, [float(value)])
    once = np.array([0.0, 1.0, 2.0, 3.0, *((3.0, 0.5) if waits else (2.0, 0.0))])
    observed = observation.get_observation_output_port().Eval(context)
    np.testing.assert_allclose(observed, [*once, *(2.0 * once)], atol=1e-12)


def test_add_system_connects_ports_named_like_its_arguments():
    builder = DiagramBuilder()
    terms = [ObservationTerm(name) for name in ("name", "system", "builder")]
    observation = Observation(terms, dict.fromkeys(("name", "system", "builder"), 1), duration=1.0, clip=10.0)
    ports = {
        term.signal: add_system(builder, f"source_{index}", ConstantVectorSource([float(index)])).get_output_port()
        for index, term in enumerate(terms)
    }
    add_system(builder, "observation", observation, **ports)
    copy = add_system(builder, "copy", PassThrough(3), observation.get_observation_output_port())
    diagram = builder.Build()
    context = copy.GetMyContextFromRoot(diagram.CreateDefaultContext())
    np.testing.assert_array_equal(copy.get_output_port().Eval(context), [0.0, 1.0, 2.0])
