"""Communication channel that delays commands and loses some at random."""

import numpy as np
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem

from guiderail.models.common.errors import InputError
from guiderail.systems.support import declarations as declare
from guiderail.systems.support.declarations import input_getter, output_getter


class CommandDisturbance(LeafSystem):
    """Delay commands and lose some at random; a lost command is replaced by the last delivered command.

        y_t = y_{t−1} with probability p, otherwise u_{t−k},  t = 0, 1, …

    u_t is the command of period t, and y_t is the delivered command. y_{−1} and u_{−1}, …, u_{−k} are the measured pose
    at initialization. Every command, including the first, is therefore delayed by k periods.

    All ports have size n. ``pose`` is the measured pose, read at initialization only.

    Args:
        size: Size n of a command, at least 1.
        period: Period of the commands [s], positive.
        loss_probability: Probability p that a command is lost, from 0 to less than 1.
        delay: Delay k of a command, in periods, at least 0.

    Raises:
        InputError: If the probability is out of range; at initialization, if the measured pose is not finite.
    """

    def __init__(self, size: int, period: float, loss_probability: float = 0.0, delay: int = 0):
        super().__init__()
        if not 0.0 <= loss_probability < 1.0:
            raise InputError(f"the probability that a command is lost is from 0 to less than 1, not {loss_probability}")
        self._loss_probability, self._delay = loss_probability, delay
        self._seed = self.DeclareNumericParameter(BasicVector(np.zeros(1)))
        self._count = self.DeclareDiscreteState(1)
        self._is_lost = self.DeclareDiscreteState(1)
        self._last_delivered = declare.unset_state(self, size)
        self._delay_line = declare.unset_state(self, delay * size) if delay else None  # oldest command first
        self._command_port = self.DeclareVectorInputPort("command", size)
        self._pose_port = self.DeclareVectorInputPort("pose", size)
        source = self._command_port if self._delay_line is None else self._delay_line
        declare.output(self, "delivered_command", size, self._delivered, [self._is_lost, self._last_delivered, source])
        declare.update(self, period, self._update, self._reset)
        self._start = declare.start_time(self)

    get_command_input_port = input_getter("command", "command, (n,)")
    get_pose_input_port = input_getter("pose", "measured pose, (n,)")
    get_delivered_command_output_port = output_getter("delivered_command", "delivered command, (n,)")

    def set_seed(self, context: Context, seed: int) -> None:
        """Set the seed of the random losses; `context` is this system's."""
        context.get_mutable_numeric_parameter(self._seed).SetFromVector([seed])

    def _reset(self, context: Context, discrete_state: DiscreteValues) -> None:
        pose = declare.start_pose(self._pose_port.Eval(context))
        discrete_state.set_value(self._count, [0.0])
        discrete_state.set_value(self._is_lost, [0.0])
        discrete_state.set_value(self._last_delivered, pose)
        if self._delay_line is not None:
            discrete_state.set_value(self._delay_line, np.tile(pose, self._delay))

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        count = context.get_discrete_state().value(self._count).item() + 1.0
        discrete_state.set_value(self._count, [count])
        # At initialization no period has ended, and the value at the port is not a command.
        has_ended = declare.has_started(context, self._start)
        if has_ended:
            discrete_state.set_value(self._last_delivered, self._delivered(context))
        if has_ended and self._delay_line is not None:
            command = self._command_port.Eval(context)
            line = context.get_discrete_state().value(self._delay_line)
            discrete_state.set_value(self._delay_line, np.concatenate([line[len(command) :], command]))
        if self._loss_probability > 0.0:
            seed = context.get_numeric_parameter(self._seed).value().item()
            sample = np.random.default_rng([int(seed), int(count)]).uniform()
            discrete_state.set_value(self._is_lost, [float(sample < self._loss_probability)])

    def _delivered(self, context: Context) -> np.ndarray:
        last = declare.initialized(self, context, self._last_delivered)
        if context.get_discrete_state().value(self._is_lost).item():
            return last
        if self._delay_line is None:
            return self._command_port.Eval(context)
        return context.get_discrete_state().value(self._delay_line)[: len(last)]
