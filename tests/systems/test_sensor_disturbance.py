import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import TrajectorySource
from pydrake.trajectories import PiecewisePolynomial

from guiderail.models.common.errors import InputError
from guiderail.systems import SensorDisturbance

PERIOD = 0.125


def readings(seed=0, scale=1.0, bias=0.0, **options):
    """Return the outputs just before each instant, (8,), if the measurement is the time."""
    builder = DiagramBuilder()
    ramp = builder.AddSystem(TrajectorySource(PiecewisePolynomial.FirstOrderHold([0.0, 10.0], [[0.0, 10.0]])))
    sensor = builder.AddSystem(SensorDisturbance(PERIOD, **{"noise": np.zeros(1), **options}))
    builder.Connect(ramp.get_output_port(), sensor.get_measurement_input_port())
    simulator = Simulator(builder.Build())
    context = sensor.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    sensor.set_error(context, np.full(1, scale), np.full(1, bias), seed)
    outputs = []
    for step in range(1, 9):
        simulator.AdvanceTo(step * PERIOD)
        outputs.append(sensor.get_disturbed_measurement_output_port().Eval(context)[0])
    return np.array(outputs)


TIMES = PERIOD * np.arange(1, 9)


def test_measurement_is_unchanged_without_disturbance():
    np.testing.assert_allclose(readings(), TIMES)


def test_scale_and_bias_are_applied():
    np.testing.assert_allclose(readings(scale=2.0, bias=-0.5), 2.0 * TIMES - 0.5)


def test_measurement_is_delayed_by_whole_periods():
    np.testing.assert_allclose(readings(delay=2), np.maximum(TIMES - 2.0 * PERIOD, 0.0), atol=1e-12)


def test_noise_has_its_deviation_and_repeats_with_its_seed():
    first, repeated, other = (readings(seed=seed, noise=np.array([0.1])) - TIMES for seed in (3, 3, 4))
    assert 0.02 < first.std() < 0.3
    np.testing.assert_array_equal(repeated, first)
    assert not np.allclose(other, first)


def test_initialization_restarts_noise_and_delay():
    """Noise repeats with its seed, and the delay line contains no earlier measurement."""
    sensor = SensorDisturbance(PERIOD, np.ones(2), delay=3)
    simulator = Simulator(sensor)
    context = simulator.get_mutable_context()
    measured = sensor.get_measurement_input_port().FixValue(context, np.full(2, 5.0))
    episodes = []
    for value in (5.0, 7.0):
        measured.GetMutableData().set_value(np.full(2, value))
        context.SetTime(0.0)
        simulator.Initialize()
        readings = [sensor.get_disturbed_measurement_output_port().Eval(context).copy()]
        for step in range(3):
            simulator.AdvanceTo((step + 0.5) * PERIOD)
            readings.append(sensor.get_disturbed_measurement_output_port().Eval(context) - value * (step == 2))
        episodes.append(readings)
    np.testing.assert_array_equal(episodes[0][0], 0.0)
    np.testing.assert_allclose(episodes[1], episodes[0], atol=1e-12)


def test_delay_of_an_episode_is_at_most_the_constructor_argument():
    sensor = SensorDisturbance(PERIOD, np.zeros(1), delay=3)
    simulator = Simulator(sensor)
    context = simulator.get_mutable_context()
    measured = sensor.get_measurement_input_port().FixValue(context, np.zeros(1))
    for delay in (1, 2, 3):
        context.SetTime(0.0)
        simulator.Initialize()
        sensor.set_delay(context, delay)
        for step in range(6):
            measured.GetMutableData().set_value([float(step)])
            simulator.AdvanceTo((step + 0.5) * PERIOD)
        # The newest sample is that of step 5, which is output if the delay is 1.
        assert sensor.get_disturbed_measurement_output_port().Eval(context)[0] == 6 - delay
    for delay in (0, 1.5, 4, np.nan):
        with pytest.raises(InputError, match="from 1 to 3"):
            sensor.set_delay(context, delay)


def test_drift_is_a_random_walk_with_its_deviation():
    drifts = np.array([readings(seed=seed, drift=np.array([1.0])) - TIMES for seed in range(60)])
    assert drifts[:, -1].std() == pytest.approx(np.sqrt(0.1), rel=0.3)  # drift is the deviation after 10 s; here 1 s
    assert np.abs(np.diff(drifts)).mean() < 0.5 * np.abs(drifts[:, -1]).mean()


