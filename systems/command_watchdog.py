"""Passes on sound commands, and holds the last one where they stop."""

from __future__ import annotations

import numpy as np
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, EventStatus, LeafSystem

from guiderail.models.errors import InputError


class CommandWatchdog(LeafSystem):
    """Holds the last safe pose when commands stop, for robots whose controller doesn't watch by itself.

    A desired pose is sound while it is finite and no older than `timeout`. Where it isn't, the last one that was is
    passed on; before the first one, the pose at initialization.

    .. pydrake_system::

        name: CommandWatchdog
        input_ports:
        - desired_pose
        - pose
        - command_time (optional)
        output_ports:
        - safe_pose
        - holding

    `desired_pose`, `pose` (measured, read at initialization) and `safe_pose` are (6,). `command_time` is (1,), when
    `desired_pose` was given [s]; unconnected, commands never grow old. `holding` is (1,): 1 while a pose is held.
    """

    def __init__(self, period: float, timeout: float = 0.1):
        """
        Args:
            period: at which a sound command is remembered [s], positive.
            timeout: age from which a command no longer counts [s], positive.

        Raises:
            InputError: if an argument is not positive.
        """
        super().__init__()
        if not period > 0.0 or not timeout > 0.0:
            raise InputError(f"a watchdog's period and timeout must be positive, not {period} s and {timeout} s")
        self._timeout = timeout
        self._desired_pose = self.DeclareVectorInputPort("desired_pose", 6)
        self._pose = self.DeclareVectorInputPort("pose", 6)
        self._command_time = self.DeclareVectorInputPort("command_time", 1)
        self._held_pose = self.DeclareDiscreteState(6)
        self.DeclareInitializationDiscreteUpdateEvent(self._hold_present)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._remember)
        command = {self._desired_pose.ticket(), self._command_time.ticket(), self.time_ticket()}
        held = {self.discrete_state_ticket(self._held_pose)}
        self._safe_pose = self.DeclareVectorOutputPort("safe_pose", 6, self._calc_safe_pose, command | held)
        self._holding = self.DeclareVectorOutputPort("holding", 1, self._calc_holding, command)

    def get_desired_pose_input_port(self):
        """What is commanded, (6,)."""
        return self._desired_pose

    def get_pose_input_port(self):
        """What is measured, (6,)."""
        return self._pose

    def get_command_time_input_port(self):
        """When the desired pose was given, (1,) [s]; optional."""
        return self._command_time

    def get_safe_pose_output_port(self):
        """The command, or the last sound one, (6,)."""
        return self._safe_pose

    def get_holding_output_port(self):
        """1 while a pose is held, (1,)."""
        return self._holding

    def _is_sound(self, context: Context) -> bool:
        if not np.isfinite(self._desired_pose.Eval(context)).all():
            return False
        if not self._command_time.HasValue(context):
            return True
        return bool(context.get_time() - self._command_time.Eval(context)[0] <= self._timeout)

    def _hold_present(self, context: Context, discrete_state: DiscreteValues) -> EventStatus:
        discrete_state.set_value(self._pose.Eval(context))
        return EventStatus.Succeeded()

    def _remember(self, context: Context, discrete_state: DiscreteValues) -> EventStatus:
        if not self._is_sound(context):
            return EventStatus.DidNothing()
        discrete_state.set_value(self._desired_pose.Eval(context))
        return EventStatus.Succeeded()

    def _calc_safe_pose(self, context: Context, output: BasicVector) -> None:
        if self._is_sound(context):
            output.SetFromVector(self._desired_pose.Eval(context))
        else:
            output.SetFromVector(context.get_discrete_state(self._held_pose).value())

    def _calc_holding(self, context: Context, output: BasicVector) -> None:
        output.SetAtIndex(0, float(not self._is_sound(context)))
