"""Mean contact force of a control step."""

import numpy as np
from pydrake.systems.framework import Context, LeafSystem

from guiderail.systems.support import declarations as declare
from guiderail.systems.support.declarations import input_getter, output_getter


class MeanForce(LeafSystem):
    """Compute the mean force of the last control step from the running sum of the forces of all plant steps.

        force = (force_sum − force_sum at the last control step) / substeps

    A control step consists of many plant steps. The force of the last plant step does not include contacts that ended
    earlier in the control step, and during an impact it depends on the length of the plant step. The mean avoids both.

    ``force_sum`` is (D,), the sum over all plant steps so far [N]. ``force`` is (D,), the mean over the plant steps
    since the last control step [N]. ``magnitude`` is (1,), its norm [N].

    Args:
        size: Number D of force components, at least 1.
        substeps: Number of plant steps per control step, at least 1.
        period: Control period [s], positive.
    """

    def __init__(self, size: int, substeps: int, period: float):
        super().__init__()
        self._scale = 1.0 / substeps
        self._force_sum_port = self.DeclareVectorInputPort("force_sum", size)
        self._last_sum = declare.sample(self, self._force_sum_port, period)
        sources = [self._force_sum_port, self._last_sum]
        declare.output(self, "force", size, self._mean, sources)
        declare.scalar_output(self, "magnitude", lambda context: float(np.linalg.norm(self._mean(context))), sources)

    get_force_sum_input_port = input_getter("force_sum", "sum of the forces of all plant steps so far, (D,) [N]")
    get_force_output_port = output_getter("force", "mean force of the control step, (D,) [N]")
    get_magnitude_output_port = output_getter("magnitude", "norm of the mean force, (1,) [N]")

    def _mean(self, context: Context) -> np.ndarray:
        return (self._force_sum_port.Eval(context) - context.get_discrete_state().value(self._last_sum)) * self._scale
