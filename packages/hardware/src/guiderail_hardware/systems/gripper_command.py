"""Desired joint state of a gripper with position drives."""

import numpy as np
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from guiderail.models.common.arrays import as_numbers
from guiderail.models.common.errors import InputError
from guiderail.systems.support import declarations as declare
from guiderail.systems.support.declarations import input_getter, output_getter


class GripperCommand(LeafSystem):
    """Desired state of gripper joints: the last finite desired positions, with zero velocity.

    Desired positions are clipped to the joint limits. If a desired position is not finite, or the port is not
    connected, the previous desired position applies, which is `opening` after an initialization.

    .. pydrake_system::

        name: GripperCommand
        input_ports:
        - position (optional)
        output_ports:
        - desired_state

    ``position`` is (n,) [m or rad]. ``desired_state`` is (2n,), positions and velocities.

    Args:
        lower: Lower joint limits, (n,) [m or rad].
        upper: Upper joint limits, (n,) [m or rad].
        opening: Initial joint positions, (n,) [m or rad].
        period: Period at which the desired position is stored [s], positive.

    Raises:
        InputError: If the sizes differ or an argument is out of range.
    """

    def __init__(self, lower: np.ndarray, upper: np.ndarray, opening: np.ndarray, *, period: float):
        super().__init__()
        self._lower, self._upper = as_numbers(lower, "lower"), as_numbers(upper, "upper")
        opening = as_numbers(opening, "opening")
        if not self._lower.shape == self._upper.shape == opening.shape or opening.ndim != 1:
            raise InputError("a gripper needs a lower limit, an upper limit and an opening for each of its joints")
        if not ((self._lower <= opening) & (opening <= self._upper)).all():
            raise InputError(f"a gripper's opening must be within its joints' limits, not {opening}")
        num_joints = len(opening)
        self._position_port = self.DeclareVectorInputPort("position", num_joints)
        self._last_position = self.DeclareDiscreteState(opening)
        declare.output(
            self, "desired_state", 2 * num_joints, self._desired_state, [self._position_port, self._last_position]
        )
        declare.update(self, period, self._update, declare.reset_to_default(self))

    get_position_input_port = input_getter("position", "desired positions, (n,); optional")
    get_desired_state_output_port = output_getter("desired_state", "desired positions and velocities, (2n,)")

    def _valid_position(self, context: Context) -> np.ndarray:
        last = context.get_discrete_state().value(self._last_position)
        if not self._position_port.HasValue(context):
            return last
        position = self._position_port.Eval(context)
        return np.where(np.isfinite(position), np.clip(position, self._lower, self._upper), last)

    def _desired_state(self, context: Context) -> np.ndarray:
        position = self._valid_position(context)
        return np.concatenate([position, np.zeros_like(position)])

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        discrete_state.set_value(self._valid_position(context))
