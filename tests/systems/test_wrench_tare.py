import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from guiderail.systems import WrenchTare

PERIOD = 0.125
BIAS = np.array([3.0, -2.0, 1.0, 0.3, -0.2, 0.1])


@pytest.fixture
def tare():
    """Return a tare of a measured wrench `BIAS`, its simulator, the context, and the value of the wrench."""
    system = WrenchTare(PERIOD, skipped=2, averaged=4)
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    port = system.get_measured_wrench_input_port().FixValue(context, BIAS)
    return system, simulator, context, port


def test_bias_is_removed_after_the_last_averaged_sample(tare):
    system, simulator, context, port = tare
    contact = np.array([0.0, 0.0, 5.0, 0.01, 0.0, 0.0])
    simulator.AdvanceTo(4.5 * PERIOD)  # five samples, of which two are skipped
    assert not system.is_tared(context)
    np.testing.assert_array_equal(system.get_tared_wrench_output_port().Eval(context), 0.0)
    simulator.AdvanceTo(5.5 * PERIOD)
    assert system.is_tared(context)
    port.GetMutableData().set_value(BIAS + contact)
    np.testing.assert_allclose(system.get_tared_wrench_output_port().Eval(context), contact, atol=1e-12)
    simulator.AdvanceTo(20.0 * PERIOD)  # later samples do not change the offset
    np.testing.assert_allclose(system.get_tared_wrench_output_port().Eval(context), contact, atol=1e-12)


def test_offset_is_the_mean_of_the_samples_after_the_skipped(tare):
    system, simulator, context, port = tare
    for step, value in enumerate([100.0, 100.0, 1.0, 2.0, 3.0, 6.0]):
        port.GetMutableData().set_value(np.full(6, value))
        simulator.AdvanceTo((step + 0.5) * PERIOD)
    port.GetMutableData().set_value(np.zeros(6))
    np.testing.assert_allclose(system.get_tared_wrench_output_port().Eval(context), -3.0)


@pytest.mark.parametrize("number", [np.nan, np.inf])
def test_samples_that_are_not_finite_are_ignored(tare, number):
    system, simulator, context, port = tare
    for step, value in enumerate([100.0, 100.0, 1.0, number, 2.0, 3.0, 6.0]):
        assert not system.is_tared(context)
        port.GetMutableData().set_value([value, *np.full(5, 0.0 if np.isfinite(value) else 1.0)])
        simulator.AdvanceTo((step + 0.5) * PERIOD)
    assert system.is_tared(context)
    port.GetMutableData().set_value(np.zeros(6))
    np.testing.assert_allclose(system.get_tared_wrench_output_port().Eval(context), [-3.0, *np.zeros(5)])


def test_initialization_restarts_the_tare(tare):
    system, simulator, context, port = tare
    simulator.AdvanceTo(PERIOD * 8)
    port.GetMutableData().set_value(2.0 * BIAS)
    context.SetTime(0.0)
    simulator.Initialize()
    np.testing.assert_array_equal(system.get_tared_wrench_output_port().Eval(context), 0.0)
    simulator.AdvanceTo(PERIOD * 8)
    np.testing.assert_allclose(system.get_tared_wrench_output_port().Eval(context), 0.0, atol=1e-12)
