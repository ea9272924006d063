"""Guidance by a law, which is evaluated once per control period."""

import logging
from typing import Any

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from guiderail.models.common.arrays import is_finite
from guiderail.models.common.errors import InputError, brief
from guiderail.models.laws.law import Law, check_command, check_law, safe_command
from guiderail.systems.support import declarations as declare
from guiderail.systems.support.declarations import input_getter, output_getter

_LOGGER = logging.getLogger(__name__)


class LawSystem(LeafSystem):
    """Evaluate a law of guidance (`Law`) once per control period.

        desired_pose[k] = law.command(state[k], action[k], pose[k], wrench[k])
        state[k + 1] = law.next(state[k], desired_pose[k], pose[k + 1])

    If the law does not command O finite numbers, the previous desired pose is repeated (initially the measured pose)
    and ``fallback`` is 1, so that NaN is never commanded.

    ``action`` and ``held_action`` are (A,), ``pose`` and ``desired_pose`` (O,), ``wrench`` (W,), ``fallback`` (1,).
    ``wrench`` must not depend on ``desired_pose`` at the initialization; take it from a sensor or behind a hold.
    ``held_action`` is the action of the present control step. The inputs are sampled at control steps, and the state of
    the law is discrete state: there is no direct feedthrough, so that feedback of the measured pose causes no algebraic
    loop.

    Args:
        law: Law with A actions and O outputs.
        wrench_size: Size W of the wrench, at least 1.
        period: Control period [s], positive.

    Raises:
        InputError: If `law` is not a law. At initialization, if the measured pose is not finite, or the law does not
            command O numbers.
    """

    def __init__(self, law: Law, wrench_size: int, period: float):
        super().__init__()
        check_law(law)
        self._law = law
        self._action_port = self.DeclareVectorInputPort("action", law.num_actions)
        self._pose_port = self.DeclareVectorInputPort("pose", law.num_outputs)
        self._wrench_port = self.DeclareVectorInputPort("wrench", wrench_size)
        self._example = law.default_state()
        self._state = self.DeclareDiscreteState(_flat(self._example))
        self._last = declare.unset_state(self, law.num_outputs)
        declare.update_after_start(self, period, self._advance, self._start)
        self._held_action, pose, wrench = (
            declare.sample(self, port, period) for port in (self._action_port, self._pose_port, self._wrench_port)
        )
        self._inputs = (self._held_action, pose, wrench)
        sources = [self._state, self._last, *self._inputs]
        self._command = declare.cache_entry(self, "command", self._calc_command, sources)
        declare.part_output(self, "desired_pose", self._command, lambda command: command.pose, law.num_outputs)
        self.DeclareStateOutputPort("held_action", self._held_action)
        declare.part_output(self, "fallback", self._command, lambda command: command.fallback)

    get_action_input_port = input_getter("action", "policy's action in [−1, 1], (A,)")
    get_pose_input_port = input_getter("pose", "measured pose, (O,)")
    get_wrench_input_port = input_getter("wrench", "measured wrench, (W,)")
    get_desired_pose_output_port = output_getter("desired_pose", "desired pose, (O,)")
    get_held_action_output_port = output_getter("held_action", "action of the present control step, (A,)")
    get_fallback_output_port = output_getter("fallback", "flag that the previous desired pose is repeated, (1,)")

    def _start(self, context: Context, discrete_state: DiscreteValues) -> None:
        pose = declare.start_pose(self._pose_port.Eval(context))
        state = self._law.start(pose.copy())
        inputs = (port.Eval(context) for port in (self._action_port, self._pose_port, self._wrench_port))
        if not is_finite(check_command(self._law.command(state, *inputs), len(pose)).pose):
            _LOGGER.warning("%s commands no finite pose at its first step: it is held", type(self._law).__name__)
        self._set_state(discrete_state, state)
        discrete_state.set_value(self._last, pose)

    def _advance(self, context: Context, discrete_state: DiscreteValues) -> None:
        command = self._command.Eval(context)
        state = self._law.next(self._law_state(context), command, self._pose_port.Eval(context))
        self._set_state(discrete_state, state)
        discrete_state.set_value(self._last, command.pose)

    def _set_state(self, discrete_state: DiscreteValues, state: Any) -> None:
        numbers, size = _flat(state), discrete_state.value(self._state).size
        if numbers.size != size:
            raise InputError(f"the state of a law has the size of its first state, {size}, not {numbers.size}")
        discrete_state.set_value(self._state, numbers)

    def _calc_command(self, context: Context, value: AbstractValue) -> None:
        last = declare.initialized(self, context, self._last)
        inputs = (context.get_discrete_state().value(index).copy() for index in self._inputs)
        value.set_value(safe_command(self._law.command(self._law_state(context), *inputs), last.copy()))

    def _law_state(self, context: Context) -> Any:
        return _like(self._example, context.get_discrete_state().value(self._state).copy())


def _flat(state: Any) -> np.ndarray:
    """Return the numbers of a law's state, an array or a named tuple of arrays, numbers and further named tuples."""
    if isinstance(state, tuple) and hasattr(state, "_fields"):
        return np.concatenate([np.zeros(0), *map(_flat, state)])
    if not isinstance(state, np.ndarray | np.generic | float | int):
        raise InputError(f"the state of a law is an array, or a named tuple of arrays and numbers, not {brief(state)}")
    return np.ravel(state).astype(float)


def _like(example: Any, numbers: np.ndarray) -> Any:
    """Return the state of the type and the shapes of `example` with the given numbers."""
    if isinstance(example, tuple):
        sizes = [_flat(part).size for part in example]
        return type(example)(*map(_like, example, np.split(numbers, np.cumsum(sizes)[:-1])))
    return numbers.reshape(example.shape) if isinstance(example, np.ndarray) else type(example)(numbers[0])
