"""Which desired pose to follow: the commanded one while it is valid, otherwise the last one that was."""

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

from guiderail.models.common.errors import InputError
from guiderail.systems.support.sampling import check_period

# [s]. Far above the rounding of a time of days, far below any period.
_ROUNDING = 1e-6


class CommandCheck:
    """Whether a command may be followed: finite, and neither stale nor from the future.

    A command that was given at t_c is valid at t while −period ≤ t − t_c ≤ timeout. Farther ahead it is refused as one
    that never gets stale. A time that is not finite is no time at which a command was given.
    """

    def __init__(self, desired_pose: InputPort, command_time: InputPort, *, period: float, timeout: float):
        """
        Args:
            desired_pose: input of the system, (O,).
            command_time: its input, (1,), when the pose was commanded [s]; unconnected, commands never get stale.
            period: at which the system checks [s], positive.
            timeout: age beyond which a command is stale [s], positive.

        Raises:
            InputError: if an argument is out of range.
        """
        check_period(period)
        if not timeout > 0.0:
            raise InputError(f"the timeout of commands must be positive, not {timeout} s")
        self._desired_pose, self._command_time = desired_pose, command_time
        self._earliest, self._latest = -(period + _ROUNDING), timeout

    def is_valid(self, context: Context, time: float) -> bool:
        """Whether the present command may be followed at `time` [s]; `context` is the system's."""
        if not np.isfinite(self._desired_pose.Eval(context)).all():
            return False
        if not self._command_time.HasValue(context):
            return True
        age = time - float(self._command_time.Eval(context)[0])
        return self._earliest <= age <= self._latest


class CommandWatch:
    """The part of a system that watches its commands, and holds the last valid one where they stop.

    The held pose and the time of the last check are discrete states that a periodic event updates. A command is judged
    by the time of the last check instead of the present: so nothing that depends on it is computed anew between two
    events unless the command changes. It is found stale at the first event at which it is, and a new one counts at
    once. What is held from then on is the pose that was followed until then; before the first valid command it is the
    measured pose at initialization.
    """

    def __init__(
        self,
        system: LeafSystem,
        desired_pose: InputPort,
        command_time: InputPort,
        measured_pose: Callable[[Context], np.ndarray],
        *,
        period: float,
        timeout: float,
    ):
        """
        Args:
            system: under construction; two states and two events are declared in it.
            desired_pose: its input, (O,).
            command_time: its input, (1,), when the pose was commanded [s]; unconnected, commands never get stale.
            measured_pose: called with its context at initialization; where the robot is, (O,).
            period: at which commands are checked [s], positive; best the period at which they change.
            timeout: age beyond which a command is stale [s], positive.

        Raises:
            InputError: if an argument is out of range.
        """
        self._desired_pose, self._measured_pose = desired_pose, measured_pose
        self._check = CommandCheck(desired_pose, command_time, period=period, timeout=timeout)
        self._held_pose = system.DeclareDiscreteState(desired_pose.size())
        self._check_time = system.DeclareDiscreteState(1)
        system.DeclareInitializationDiscreteUpdateEvent(self._hold_measured_pose)
        system.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)
        self.holding_tickets: set[DependencyTicket] = {
            desired_pose.ticket(),
            command_time.ticket(),
            system.discrete_state_ticket(self._check_time),
        }
        """What `calc_holding` depends on."""
        self.tickets = self.holding_tickets | {system.discrete_state_ticket(self._held_pose)}
        """What `pose` depends on."""

    def pose(self, context: Context) -> np.ndarray:
        """The desired pose to follow, (O,)."""
        if self._is_valid(context):
            return self._desired_pose.Eval(context)
        return context.get_discrete_state(self._held_pose).value()

    def calc_holding(self, context: Context, output: BasicVector) -> None:
        """Of an output (1,): 1 while a pose is held."""
        output.SetAtIndex(0, float(not self._is_valid(context)))

    def _is_valid(self, context: Context) -> bool:
        return self._check.is_valid(context, float(context.get_discrete_state(self._check_time).value()[0]))

    def _hold_measured_pose(self, context: Context, discrete_state: DiscreteValues) -> EventStatus:
        discrete_state.set_value(self._held_pose, self._measured_pose(context))
        discrete_state.set_value(self._check_time, [context.get_time()])
        return EventStatus.Succeeded()

    def _update(self, context: Context, discrete_state: DiscreteValues) -> EventStatus:
        # By the last check, not by this one: whatever was followed until now is what is held if it is stale now.
        if self._is_valid(context):
            discrete_state.set_value(self._held_pose, self._desired_pose.Eval(context))
        discrete_state.set_value(self._check_time, [context.get_time()])
        return EventStatus.Succeeded()
