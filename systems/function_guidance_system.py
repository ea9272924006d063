"""Guidance by a function of action, measured pose and measured wrench."""

from collections.abc import Callable
from inspect import signature
from typing import Any

import numpy as np
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from guiderail.models.common.errors import InputError, brief
from guiderail.systems.support import declarations as declare
from guiderail.systems.support.declarations import as_count, input_getter, output_getter

GuidanceFunction = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]
"""Function of action (A,), pose (O,) and wrench (W,) that returns the desired pose (O,)."""


class FunctionGuidanceSystem(LeafSystem):
    """Evaluate a function of the policy's action and the measurements once per control period.

        desired_pose[k] = function(action[k], pose[k], wrench[k])

    If the function does not return O finite numbers, the previous desired pose is repeated (initially the measured
    pose) and ``fallback`` is 1, so that NaN is never commanded.

    .. pydrake_system::

        name: FunctionGuidanceSystem
        input_ports:
        - action
        - pose
        - wrench
        output_ports:
        - desired_pose
        - held_action
        - fallback

    ``action`` and ``held_action`` are (A,), ``pose`` and ``desired_pose`` (O,), ``wrench`` (W,), ``fallback`` (1,).
    ``held_action`` is the action of the present control step. The outputs are state without direct feedthrough, so that
    feedback of the measured pose causes no algebraic loop.

    Args:
        function: Pure function (action, pose, wrench) → desired pose, because a reset cannot restore internal memory.
        action_size: Size A of the action, at least 1.
        pose_size: Size O of the poses, at least 1.
        wrench_size: Size W of the wrench, at least 1.
        period: Control period [s], positive.

    Raises:
        InputError: If a size or the period is out of range, or `function` is not a function of three arguments. At
            initialization, if the measured pose is not finite, or the function does not return O numbers.
    """

    def __init__(self, function: GuidanceFunction, action_size: int, pose_size: int, wrench_size: int, period: float):
        super().__init__()
        action_size, pose_size = as_count(action_size, "action_size"), as_count(pose_size, "pose_size")
        _check_function(function)
        self._function = function
        self._action_port = self.DeclareVectorInputPort("action", action_size)
        self._pose_port = self.DeclareVectorInputPort("pose", pose_size)
        self._wrench_port = self.DeclareVectorInputPort("wrench", as_count(wrench_size, "wrench_size"))
        self._desired_pose = declare.unset_state(self, pose_size)
        self._held_action = self.DeclareDiscreteState(action_size)
        self._fallback = self.DeclareDiscreteState(1)
        self._desired_pose_port = declare.output(
            self,
            "desired_pose",
            pose_size,
            lambda context: declare.initialized(self, context, self._desired_pose),
            [self._desired_pose],
        )
        self.DeclareStateOutputPort("held_action", self._held_action)
        self.DeclareStateOutputPort("fallback", self._fallback)
        declare.update(self, period, self._step, self._reset)

    get_action_input_port = input_getter("action", "policy's action in [−1, 1], (A,)")
    get_pose_input_port = input_getter("pose", "measured pose, (O,)")
    get_wrench_input_port = input_getter("wrench", "measured wrench, (W,)")
    get_desired_pose_output_port = output_getter("desired_pose", "desired pose, (O,)")
    get_held_action_output_port = output_getter("held_action", "action of the present control step, (A,)")
    get_fallback_output_port = output_getter("fallback", "flag that the function did not return O finite numbers, (1,)")

    def _reset(self, context: Context, discrete_state: DiscreteValues) -> None:
        start = declare.start_pose(self._pose_port.Eval(context))
        returned = self._evaluate(context)
        if _numbers(returned, len(start)) is None:
            raise InputError(f"a guidance's function must return {len(start)} numbers, not {brief(returned)}")
        discrete_state.set_value(self._desired_pose, start)
        self._set(context, discrete_state, returned)

    def _step(self, context: Context, discrete_state: DiscreteValues) -> None:
        self._set(context, discrete_state, self._evaluate(context))

    def _evaluate(self, context: Context) -> Any:
        ports = (self._action_port, self._pose_port, self._wrench_port)
        return self._function(*(port.Eval(context) for port in ports))  # copies, which the function may modify

    def _set(self, context: Context, discrete_state: DiscreteValues, returned: Any) -> None:
        desired = _numbers(returned, self._desired_pose_port.size())
        is_usable = desired is not None and bool(np.isfinite(desired).all())
        if is_usable:
            discrete_state.set_value(self._desired_pose, desired)
        discrete_state.set_value(self._held_action, self._action_port.Eval(context))
        discrete_state.set_value(self._fallback, [float(not is_usable)])


def _check_function(function: Any) -> None:
    """Raise an `InputError` unless `function` can be called with three positional arguments."""
    if not callable(function):
        raise InputError(f"guidance needs a function of action, pose and wrench, not {brief(function)}")
    try:
        accepted = signature(function)
    except (ValueError, TypeError):
        return  # functions written in C may have no signature
    try:
        accepted.bind("action", "pose", "wrench")
    except TypeError:
        raise InputError(
            "guidance needs a function of action, pose and wrench, and this one has the parameters "
            f"({', '.join(accepted.parameters)})"
        ) from None


def _numbers(returned: Any, size: int) -> np.ndarray | None:
    """Return an array (size,) of numbers, which need not be finite; None if `returned` is anything else."""
    try:
        desired = np.asarray(returned)
    except ValueError:
        return None
    return desired if desired.shape == (size,) and desired.dtype.kind in "fiu" else None
