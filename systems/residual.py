"""Sum of a reference and a residual, for residual RL."""

from typing import Any

import numpy as np
from pydrake.systems.framework import Context

from guiderail.models.common.arrays import as_numbers
from guiderail.systems.support import declarations as declare
from guiderail.systems.support.convertible_system import ConvertibleSystem
from guiderail.systems.support.declarations import input_getter, output_getter


class Residual(ConvertibleSystem):
    """Add the residual of a policy to a reference (thesis, section 4.4.1).

        desired_pose = reference + K action

    All ports are (O,); ``action`` is in [−1, 1]. Drake's `Adder` is not used, because its output counts as
    time-dependent: downstream outputs would be computed again at every plant step. `ToAutoDiffXd` and `ToSymbolic`
    convert the system.

    Args:
        gain: Diagonal of K, (O,), in units of the reference per unit of action.
    """

    def __init__(self, gain: np.ndarray):
        super().__init__()
        self._gain = as_numbers(gain, "gain")
        self.declare_converted(self, float)

    get_reference_input_port = input_getter("reference", "reference, (O,)")
    get_action_input_port = input_getter("action", "policy's action, (O,)")
    get_desired_pose_output_port = output_getter("desired_pose", "desired pose, (O,)")

    def declare_converted(self, system: Any, scalar: type) -> None:
        """Declare the ports of this system in `system`; the law is that of every scalar type."""
        gain = self._gain
        reference = system.DeclareVectorInputPort("reference", gain.size)
        action = system.DeclareVectorInputPort("action", gain.size)

        def desired_pose(context: Context) -> np.ndarray:
            with np.errstate(invalid="ignore"):  # NumPy warns about formulas
                return reference.Eval(context) + gain * action.Eval(context)

        declare.output(system, "desired_pose", gain.size, desired_pose, [reference, action])