def test_bias_depends_on_the_configuration():
    sensor = SensorDisturbance(PERIOD, np.zeros(2), configuration_size=3)
    context = sensor.CreateDefaultContext()
    sensor.get_measurement_input_port().FixValue(context, np.ones(2))
    configuration = sensor.get_configuration_input_port().FixValue(context, np.array([1.0, 2.0, 3.0]))
    gradient = np.arange(6.0).reshape(2, 3)
    sensor.set_gradient(context, gradient)
    simulator = Simulator(sensor, context)
    simulator.Initialize()
    np.testing.assert_allclose(sensor.get_disturbed_measurement_output_port().Eval(context), 1.0)
    configuration.GetMutableData().set_value([1.5, 2.0, 4.0])
    expected = 1.0 + gradient @ [0.5, 0.0, 1.0]
    np.testing.assert_allclose(sensor.get_disturbed_measurement_output_port().Eval(context), expected)


def test_each_number_has_its_own_errors_computed_from_the_seed():
    """The first number has noise, the second a drift, and the third is rounded."""
    noise, drift, resolution = np.array([0.1, 0.0, 0.0]), np.array([0.0, 0.2, 0.0]), np.array([0.0, 0.0, 0.25])
    sensor = SensorDisturbance(PERIOD, noise, drift=drift, resolution=resolution)
    simulator = Simulator(sensor)
    context = simulator.get_mutable_context()
    sensor.get_measurement_input_port().FixValue(context, [1.0, 2.0, 3.3])
    sensor.set_error(context, np.array([2.0, 0.5, 1.0]), np.array([0.1, -0.2, 0.0]), 7)
    noise_copy, drift_copy = noise.copy(), drift.copy()
    for argument in (noise, drift, resolution):
        argument[:] = 9.0  # without effect: the sensor has copies
    walk = np.zeros(3)
    for step in range(1, 1002):
        simulator.AdvanceTo((step - 0.5) * PERIOD)
        rng = np.random.default_rng([7, step])
        sample = noise_copy * rng.standard_normal(3)
        walk += np.sqrt(PERIOD / 10.0) * drift_copy * rng.standard_normal(3)
        expected = np.array([2.1, 0.8, 3.25]) + sample + walk
        disturbed = sensor.get_disturbed_measurement_output_port().Eval(context)
        np.testing.assert_allclose(disturbed, expected, rtol=1e-12)


def test_measurement_is_rounded_to_the_resolution():
    np.testing.assert_allclose(readings(resolution=np.array([0.3]), bias=0.01), np.round((TIMES + 0.01) / 0.3) * 0.3)


def test_noise_is_sampled_when_there_is_no_drift():
    sensor = SensorDisturbance(PERIOD, np.array([0.1, 0.0]))
    simulator = Simulator(sensor)
    context = simulator.get_mutable_context()
    sensor.get_measurement_input_port().FixValue(context, np.zeros(2))
    simulator.AdvanceTo(0.5 * PERIOD)
    expected = [0.1 * np.random.default_rng([0, 1]).standard_normal(2)[0], 0.0]
    np.testing.assert_allclose(sensor.get_disturbed_measurement_output_port().Eval(context), expected)


def test_constant_measurement_arrives_after_the_delay():
    sensor = SensorDisturbance(PERIOD, np.zeros(1), delay=3, configuration_size=2)
    simulator = Simulator(sensor)
    context = simulator.get_mutable_context()
    sensor.get_measurement_input_port().FixValue(context, [5.0])
    configuration = sensor.get_configuration_input_port().FixValue(context, [1.0, 2.0])
    values = []
    for step in range(1, 5):
        simulator.AdvanceTo((step - 0.5) * PERIOD)
        values.append(sensor.get_disturbed_measurement_output_port().Eval(context)[0])
    assert values == [0.0, 0.0, 5.0, 5.0]
    configuration.GetMutableData().set_value([3.0, 4.0])  # without effect: the gradient is zero
    assert sensor.get_disturbed_measurement_output_port().Eval(context)[0] == 5.0
