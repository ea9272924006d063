"""Limiter of a policy's chunks: bounds, velocity limits and jerk limits."""

import math
from dataclasses import dataclass

import numpy as np
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from guiderail.models.common.errors import InputError
from guiderail.systems.support import declarations as declare
from guiderail.systems.support.declarations import check_period, input_getter, output_getter
from guiderail_lerobot.chunk_guard import MIN_STEPS, ChunkGuard


@dataclass(frozen=True, slots=True)
class _Plan:
    outputs: np.ndarray
    rate: float
    fallback: float


class ChunkSafetyLimiter(LeafSystem):
    """Execute the chunks of a policy within bounds, velocity limits and jerk limits (`ChunkGuard`).

    At the first control step, and then every ``replan_steps`` control steps, the chunk is limited as a continuation of
    the last three commands. At the other control steps, the limited chunk is executed. The motion starts at rest at the
    measured pose. If the measured pose is outside the bounds, the first command is inside. If no step within the limits
    leads inside, the measured pose is commanded and ``fallback`` is 1.

    .. pydrake_system::

        name: ChunkSafetyLimiter
        input_ports:
        - chunk
        - pose
        output_ports:
        - desired_pose
        - rate
        - fallback

    ``chunk`` (K*O,) contains the requested outputs (K, O) in row-major order; the first is for the current control
    step. It must be constant during a control step. ``pose`` is the measured pose (O,), read at initialization.
    ``desired_pose`` is (O,). ``rate`` (1,) is the executed speed divided by the speed of the requested chunk. It is
    less than 1 only in the mode "slowdown" or if ``fallback`` is 1. ``fallback`` (1,) is 1 if no chunk within the
    limits was found or the requested chunk is not finite; the rest of the previous chunk is then executed.

    Args:
        guard: Limits and mode for O outputs; its state is not used.
        num_steps: Number K of steps of a chunk, at least 4 and at least `replan_steps`.
        replan_steps: Number of executed control steps of each chunk, at least 1.
        period: Control period [s], positive, equal to the period of the guard.

    Raises:
        InputError: If an argument is out of range; at initialization, if the measured pose is not finite.
    """

    def __init__(self, guard: ChunkGuard, num_steps: int, replan_steps: int, period: float):
        super().__init__()
        if not 1 <= replan_steps <= num_steps or num_steps < MIN_STEPS:
            raise InputError(
                f"num_steps of a chunk must be at least {MIN_STEPS}, and replan_steps from 1 to num_steps, not "
                f"{num_steps} and {replan_steps}"
            )
        check_period(period)
        if not math.isclose(period, guard.period, rel_tol=1e-6):
            raise InputError(f"the period must be that of the guard, {guard.period} s, not {period} s")
        self._guard, self._num_steps, self._replan_steps = guard, num_steps, replan_steps
        self._outputs = guard.constraints.num_outputs
        self._chunk_port = self.DeclareVectorInputPort("chunk", num_steps * self._outputs)
        self._pose_port = self.DeclareVectorInputPort("pose", self._outputs)
        # [last three commands and rest of the limited chunk (3 + K, O); rate; fallback; number of the control step]
        self._state = declare.unset_state(self, (3 + num_steps) * self._outputs + 3)
        self._plan = declare.cache(self, "plan", self._calc_plan, [self._chunk_port, self._state])
        declare.part_output(self, "desired_pose", self._plan, lambda plan: plan.outputs[0], self._outputs)
        declare.part_output(self, "rate", self._plan, lambda plan: plan.rate)
        declare.part_output(self, "fallback", self._plan, lambda plan: plan.fallback)
        declare.update_after_start(self, period, self._advance, self._reset)

    get_chunk_input_port = input_getter("chunk", "requested outputs, (K*O,)")
    get_pose_input_port = input_getter("pose", "measured pose, (O,), read at initialization")
    get_desired_pose_output_port = output_getter("desired_pose", "command within the limits, (O,)")
    get_rate_output_port = output_getter("rate", "executed speed relative to the requested one, (1,)")
    get_fallback_output_port = output_getter("fallback", "flag that the rest of the previous chunk is executed, (1,)")

    def _reset(self, context: Context, discrete_state: DiscreteValues) -> None:
        measured = declare.start_pose(self._pose_port.Eval(context))
        try:
            first = self._guard.nearest_start(measured)
        except InputError:  # no step within the limits leads inside the bounds
            first = measured
        motion = np.concatenate([np.tile(measured, 3), np.tile(first, self._num_steps)])
        discrete_state.set_value(self._state, np.append(motion, np.zeros(3)))

    def _calc_plan(self, context: Context) -> _Plan:
        *motion, rate, fallback, step = declare.initialized(self, context, self._state)
        past, rest = np.split(np.reshape(motion, (-1, self._outputs)), [3])
        if step % self._replan_steps != 0:
            return _Plan(rest, rate, fallback)
        requested = self._chunk_port.Eval(context).reshape(rest.shape)
        if not np.isfinite(requested).all():
            return _Plan(rest, 0.0, 1.0)
        limited = self._guard.limit(requested, past, rest)
        return _Plan(limited.outputs, limited.rate, float(limited.is_fallback))

    def _advance(self, context: Context, discrete_state: DiscreteValues) -> None:
        state, plan = context.get_discrete_state().value(self._state), self._plan.Eval(context)
        past = state[self._outputs : 3 * self._outputs]
        values = [past, plan.outputs.ravel(), plan.outputs[-1], [plan.rate, plan.fallback, state[-1] + 1.0]]
        discrete_state.set_value(self._state, np.concatenate(values))
