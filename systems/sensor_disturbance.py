"""Sensor with scale error, bias, noise and delay."""

import numpy as np
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem

from guiderail.models.common.errors import InputError
from guiderail.systems.support.declarations import check_period, input_getter, output_getter


class SensorDisturbance(LeafSystem):
    """Add scale error, bias, white noise and delay to a measurement.

        y = s ∘ u(t − k h) + b + σ ∘ n,  n ~ N(0, 1), sampled once per period h

    s, b and the seed of the noise are parameters, which a reset samples and restores. An initialization restarts the
    noise and fills the delay line with zeros.

    .. pydrake_system::

        name: SensorDisturbance
        input_ports:
        - measurement
        output_ports:
        - disturbed_measurement

    Both are (n,), in the units of the sensor.

    Args:
        period: Period h of noise and delay [s], positive.
        noise: Standard deviations σ, (n,), not negative.
        delay: k periods, at least 0.

    Raises:
        InputError: If an argument is out of range.
    """

    def __init__(self, period: float, noise: np.ndarray, delay: int = 0):
        super().__init__()
        check_period(period)
        self._noise = np.array(noise, dtype=float)
        if self._noise.ndim != 1 or not (np.isfinite(self._noise) & (self._noise >= 0.0)).all():
            raise InputError(f"a sensor's noise is a standard deviation for each of its numbers, not {noise}")
        if delay < 0:
            raise InputError(f"a sensor's delay is a number of periods from 0, not {delay}")
        size, self._delay = len(self._noise), delay
        self._scale = self.DeclareNumericParameter(BasicVector(np.ones(size)))
        self._bias = self.DeclareNumericParameter(BasicVector(np.zeros(size)))
        self._seed = self.DeclareNumericParameter(BasicVector(np.zeros(1)))
        self._count = self.DeclareDiscreteState(1)
        self._noise_sample = self.DeclareDiscreteState(size)  # n
        self._delay_line = self.DeclareDiscreteState(delay * size) if delay else None  # oldest measurement first
        self._measurement_port = self.DeclareVectorInputPort("measurement", size)
        source = (
            self._measurement_port.ticket()
            if self._delay_line is None
            else self.discrete_state_ticket(self._delay_line)
        )
        self._disturbed_measurement_port = self.DeclareVectorOutputPort(
            "disturbed_measurement",
            size,
            self._calc_disturbed_measurement,
            prerequisites_of_calc={
                source,
                self.discrete_state_ticket(self._noise_sample),
                self.all_parameters_ticket(),
            },
        )
        self.DeclareInitializationDiscreteUpdateEvent(self._reset)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)

    get_measurement_input_port = input_getter("measurement", "undisturbed measurement, (n,)")
    get_disturbed_measurement_output_port = output_getter("disturbed_measurement", "disturbed measurement, (n,)")

    def set_error(self, context: Context, scale: np.ndarray, bias: np.ndarray, seed: int) -> None:
        """Set s and b, (n,) each, and the seed of the noise; `context` is this system's."""
        for index, values in ((self._scale, scale), (self._bias, bias), (self._seed, [seed])):
            context.get_mutable_numeric_parameter(index).SetFromVector(np.array(values, dtype=float))

    def _reset(self, context: Context, discrete_state: DiscreteValues) -> None:
        size = len(self._noise)
        discrete_state.set_value(self._count, np.zeros(1))
        discrete_state.set_value(self._noise_sample, np.zeros(size))
        if self._delay_line is not None:
            discrete_state.set_value(self._delay_line, np.zeros(self._delay * size))

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        count = context.get_discrete_state(self._count).value() + 1.0
        discrete_state.set_value(self._count, count)
        if self._noise.any():
            seed = context.get_numeric_parameter(self._seed).value()[0]
            sample = np.random.default_rng([int(seed), int(count[0])]).standard_normal(len(self._noise))
            discrete_state.set_value(self._noise_sample, sample)
        if self._delay_line is not None:
            line = context.get_discrete_state(self._delay_line).value()
            newest = self._measurement_port.Eval(context)
            discrete_state.set_value(self._delay_line, np.concatenate([line[len(newest) :], newest]))

    def _calc_disturbed_measurement(self, context: Context, output: BasicVector) -> None:
        if self._delay_line is None:
            measured = self._measurement_port.Eval(context)
        else:
            measured = context.get_discrete_state(self._delay_line).value()[: len(self._noise)]
        scale, bias = (context.get_numeric_parameter(index).value() for index in (self._scale, self._bias))
        noise = self._noise * context.get_discrete_state(self._noise_sample).value()
        output.SetFromVector(scale * measured + bias + noise)
