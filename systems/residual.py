"""Residual learning's sum of a reference and a policy's action."""

import numpy as np
from pydrake.systems.framework import BasicVector, Context, InputPort, LeafSystem, OutputPort

from guiderail.models.common.errors import InputError


class Residual(LeafSystem):
    """Adds a policy's residual to a reference (thesis, section 4.4.1).

        desired_pose = reference + K action

    .. pydrake_system::

        name: Residual
        input_ports:
        - reference
        - action
        output_ports:
        - desired_pose

    All are (O,); ``action`` is in [−1, 1]. (Drake's `Adder` computes the same but counts as depending on time: what is
    connected behind it would be computed anew at every step of the plant.)
    """

    def __init__(self, gain: np.ndarray):
        """
        Args:
            gain: the diagonal of K, (O,), in the reference's units per unit of action.

        Raises:
            InputError: if the gain is not a vector of finite numbers.
        """
        super().__init__()
        self._gain = np.array(gain, dtype=float)
        if self._gain.ndim != 1 or not self._gain.size or not np.isfinite(self._gain).all():
            raise InputError(f"a residual's gain is one finite number per output, not {gain}")
        self._reference_port = self.DeclareVectorInputPort("reference", self._gain.size)
        self._action_port = self.DeclareVectorInputPort("action", self._gain.size)
        self._desired_pose_port = self.DeclareVectorOutputPort(
            "desired_pose",
            self._gain.size,
            self._calc_desired_pose,
            prerequisites_of_calc={self._reference_port.ticket(), self._action_port.ticket()},
        )

    def get_reference_input_port(self) -> InputPort:
        """The command without the residual, (O,)."""
        return self._reference_port

    def get_action_input_port(self) -> InputPort:
        """The policy's action, (O,)."""
        return self._action_port

    def get_desired_pose_output_port(self) -> OutputPort:
        """The sum, (O,)."""
        return self._desired_pose_port

    def _calc_desired_pose(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._reference_port.Eval(context) + self._gain * self._action_port.Eval(context))
