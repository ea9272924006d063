"""A sensor that is not what it should be."""

import numpy as np
from pydrake.systems.framework import (
    BasicVector,
    Context,
    DiscreteValues,
    EventStatus,
    InputPort,
    LeafSystem,
    OutputPort,
)

from guiderail.models.common.errors import InputError
from guiderail.systems.support.sampling import check_period


class SensorDisturbance(LeafSystem):
    """Scales, offsets, delays and blurs what a sensor measured.

        y = s ∘ u(t − k h) + b + σ ∘ n,  n ~ N(0, 1) anew every period h

    s and b are parameters, as is the seed of the noise: a reset draws and restores them. At initialization the noise
    begins anew, and nothing was measured yet: what is late is zero.

    .. pydrake_system::

        name: SensorDisturbance
        input_ports:
        - measurement
        output_ports:
        - disturbed_measurement

    Both are (n,), in the sensor's units.
    """

    def __init__(self, period: float, noise: np.ndarray, delay: int = 0):
        """
        Args:
            period: h of noise and delay [s], positive.
            noise: σ, (n,), not negative.
            delay: k periods, from 0.

        Raises:
            InputError: if an argument is out of range.
        """
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
        self._newest = self.DeclareDiscreteState(size)  # n
        self._late = self.DeclareDiscreteState(delay * size) if delay else None  # the oldest first
        self._measurement_port = self.DeclareVectorInputPort("measurement", size)
        source = self._measurement_port.ticket() if self._late is None else self.discrete_state_ticket(self._late)
        self._disturbed_measurement_port = self.DeclareVectorOutputPort(
            "disturbed_measurement",
            size,
            self._calc_disturbed,
            prerequisites_of_calc={source, self.discrete_state_ticket(self._newest), self.all_parameters_ticket()},
        )
        self.DeclareInitializationDiscreteUpdateEvent(self._start)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)

    def get_measurement_input_port(self) -> InputPort:
        """What the sensor should say, (n,)."""
        return self._measurement_port

    def get_disturbed_measurement_output_port(self) -> OutputPort:
        """What it says, (n,)."""
        return self._disturbed_measurement_port

    def set_error(self, context: Context, scale: np.ndarray, bias: np.ndarray, seed: int) -> None:
        """Sets s and b, (n,) each, and what the noise is drawn from; `context` is this system's own."""
        for index, values in ((self._scale, scale), (self._bias, bias), (self._seed, [seed])):
            context.get_mutable_numeric_parameter(index).SetFromVector(np.array(values, dtype=float))

    def _start(self, context: Context, discrete_state: DiscreteValues) -> EventStatus:
        size = len(self._noise)
        discrete_state.set_value(self._count, np.zeros(1))
        discrete_state.set_value(self._newest, np.zeros(size))
        if self._late is not None:
            discrete_state.set_value(self._late, np.zeros(self._delay * size))
        return EventStatus.Succeeded()

    def _update(self, context: Context, discrete_state: DiscreteValues) -> EventStatus:
        count = context.get_discrete_state(self._count).value() + 1.0
        discrete_state.set_value(self._count, count)
        if self._noise.any():
            seed = context.get_numeric_parameter(self._seed).value()[0]
            drawn = np.random.default_rng([int(seed), int(count[0])]).standard_normal(len(self._noise))
            discrete_state.set_value(self._newest, drawn)
        if self._late is not None:
            late = context.get_discrete_state(self._late).value()
            newest = self._measurement_port.Eval(context)
            discrete_state.set_value(self._late, np.concatenate([late[len(newest) :], newest]))
        return EventStatus.Succeeded()

    def _calc_disturbed(self, context: Context, output: BasicVector) -> None:
        if self._late is None:
            measured = self._measurement_port.Eval(context)
        else:
            measured = context.get_discrete_state(self._late).value()[: len(self._noise)]
        scale, bias = (context.get_numeric_parameter(index).value() for index in (self._scale, self._bias))
        noise = self._noise * context.get_discrete_state(self._newest).value()
        output.SetFromVector(scale * measured + bias + noise)
