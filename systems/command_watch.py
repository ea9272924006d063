"""Which desired pose to follow: the one commanded while it is sound, otherwise the last one that was."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from pydrake.systems.framework import (
    BasicVector,
    Context,
    DependencyTicket,
    DiscreteValues,
    EventStatus,
    InputPort,
    LeafSystem,
)

from guiderail.models.errors import InputError


class CommandWatch:
    """The part of a system that watches its commands.

    A desired pose is sound while it is finite and no older than `timeout`. Where it isn't, the last one that was is
    held; before the first one, the pose at initialization. What is held is a discrete state of the system.
    """

    def __init__(
        self,
        system: LeafSystem,
        desired_pose: InputPort,
        command_time: InputPort,
        present: Callable[[Context], np.ndarray],
        *,
        period: float,
        timeout: float,
    ):
        """
        Args:
            system: that is under construction; a state and two events are declared in it.
            desired_pose: its input, (6,).
            command_time: its input, (1,), when the pose was commanded [s]; unconnected, commands never grow old.
            present: where the robot is, (6,); asked at initialization.
            period: at which a sound command is remembered [s], positive.
            timeout: age from which a command no longer counts [s], positive.

        Raises:
            InputError: if a number is not positive.
        """
        if not period > 0.0 or not timeout > 0.0:
            raise InputError(f"a watchdog's period and timeout must be positive, not {period} s and {timeout} s")
        self._desired_pose, self._command_time, self._present = desired_pose, command_time, present
        self._timeout = timeout
        self._held = system.DeclareDiscreteState(6)
        system.DeclareInitializationDiscreteUpdateEvent(self._hold_present)
        system.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._remember)
        self.commands: set[DependencyTicket] = {desired_pose.ticket(), command_time.ticket(), system.time_ticket()}
        """What `is_sound` depends on."""
        self.tickets = self.commands | {system.discrete_state_ticket(self._held)}
        """What `pose` depends on."""

    def is_sound(self, context: Context) -> bool:
        """Whether the present command counts."""
        if not np.isfinite(self._desired_pose.Eval(context)).all():
            return False
        if not self._command_time.HasValue(context):
            return True
        return bool(context.get_time() - self._command_time.Eval(context)[0] <= self._timeout)

    def pose(self, context: Context) -> np.ndarray:
        """The desired pose to follow, (6,)."""
        if self.is_sound(context):
            return self._desired_pose.Eval(context)
        return context.get_discrete_state(self._held).value()

    def calc_holding(self, context: Context, output: BasicVector) -> None:
        """Of an output (1,): 1 while a pose is held."""
        output.SetAtIndex(0, float(not self.is_sound(context)))

    def _hold_present(self, context: Context, discrete_state: DiscreteValues) -> EventStatus:
        discrete_state.set_value(self._present(context))
        return EventStatus.Succeeded()

    def _remember(self, context: Context, discrete_state: DiscreteValues) -> EventStatus:
        if not self.is_sound(context):
            return EventStatus.DidNothing()
        discrete_state.set_value(self._desired_pose.Eval(context))
        return EventStatus.Succeeded()
