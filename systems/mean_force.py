"""Contact forces, averaged over a control step."""

import numpy as np
from pydrake.systems.framework import BasicVector, Context, InputPort, LeafSystem, OutputPort

from guiderail.models.common.errors import InputError
from guiderail.systems.support.sampling import declare_sample


class MeanForce(LeafSystem):
    """Averages a force over the control step that is just over, from the running sum of the plant's forces.

        force = (force_sum − force_sum at the last control step) / substeps

    A plant takes many steps within one control step. Its force at the end of the last of them misses a contact that is
    already over, and during an impact depends on the size of the plant's step; the mean does neither.

    .. pydrake_system::

        name: MeanForce
        input_ports:
        - force_sum
        output_ports:
        - force
        - magnitude

    ``force_sum`` (D,) is the sum over all plant steps so far [N]; ``force`` (D,) the mean over the plant steps since
    the last control step [N], and ``magnitude`` (1,) its norm.
    """

    def __init__(self, size: int, substeps: int, period: float):
        """
        Args:
            size: D, at least 1.
            substeps: plant steps in a control step, at least 1.
            period: between two control steps [s], positive.

        Raises:
            InputError: if an argument is out of range.
        """
        super().__init__()
        if size < 1 or substeps < 1:
            raise InputError(f"a mean needs at least one component and one substep, not {size} and {substeps}")
        self._scale = 1.0 / substeps
        self._force_sum_port = self.DeclareVectorInputPort("force_sum", size)
        self._last = declare_sample(self, self._force_sum_port, period)
        prerequisites = {self._force_sum_port.ticket(), self.discrete_state_ticket(self._last)}
        self._force_port = self.DeclareVectorOutputPort(
            "force", size, self._calc_force, prerequisites_of_calc=prerequisites
        )
        self._magnitude_port = self.DeclareVectorOutputPort(
            "magnitude", 1, self._calc_magnitude, prerequisites_of_calc=prerequisites
        )

    def get_force_sum_input_port(self) -> InputPort:
        """The sum of the forces of all plant steps so far, (D,) [N]."""
        return self._force_sum_port

    def get_force_output_port(self) -> OutputPort:
        """The mean force of the control step, (D,) [N]."""
        return self._force_port

    def get_magnitude_output_port(self) -> OutputPort:
        """The norm of the mean force, (1,) [N]."""
        return self._magnitude_port

    def _mean(self, context: Context) -> np.ndarray:
        return (self._force_sum_port.Eval(context) - context.get_discrete_state(self._last).value()) * self._scale

    def _calc_force(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._mean(context))

    def _calc_magnitude(self, context: Context, output: BasicVector) -> None:
        output.SetAtIndex(0, float(np.linalg.norm(self._mean(context))))
