"""Last valid values of inputs: the desired pose, whose command has a time stamp, and the bound of a wrench."""

from collections.abc import Callable
from contextlib import suppress

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import Context, DiscreteValues, InputPort, LeafSystem, OutputPort

from guiderail.models.common.arrays import is_finite
from guiderail.models.common.errors import InputError
from guiderail.models.control.wrench import MAX_WRENCH_SIZE, WrenchBound
from guiderail.systems.support import declarations as declare

_TIME_TOLERANCE = 1e-6  # tolerance of time stamps [s]: far above rounding errors after days, far below any period
_MAX_COORDINATE = 1e6  # largest coordinate of a command [m, rad], above which a wrench could overflow


class CommandValidity:
    """Validity check of a command: its coordinates are finite and at most 1e6, and its age is within bounds.

    A command with time stamp t_c is valid at time t if −period ≤ t − t_c ≤ timeout. A command that is more than one
    period in the future is not valid, because it would time out too late. A command whose time stamp is not finite is
    not valid.

    Args:
        command_time: Input port of the time stamp of the command, (1,) [s]; if it is not connected, commands never time
            out.
        period: Period of the check [s], positive.
        timeout: Age above which a command is stale [s], positive and finite.

    Attributes:
        command_time, period: Arguments.

    Raises:
        InputError: If the timeout is out of range.
    """

    def __init__(self, command_time: InputPort, *, period: float, timeout: float):
        if not 0.0 < timeout < np.inf:
            raise InputError(f"the timeout of commands must be positive and finite, not {timeout} s")
        self.command_time, self.period = command_time, period
        self._min_age, self._max_age = -(period + _TIME_TOLERANCE), timeout

    def is_valid(self, context: Context, pose: np.ndarray, time: float) -> bool:
        """Return True if the present command (O,) is valid; `context` is the context of the system.

        `time` [s] is the time of the last check. The command is stale if its age at this time exceeds the timeout. A
        time stamp in the future is compared with the time of the context, which is up to a period later.
        """
        if not all(abs(number) <= _MAX_COORDINATE for number in pose.tolist()):
            return False  # also for NaN
        if not self.command_time.HasValue(context):
            return True
        stamp = float(self.command_time.Eval(context)[0])
        return time - stamp <= self._max_age and context.get_time() - stamp >= self._min_age


