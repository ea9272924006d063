"""Disturbances of measurements and commands: errors of a sensor, and a channel that delays and loses commands."""

import numpy as np
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem

from guiderail.models.common.arrays import as_numbers, as_whole
from guiderail.models.common.errors import InputError
from guiderail.systems.support import declarations as declare
from guiderail.systems.support.declarations import input_getter, output_getter

DRIFT_TIME = 10.0
"""Time after which a drift has its specified standard deviation [s]."""


class SensorDisturbance(LeafSystem):
    """Add scale error, bias, drift, white noise, delay and rounding to a measurement.

        y = s ∘ u(t − k h) + b + C (x − x₀) + d + σ ∘ n,  n ~ N(0, 1), sampled once per period h

    The result is rounded to whole multiples of the resolution. u is the measurement, s the scale, k the delay, b the
    bias, and d the drift, a random walk. C is the gradient of the error over the configuration x, and x₀ is the
    configuration at initialization. s, b, C, k and the seed of noise and drift are parameters of the context, which a
    reset sets. An initialization restarts noise and drift and fills the delay line with zeros.

    ``measurement`` and ``disturbed_measurement`` are (n,), in the units of the sensor. ``configuration`` is (m,).

    Args:
        period: Period h of noise, drift and delay [s], positive.
        noise: Standard deviations σ, (n,), not negative.
        delay: Default and largest value of k [periods], at least 0. `set_delay` changes k to a value from 1 to `delay`.
        drift: Standard deviations of d after `DRIFT_TIME`, (n,), not negative; none by default.
        resolution: Resolution of the output, (n,), not negative; 0, the default, disables rounding.
        configuration_size: Size m of the configuration; 0 if the error does not depend on a configuration.
    """

    def __init__(
        self,
        period: float,
        noise: np.ndarray,
        delay: int = 0,
        *,
        drift: np.ndarray | None = None,
        resolution: np.ndarray | None = None,
        configuration_size: int = 0,
    ):
        super().__init__()
        self._noise = as_numbers(noise, "noise")
        size, self._delay = len(self._noise), delay
        self._drift = np.zeros(size) if drift is None else as_numbers(drift, "drift")
        self._resolution = np.zeros(size) if resolution is None else as_numbers(resolution, "resolution")
        self._has_noise, self._has_drift = bool(self._noise.any()), bool(self._drift.any())
        self._is_rounded = self._resolution > 0.0
        self._rounds_any, self._unit = bool(self._is_rounded.any()), np.where(self._is_rounded, self._resolution, 1.0)
        self._scale = self.DeclareNumericParameter(BasicVector(np.ones(size)))
        self._bias = self.DeclareNumericParameter(BasicVector(np.zeros(size)))
        self._seed = self.DeclareNumericParameter(BasicVector(np.zeros(1)))
        self._used_delay = self.DeclareNumericParameter(BasicVector(np.full(1, float(delay))))
        self._gradient = self.DeclareNumericParameter(BasicVector(np.zeros(max(size * configuration_size, 1))))
        self._count = self.DeclareDiscreteState(1)
        self._noise_sample = self.DeclareDiscreteState(size)  # n
        self._walk = self.DeclareDiscreteState(size)  # d
        self._first_configuration = self.DeclareDiscreteState(configuration_size) if configuration_size else None
        self._delay_line = self.DeclareDiscreteState(delay * size) if delay else None  # oldest measurement first
        self._measurement_port = self.DeclareVectorInputPort("measurement", size)
        self._configuration_port = (
            self.DeclareVectorInputPort("configuration", configuration_size) if configuration_size else None
        )
        sources = [self._measurement_port if self._delay_line is None else self._delay_line]
        if self._configuration_port is not None:
            sources += [self._configuration_port, self._first_configuration]
        sources += [self._noise_sample, self._walk, self.all_parameters_ticket()]
        declare.output(self, "disturbed_measurement", size, self._disturbed_measurement, sources)
        self._set_default = declare.reset_to_default(self)
        declare.update(self, period, self._update, self._reset)
        self._step = np.sqrt(period / DRIFT_TIME)

    get_measurement_input_port = input_getter("measurement", "undisturbed measurement, (n,)")
    get_configuration_input_port = input_getter("configuration", "configuration, (m,), if its size is not 0")
    get_disturbed_measurement_output_port = output_getter("disturbed_measurement", "disturbed measurement, (n,)")

    def set_error(self, context: Context, scale: np.ndarray, bias: np.ndarray, seed: int) -> None:
        """Set scale s (n,), bias b (n,) in the units of the sensor, and the seed of noise and drift.

        `context` is this system's.
        """
        parameters = ((self._scale, scale), (self._bias, bias), (self._seed, [seed]))
        for index, values in parameters:
            context.get_mutable_numeric_parameter(index).SetFromVector(np.array(values, dtype=float))

    def set_delay(self, context: Context, delay: int) -> None:
        """Set the delay k in periods; `context` is this system's.

        Raises:
            InputError: If `delay` is not a whole number from 1 to the largest delay.
        """
        delay = as_whole(delay, "this sensor's delay in periods", 1, self._delay)
        context.get_mutable_numeric_parameter(self._used_delay).SetAtIndex(0, float(delay))

    def set_gradient(self, context: Context, gradient: np.ndarray) -> None:
        """Set the gradient C (n, m) of the error over the configuration; `context` is this system's."""
        context.get_mutable_numeric_parameter(self._gradient).SetFromVector(np.ravel(gradient))

    def _reset(self, context: Context, discrete_state: DiscreteValues) -> None:
        self._set_default(context, discrete_state)
        if self._configuration_port is not None:
            discrete_state.set_value(self._first_configuration, self._configuration_port.Eval(context))

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        count = context.get_discrete_state().value(self._count) + 1.0
        discrete_state.set_value(self._count, count)
        if self._has_noise or self._has_drift:
            seed = context.get_numeric_parameter(self._seed).value().item()
            rng = np.random.default_rng([int(seed), int(count.item())])
            discrete_state.set_value(self._noise_sample, rng.standard_normal(len(self._noise)))
            if self._has_drift:
                walk = context.get_discrete_state().value(self._walk)
                step = self._step * self._drift * rng.standard_normal(len(self._drift))
                discrete_state.set_value(self._walk, walk + step)
        if self._delay_line is not None:
            line = context.get_discrete_state().value(self._delay_line)
            newest = self._measurement_port.Eval(context)
            discrete_state.set_value(self._delay_line, np.concatenate([line[len(newest) :], newest]))

    def _disturbed_measurement(self, context: Context) -> np.ndarray:
        if self._delay_line is None:
            measured = self._measurement_port.Eval(context)
        else:
            offset = self._delay - int(context.get_numeric_parameter(self._used_delay).value().item())
            size = len(self._noise)
            measured = context.get_discrete_state().value(self._delay_line)[offset * size :][:size]
        scale, bias = (context.get_numeric_parameter(index).value() for index in (self._scale, self._bias))
        noise = self._noise * context.get_discrete_state().value(self._noise_sample)
        disturbed = scale * measured + bias + noise
        if self._has_drift:
            disturbed = disturbed + context.get_discrete_state().value(self._walk)
        if self._configuration_port is not None:
            first = context.get_discrete_state().value(self._first_configuration)
            gradient = context.get_numeric_parameter(self._gradient).value().reshape(len(noise), -1)
            disturbed = disturbed + gradient @ (self._configuration_port.Eval(context) - first)
        if self._rounds_any:
            disturbed = np.where(self._is_rounded, np.round(disturbed / self._unit) * self._unit, disturbed)
        return disturbed


