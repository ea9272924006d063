"""A line that loses commands, or is slow."""

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
from guiderail.systems.support.sampling import check_period


class CommandDisturbance(LeafSystem):
    """Delivers commands late, and some not at all: then the robot goes on with the last one that arrived.

        y_n = y_{n−1} with probability p, otherwise u_{n−k}

    Before the first command the measured pose is what was delivered.

    .. pydrake_system::

        name: CommandDisturbance
        input_ports:
        - command
        - pose
        output_ports:
        - delivered_command

    All are (n,). ``pose`` is measured, and read at initialization only.
    """

    def __init__(self, size: int, period: float, lost: float = 0.0, late: int = 0):
        """
        Args:
            size: n, at least 1.
            period: at which commands change [s], positive.
            lost: p, from 0 to less than 1.
            late: k periods, from 0.

        Raises:
            InputError: if an argument is out of range.
        """
        super().__init__()
        check_period(period)
        if size < 1:
            raise InputError(f"a command has at least one number, not {size}")
        if not 0.0 <= lost < 1.0:
            raise InputError(f"the probability that a command is lost is from 0 to less than 1, not {lost}")
        if late < 0:
            raise InputError(f"commands are late by a number of periods from 0, not {late}")
        self._lost, self._late = lost, late
        self._seed = self.DeclareNumericParameter(BasicVector(np.zeros(1)))
        self._count = self.DeclareDiscreteState(1)
        self._is_lost = self.DeclareDiscreteState(1)
        self._last = self.DeclareDiscreteState(size)
        self._line = self.DeclareDiscreteState(late * size) if late else None  # the oldest first
        self._command_port = self.DeclareVectorInputPort("command", size)
        self._pose_port = self.DeclareVectorInputPort("pose", size)
        state = {self.discrete_state_ticket(index) for index in (self._is_lost, self._last)}
        source = self._command_port.ticket() if self._line is None else self.discrete_state_ticket(self._line)
        self._delivered_command_port = self.DeclareVectorOutputPort(
            "delivered_command", size, self._calc_delivered, prerequisites_of_calc=state | {source}
        )
        self.DeclareInitializationDiscreteUpdateEvent(self._start)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)

    def get_command_input_port(self) -> InputPort:
        """What is commanded, (n,)."""
        return self._command_port

    def get_pose_input_port(self) -> InputPort:
        """Where the robot is, (n,)."""
        return self._pose_port

    def get_delivered_command_output_port(self) -> OutputPort:
        """What arrives, (n,)."""
        return self._delivered_command_port

    def set_seed(self, context: Context, seed: int) -> None:
        """Sets what losses are drawn from; `context` is this system's own."""
        context.get_mutable_numeric_parameter(self._seed).SetFromVector([float(seed)])

    def _start(self, context: Context, discrete_state: DiscreteValues) -> EventStatus:
        pose = self._pose_port.Eval(context)
        discrete_state.set_value(self._count, [0.0])
        discrete_state.set_value(self._is_lost, [0.0])
        discrete_state.set_value(self._last, pose)
        if self._line is not None:
            discrete_state.set_value(self._line, np.tile(pose, self._late))
        return EventStatus.Succeeded()

    def _update(self, context: Context, discrete_state: DiscreteValues) -> EventStatus:
        count = context.get_discrete_state(self._count).value()[0] + 1.0
        discrete_state.set_value(self._count, [count])
        discrete_state.set_value(self._last, self._delivered(context))
        if self._line is not None:
            sent = self._command_port.Eval(context)
            line = context.get_discrete_state(self._line).value()
            discrete_state.set_value(self._line, np.concatenate([line[len(sent) :], sent]))
        if self._lost > 0.0:
            seed = context.get_numeric_parameter(self._seed).value()[0]
            drawn = np.random.default_rng([int(seed), int(count)]).uniform()
            discrete_state.set_value(self._is_lost, [float(drawn < self._lost)])
        return EventStatus.Succeeded()

    def _delivered(self, context: Context) -> np.ndarray:
        last = context.get_discrete_state(self._last).value()
        if context.get_discrete_state(self._is_lost).value()[0]:
            return last
        if self._line is None:
            return self._command_port.Eval(context)
        return context.get_discrete_state(self._line).value()[: len(last)]

    def _calc_delivered(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._delivered(context))