class LastValidPose:
    """Desired pose to follow: the present command while it is valid, otherwise the last valid command.

    The last valid pose and the time of the last check are discrete states, which a periodic event updates. The age of a
    command refers to the last check instead of the present time, so that outputs are computed again only when the
    command changes or an event occurs. A command becomes stale at the first event after its timeout. A new command is
    valid at once, unless its time stamp is too far in the future. Before the first valid command, the pose measured at
    initialization is followed. While the blend factor is zero, the robot is not controlled and the last valid pose
    follows the measured pose. If there is no valid command when control begins, the robot therefore stays where it is.

    Args:
        system: System under construction, in which two states and two events are declared.
        desired_pose: Input port of the command, (O,).
        validity: Validity check of the command; its period is that of the check.
        measured_pose: Function of the system's context that returns the measured pose, (O,).
        blend_factor: Input port of the blend factor, (1,). If it is None or not connected, the robot is always
            controlled.

    Attributes:
        sources: Sources of `eval`, for the declaration of outputs and cache entries.

    Raises:
        InputError: At initialization, if the measured pose is not finite.
    """

    def __init__(
        self,
        system: LeafSystem,
        desired_pose: InputPort,
        validity: CommandValidity,
        measured_pose: Callable[[Context], np.ndarray],
        blend_factor: InputPort | None = None,
    ):
        self._system, self._desired_pose, self._blend_factor = system, desired_pose, blend_factor
        self._measured_pose, self._validity = measured_pose, validity
        self._last_pose = declare.unset_state(system, desired_pose.size())
        self._check_time = system.DeclareDiscreteState(1)
        declare.update(system, validity.period, self._update, self._reset)
        # Outputs and event share one check of a command.
        self._valid = declare.cache_entry(
            system, "valid", self._check, [desired_pose, validity.command_time, self._check_time]
        )
        self.sources: list[declare.Source] = [desired_pose, self._valid, self._last_pose]

    def eval(self, context: Context) -> np.ndarray:
        """Return the desired pose to follow, (O,)."""
        if self._valid.Eval(context):
            return self._desired_pose.Eval(context)
        return declare.initialized(self._system, context, self._last_pose)

    def declare_timed_out_output(self, system: LeafSystem) -> OutputPort:
        """Declare the output port ``command_timed_out`` (1,), which is 1 if the present command is not valid."""
        return declare.scalar_output(
            system, "command_timed_out", lambda context: float(not self._valid.Eval(context)), [self._valid]
        )

    def _check(self, context: Context, value: AbstractValue) -> None:
        pose, time = self._desired_pose.Eval(context), context.get_discrete_state().value(self._check_time).item()
        value.set_value(self._validity.is_valid(context, pose, time))

    def _is_controlled(self, context: Context) -> bool:
        port = self._blend_factor
        return port is None or not port.HasValue(context) or port.Eval(context)[0] > 0.0

    def _reset(self, context: Context, discrete_state: DiscreteValues) -> None:
        discrete_state.set_value(self._last_pose, declare.start_pose(self._measured_pose(context)))
        discrete_state.set_value(self._check_time, [context.get_time()])

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        if not self._is_controlled(context):
            measured = self._measured_pose(context)
            if is_finite(measured):
                discrete_state.set_value(self._last_pose, measured)
        # The validity refers to the last check: the pose followed until now is stored even if it becomes stale now.
        elif self._valid.Eval(context):
            discrete_state.set_value(self._last_pose, self._desired_pose.Eval(context))
        discrete_state.set_value(self._check_time, [context.get_time()])


class LastValidBound:
    """Configured wrench bound, lowered to the numbers at an optional input port.

    While a number at the port is NaN or negative, its last valid value applies, or 0 before the first valid value. An
    invalid number is not replaced by 0, because a bound of 0 also disables damping, and a moving arm would coast. The
    last valid numbers are a discrete state, which a periodic event updates.

    Args:
        system: System under construction, in which a state and two events are declared.
        bound: Configured bound.
        max_wrench: Input port of the numbers, (8,) [N, Nm]; if it is not connected, the configured bound applies.
        period: Sampling period of the numbers [s], positive.

    Attributes:
        sources: Sources of `eval`, for the declaration of outputs and cache entries.
    """

    def __init__(self, system: LeafSystem, bound: WrenchBound, max_wrench: InputPort, *, period: float):
        self._bound, self._max_wrench = bound, max_wrench
        self._last = system.DeclareDiscreteState(MAX_WRENCH_SIZE)
        self.sources: list[declare.Source] = [max_wrench, self._last]
        declare.update(system, period, self._update, self._reset)

    def eval(self, context: Context) -> WrenchBound:
        """Return the present bound; `context` is the context of the system."""
        if not self._max_wrench.HasValue(context):
            return self._bound
        return self._bound.lowered_to(self._numbers(context, context.get_discrete_state().value(self._last)))

    def _numbers(self, context: Context, last: np.ndarray) -> np.ndarray:
        numbers = self._max_wrench.Eval(context)
        is_valid = numbers >= 0.0  # False for NaN
        return numbers if is_valid.all() else np.where(is_valid, numbers, last)

    def _reset(self, context: Context, discrete_state: DiscreteValues) -> None:
        numbers = np.zeros(MAX_WRENCH_SIZE)
        # All systems initialize at once, and the port may depend on one that has no start yet. The first evaluation
        # after the initialization raises all other errors again. `HasValue` evaluates the port.
        with suppress(InputError):
            if not self._max_wrench.HasValue(context):
                return
            numbers = self._numbers(context, numbers)
        discrete_state.set_value(self._last, numbers)

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        if self._max_wrench.HasValue(context):
            last = context.get_discrete_state().value(self._last)
            discrete_state.set_value(self._last, self._numbers(context, last))