class CommandDisturbance(LeafSystem):
    """Delay commands and lose some at random; a lost command is replaced by the last delivered command.

        y_t = y_{t−1} with probability p, otherwise u_{t−k},  t = 0, 1, …

    u_t is the command of period t, and y_t is the delivered command. y_{−1} and u_{−1}, …, u_{−k} are the measured pose
    at initialization. Every command, including the first, is therefore delayed by k periods.

    All ports have size n. ``pose`` is the measured pose, read at initialization only.

    Args:
        size: Size n of a command, at least 1.
        period: Period of the commands [s], positive.
        loss_probability: Probability p that a command is lost, from 0 to less than 1.
        delay: Delay k of a command, in periods, at least 0.

    Raises:
        InputError: If the probability is out of range; at initialization, if the measured pose is not finite.
    """

    def __init__(self, size: int, period: float, loss_probability: float = 0.0, delay: int = 0):
        super().__init__()
        if not 0.0 <= loss_probability < 1.0:
            raise InputError(f"the probability that a command is lost is from 0 to less than 1, not {loss_probability}")
        self._loss_probability, self._delay = loss_probability, delay
        self._seed = self.DeclareNumericParameter(BasicVector(np.zeros(1)))
        self._count = self.DeclareDiscreteState(1)
        self._is_lost = self.DeclareDiscreteState(1)
        self._last_delivered = declare.unset_state(self, size)
        self._delay_line = declare.unset_state(self, delay * size) if delay else None  # oldest command first
        self._command_port = self.DeclareVectorInputPort("command", size)
        self._pose_port = self.DeclareVectorInputPort("pose", size)
        source = self._command_port if self._delay_line is None else self._delay_line
        declare.output(self, "delivered_command", size, self._delivered, [self._is_lost, self._last_delivered, source])
        declare.update(self, period, self._update, self._reset)
        self._start = declare.start_time(self)

    get_command_input_port = input_getter("command", "command, (n,)")
    get_pose_input_port = input_getter("pose", "measured pose, (n,)")
    get_delivered_command_output_port = output_getter("delivered_command", "delivered command, (n,)")

    def set_seed(self, context: Context, seed: int) -> None:
        """Set the seed of the random losses; `context` is this system's."""
        context.get_mutable_numeric_parameter(self._seed).SetFromVector([seed])

    def _reset(self, context: Context, discrete_state: DiscreteValues) -> None:
        pose = declare.start_pose(self._pose_port.Eval(context))
        discrete_state.set_value(self._count, [0.0])
        discrete_state.set_value(self._is_lost, [0.0])
        discrete_state.set_value(self._last_delivered, pose)
        if self._delay_line is not None:
            discrete_state.set_value(self._delay_line, np.tile(pose, self._delay))

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        count = context.get_discrete_state().value(self._count).item() + 1.0
        discrete_state.set_value(self._count, [count])
        # At initialization no period has ended, and the value at the port is not a command.
        has_ended = declare.has_started(context, self._start)
        if has_ended:
            discrete_state.set_value(self._last_delivered, self._delivered(context))
        if has_ended and self._delay_line is not None:
            command = self._command_port.Eval(context)
            line = context.get_discrete_state().value(self._delay_line)
            discrete_state.set_value(self._delay_line, np.concatenate([line[len(command) :], command]))
        if self._loss_probability > 0.0:
            seed = context.get_numeric_parameter(self._seed).value().item()
            sample = np.random.default_rng([int(seed), int(count)]).uniform()
            discrete_state.set_value(self._is_lost, [float(sample < self._loss_probability)])

    def _delivered(self, context: Context) -> np.ndarray:
        last = declare.initialized(self, context, self._last_delivered)
        if context.get_discrete_state().value(self._is_lost).item():
            return last
        if self._delay_line is None:
            return self._command_port.Eval(context)
        return context.get_discrete_state().value(self._delay_line)[: len(last)]
