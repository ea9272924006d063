"""Recorder of signals in declared state, which a reset clears."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from pydrake.systems.framework import Context, DiscreteValues, EventStatus, LeafSystem

from guiderail.systems.support import declarations as declare
from guiderail.systems.support.declarations import SignalPorts, output_getter


@dataclass(frozen=True)
class Recording:
    """Samples of named signals.

    Args:
        times: Start times of the N recorded control periods, (N,) [s]; signals are sampled at the end of each period.
        signals: Samples of each signal by name, (N, size).
    """

    times: np.ndarray
    signals: dict[str, np.ndarray]

    def __getitem__(self, name: str) -> np.ndarray:
        return self.signals[name]


class Recorder(LeafSystem):
    """Record named signals at the end of each control period.

    The sample at the instant k·period contains the values just before this instant. As in a row of a demonstration,
    these are the command since (k−1)·period and the resulting motion. Recording stops after `num_samples` samples. The
    samples are declared state, which a reset or an initialization clears.

    ``num_recorded`` is (1,), the number of samples so far. `recording` returns the samples.

    Args:
        signals: Size of each signal by name, at least one signal.
        num_samples: Maximum number of samples, at least 1.
        period: Control period [s], positive.
    """

    def __init__(self, signals: Mapping[str, int], num_samples: int, period: float):
        super().__init__()
        self._signals = SignalPorts(self, signals)
        self._sizes = {name: self._signals.port(name).size() for name in signals}
        self._width, self._num_samples, self._period = sum(self._sizes.values()), num_samples, period
        self._count = self.DeclareDiscreteState(1)
        self._samples = self.DeclareDiscreteState(num_samples * self._width)
        self.DeclareStateOutputPort("num_recorded", self._count)
        self._start = declare.update_after_start(self, period, self._record, declare.reset_to_default(self))

    get_signal_input_port = declare.get_signal_input_port
    get_num_recorded_output_port = output_getter("num_recorded", "number of samples so far, (1,)")

    def recording(self, context: Context) -> Recording:
        """Return a copy of the samples so far; `context` is this system's.

        Raises:
            RuntimeError: If `context` is the root context or belongs to another system.
        """
        self.ValidateContext(context)
        count = int(context.get_discrete_state().value(self._count)[0])
        samples = context.get_discrete_state().value(self._samples).reshape(-1, self._width)[:count]
        ends = np.cumsum(list(self._sizes.values()))
        columns = np.split(samples, ends[:-1], axis=1)
        return Recording(
            times=(np.arange(count) + declare.start_step(context, self._start, self._period)) * self._period,
            signals={name: column.copy() for name, column in zip(self._sizes, columns, strict=True)},
        )

    def _record(self, context: Context, discrete_state: DiscreteValues) -> EventStatus:
        count = int(context.get_discrete_state().value(self._count)[0])
        if count == self._num_samples:
            return EventStatus.DidNothing()
        row = np.concatenate(list(self._signals.eval(context).values()))
        samples = discrete_state.get_mutable_value(self._samples)
        samples[count * self._width : (count + 1) * self._width] = row
        discrete_state.get_mutable_value(self._count)[0] = count + 1
        return EventStatus.Succeeded()
