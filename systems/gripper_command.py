"""What the drives of a gripper's joints are told."""

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


class GripperCommand(LeafSystem):
    """The desired state of a gripper's joints: the last sound desired positions, at rest.

    A position that is finite is moved into its joint's range; one that isn't, or a port that is not connected, leaves
    that joint where it was told to be before, and at first where the gripper starts.

    .. pydrake_system::

        name: GripperCommand
        input_ports:
        - position (optional)
        output_ports:
        - desired_state

    `position` is (n,) and `desired_state` (2n,), positions and velocities, [m] or [rad] and a second.
    """

    def __init__(self, lower: np.ndarray, upper: np.ndarray, opening: np.ndarray, *, period: float):
        """
        Args:
            lower, upper: of the joints' ranges, (n,).
            opening: at which the gripper starts, (n,).
            period: at which the last sound position is remembered [s], positive.

        Raises:
            InputError: if an argument is out of range.
        """
        super().__init__()
        self._lower, self._upper = np.array(lower, dtype=float), np.array(upper, dtype=float)
        opening = np.array(opening, dtype=float)
        if not self._lower.shape == self._upper.shape == opening.shape or opening.ndim != 1:
            raise InputError("a gripper needs a lower limit, an upper limit and an opening for each of its joints")
        if not ((self._lower <= opening) & (opening <= self._upper)).all():
            raise InputError(f"a gripper's opening must be within its joints' limits, not {opening}")
        if not period > 0.0:
            raise InputError(f"a gripper command's period must be positive, not {period} s")
        num_joints = len(opening)
        self._position_port = self.DeclareVectorInputPort("position", num_joints)
        self._last = self.DeclareDiscreteState(opening)
        self._desired_state_port = self.DeclareVectorOutputPort(
            "desired_state",
            2 * num_joints,
            self._calc_desired_state,
            prerequisites_of_calc={self._position_port.ticket(), self.discrete_state_ticket(self._last)},
        )
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._remember)

    def get_position_input_port(self) -> InputPort:
        """Desired positions, (n,); optional."""
        return self._position_port

    def get_desired_state_output_port(self) -> OutputPort:
        """Desired positions and velocities, (2n,)."""
        return self._desired_state_port

    def _sound_position(self, context: Context) -> np.ndarray:
        last = context.get_discrete_state(self._last).value()
        if not self._position_port.HasValue(context):
            return last
        wanted = self._position_port.Eval(context)
        return np.where(np.isfinite(wanted), np.clip(wanted, self._lower, self._upper), last)

    def _calc_desired_state(self, context: Context, output: BasicVector) -> None:
        position = self._sound_position(context)
        output.SetFromVector(np.concatenate([position, np.zeros_like(position)]))

    def _remember(self, context: Context, discrete_state: DiscreteValues) -> EventStatus:
        discrete_state.set_value(self._sound_position(context))
        return EventStatus.Succeeded()
