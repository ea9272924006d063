"""Tare of a wrench measurement: subtraction of its mean in free motion."""

import numpy as np
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from guiderail.models.common.arrays import is_finite
from guiderail.models.common.transforms import WRENCH_SIZE
from guiderail.systems.support import declarations as declare
from guiderail.systems.support.declarations import input_getter, output_getter


class WrenchTare(LeafSystem):
    """Subtract the mean of the first measurements, which are taken in free motion, from all later measurements.

        y_k = 0 for k < s + n,  y_k = u_k − (1/n) Σ u_j over j = s … s + n − 1 afterwards

    k counts samples since the initialization. The first s samples are skipped, because filters settle during this time.
    The next n finite samples are averaged; samples that are not finite are not counted. A contact force during these n
    samples would be subtracted as well.

    Both ports are (6,), force first [N, Nm].

    Args:
        period: Sampling period [s], positive.
        skipped: Number s of skipped samples, at least 0.
        averaged: Number n of averaged samples, at least 1.
    """

    def __init__(self, period: float, skipped: int, averaged: int):
        super().__init__()
        self._skipped, self._averaged = skipped, averaged
        self._count = self.DeclareDiscreteState(1)  # number k of samples so far
        self._offset = self.DeclareDiscreteState(WRENCH_SIZE)  # mean of the averaged samples so far
        self._measured_wrench_port = self.DeclareVectorInputPort("measured_wrench", WRENCH_SIZE)
        sources = [self._measured_wrench_port, self._count, self._offset]
        declare.output(self, "tared_wrench", WRENCH_SIZE, self._tared_wrench, sources)
        declare.update(self, period, self._update, declare.reset_to_default(self))

    get_measured_wrench_input_port = input_getter("measured_wrench", "wrench with a bias, (6,)")
    get_tared_wrench_output_port = output_getter("tared_wrench", "wrench without the bias, (6,)")

    def is_tared(self, context: Context) -> bool:
        """Return True if all samples of the mean have been taken; `context` is this system's."""
        return context.get_discrete_state().value(self._count).item() >= self._skipped + self._averaged

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        if self.is_tared(context):
            return
        count = context.get_discrete_state().value(self._count).item()
        if count >= self._skipped:
            offset = context.get_discrete_state().value(self._offset)
            sample = self._measured_wrench_port.Eval(context)
            if not is_finite(sample):
                return
            discrete_state.set_value(self._offset, offset + (sample - offset) / (count - self._skipped + 1.0))
        discrete_state.set_value(self._count, [count + 1.0])

    def _tared_wrench(self, context: Context) -> np.ndarray:
        if not self.is_tared(context):
            return np.zeros(WRENCH_SIZE)
        return self._measured_wrench_port.Eval(context) - context.get_discrete_state().value(self._offset)
