"""Commands of a gripper: desired joint state, desired position and force limit."""

from __future__ import annotations

import numpy as np
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from guiderail.models.common.arrays import as_numbers
from guiderail.models.common.errors import InputError
from guiderail.systems.support import declarations as declare
from guiderail.systems.support.declarations import input_getter, output_getter

WSG_OPENING, WSG_FORCE = 0.107, 40.0  # opening [m] of Drake's model of a Schunk WSG 50, default force of its driver [N]


class GripperCommand(LeafSystem):
    """Commands of gripper joints: the last finite desired positions, at zero velocity, and the last valid force limit.

    Desired positions are clipped to the joint limits. If a desired position is not finite, or the port is not
    connected, the previous desired position applies, which is `opening` after an initialization. The same holds for the
    force limit: requests that are not positive and finite are ignored, and larger ones are lowered to `max_force`.

    With one joint, the distance of the fingers, the outputs ``desired_position`` and ``force_limit`` fit Drake's
    ``SchunkWsgPositionController``, its ``SchunkWsgCommandSender`` and a ``SchunkWsgDriver`` (see `for_wsg`).

    ``position`` and ``desired_position`` are (n,) [m or rad]. ``desired_state`` is (2n,), positions and velocities.
    ``requested_force`` and ``force_limit`` are (1,) [N].

    Args:
        lower: Lower joint limits, (n,) [m or rad].
        upper: Upper joint limits, (n,) [m or rad].
        opening: Initial joint positions, (n,) [m or rad].
        period: Period at which desired position and force limit are stored [s], positive.
        max_force: Largest and initial force limit [N], positive and finite.

    Raises:
        InputError: If the opening is outside of the limits, or the force is not positive and finite.
    """

    def __init__(
        self, lower: np.ndarray, upper: np.ndarray, opening: np.ndarray, *, period: float, max_force: float = WSG_FORCE
    ):
        super().__init__()
        self._lower, self._upper = as_numbers(lower, "lower"), as_numbers(upper, "upper")
        opening = as_numbers(opening, "opening")
        if not ((self._lower <= opening) & (opening <= self._upper)).all():
            raise InputError(f"a gripper's opening must be within its joints' limits, not {opening}")
        self._max_force = max_force
        if not 0.0 < max_force < np.inf:
            raise InputError(f"a gripper's max_force must be positive and finite, not {max_force}")
        num_joints = len(opening)
        self._position_port = self.DeclareVectorInputPort("position", num_joints)
        self._force_port = self.DeclareVectorInputPort("requested_force", 1)
        self._last_position = self.DeclareDiscreteState(opening)
        self._last_force = self.DeclareDiscreteState([self._max_force])
        sources = [self._position_port, self._last_position]
        declare.output(self, "desired_state", 2 * num_joints, self._desired_state, sources)
        declare.output(self, "desired_position", num_joints, self._valid_position, sources)
        declare.output(self, "force_limit", 1, self._valid_force, [self._force_port, self._last_force])
        declare.update(self, period, self._update, declare.reset_to_default(self))

    @classmethod
    def for_wsg(cls, *, period: float, max_force: float = WSG_FORCE) -> GripperCommand:
        """Return the commands of a Schunk WSG 50 as Drake models it, with the distance of the fingers as position."""
        opening = np.array([WSG_OPENING])
        return cls(np.zeros(1), opening, opening, period=period, max_force=max_force)

    get_position_input_port = input_getter("position", "desired positions, (n,); optional")
    get_requested_force_input_port = input_getter("requested_force", "requested force limit, (1,) [N]; optional")
    get_desired_state_output_port = output_getter("desired_state", "desired positions and velocities, (2n,)")
    get_desired_position_output_port = output_getter("desired_position", "desired positions, (n,)")
    get_force_limit_output_port = output_getter("force_limit", "force limit, (1,) [N]")

    def _valid_position(self, context: Context) -> np.ndarray:
        last = context.get_discrete_state().value(self._last_position)
        if not self._position_port.HasValue(context):
            return last
        position = self._position_port.Eval(context)
        return np.where(np.isfinite(position), np.clip(position, self._lower, self._upper), last)

    def _valid_force(self, context: Context) -> np.ndarray:
        last = context.get_discrete_state().value(self._last_force)
        if not self._force_port.HasValue(context):
            return last
        force = self._force_port.Eval(context)
        return np.minimum(force, self._max_force) if 0.0 < force[0] < np.inf else last

    def _desired_state(self, context: Context) -> np.ndarray:
        position = self._valid_position(context)
        return np.concatenate([position, np.zeros_like(position)])

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        position, force = self._valid_position(context), self._valid_force(context)
        discrete_state.set_value(self._last_position, position)
        discrete_state.set_value(self._last_force, force)
