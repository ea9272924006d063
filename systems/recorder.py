"""Remembers what was commanded and what came of it, sample by sample."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydrake.systems.framework import Context, DiscreteValues, EventStatus, LeafSystem

from guiderail.models.errors import InputError


@dataclass(frozen=True)
class Recording:
    """N samples. `times` (N,) [s] say since when the command of a sample had acted; the rest was read at its end."""

    times: np.ndarray
    signals: dict[str, np.ndarray]  # name to (N, size)

    def __getitem__(self, name: str) -> np.ndarray:
        return self.signals[name]


class Recorder(LeafSystem):
    """Samples named signals once a control period, at its end, into state that a reset clears.

    At the instant k·period it takes in what its inputs were just before: the command that acted since (k−1)·period and
    what it led to. That makes one row of a demonstration. Once `num_samples` are full it records no more.

    .. pydrake_system::

        name: Recorder
        input_ports:
        - one per signal
        output_ports:
        - num_recorded

    `num_recorded` is (1,). The samples themselves are read with `recording`.
    """

    def __init__(self, signals: dict[str, int], num_samples: int, period: float):
        """
        Args:
            signals: name to size of what is recorded, at least one.
            num_samples: room for how many samples, at least 1.
            period: of the sampling [s], positive.

        Raises:
            InputError: if an argument is out of range.
        """
        super().__init__()
        if not signals or min(signals.values()) < 1 or num_samples < 1:
            raise InputError("a recorder needs at least one signal of at least one number, and room for one sample")
        if not period > 0.0:
            raise InputError(f"a recorder's period must be positive, not {period} s")
        self._signals = {name: self.DeclareVectorInputPort(name, size) for name, size in signals.items()}
        self._sizes = dict(signals)
        self._num_samples = num_samples
        self._period = period
        self._width = sum(signals.values())
        self._count = self.DeclareDiscreteState(1)
        self._samples = self.DeclareDiscreteState(num_samples * self._width)
        self._num_recorded = self.DeclareStateOutputPort("num_recorded", self._count)
        self.DeclarePeriodicDiscreteUpdateEvent(period, period, self._record)

    def get_signal_input_port(self, name: str):
        """The signal of this name."""
        return self._signals[name]

    def get_num_recorded_output_port(self):
        """How many samples there are, (1,)."""
        return self._num_recorded

    def recording(self, context: Context) -> Recording:
        """What was recorded so far; `context` is this system's."""
        count = int(context.get_discrete_state(self._count).value()[0])
        samples = context.get_discrete_state(self._samples).value().reshape(-1, self._width)[:count]
        ends = np.cumsum(list(self._sizes.values()))
        columns = np.split(samples, ends[:-1], axis=1)
        return Recording(
            times=np.arange(count) * self._period,
            signals={name: column.copy() for name, column in zip(self._sizes, columns, strict=True)},
        )

    def _record(self, context: Context, discrete_state: DiscreteValues) -> EventStatus:
        count = int(context.get_discrete_state(self._count).value()[0])
        if count == self._num_samples:
            return EventStatus.DidNothing()
        row = np.concatenate([port.Eval(context) for port in self._signals.values()])
        samples = discrete_state.get_mutable_value(self._samples)
        samples[count * self._width : (count + 1) * self._width] = row
        discrete_state.get_mutable_value(self._count)[0] = count + 1
        return EventStatus.Succeeded()
