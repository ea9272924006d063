"""A linearly constrained null-space movement primitive in a diagram (thesis, equations 4.21 and 5.1)."""

from collections.abc import Sequence
from dataclasses import dataclass

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
from guiderail.models.primitives import LcNsKmp, UnsolvableError
from guiderail.systems.support.caching import declare_cache
from guiderail.systems.support.sampling import check_period


@dataclass(frozen=True, slots=True)
class _Command:
    step: int
    output: np.ndarray
    fallback: float


class LcNsKmpSystem(LeafSystem):
    """Predicts the command of a linearly constrained null-space primitive (`LcNsKmp`) at every control step.

        command = LC-NS-KMP(step, gain · null_space_action)             KGRL, equation 4.21
        command = LC-NS-KMP(step, gain · null_space_action, history)    sKGRL, equation 5.1

    .. pydrake_system::

        name: LcNsKmpSystem
        input_ports:
        - null_space_action
        - history (where P > 0)
        - history_length (where there are primitives with shorter histories)
        output_ports:
        - command
        - constraint_violation
        - fallback

    ``null_space_action`` (O,) is the policy's, in [−1, 1] per output, held for a control step. ``history`` (P*O,) is
    row-major, oldest output first (`HistoryBuffer`). ``history_length`` (1,) selects the primitive by the length of its
    history (`HistoryLengthSchedule`); each is given the newest part of ``history``, so that whichever is selected
    begins where the last command ended. ``command`` (O,) is the command. ``constraint_violation`` (1,) is max(c − G y)
    of that command: negative is slack, `UNCONSTRAINED` where there is no constraint. ``fallback`` (1,) is 1 where no
    window within the constraints was found: then it is what is nearest to the last command within its own step's.

    A history length that no primitive has raises an `InputError` where it is asked for.

    The step is state and counts control periods since time zero; the output is a pure function of step, action and
    history, evaluated once a control step (see CONTRIBUTING.md, "Rates and the order of events").
    """

    #: ``constraint_violation`` where there is no constraint: finite, so that it can be logged and reduced.
    UNCONSTRAINED = -1e30

    def __init__(
        self,
        primitive: LcNsKmp,
        gain: np.ndarray | None,
        period: float,
        shorter: Sequence[tuple[LcNsKmp, np.ndarray]] = (),
    ):
        """
        Args:
            primitive: O outputs, P past outputs.
            gain: (O,), raw null-space action per unit of the policy's action (`models.primitives.gains`); ones unless
                given.
            period: between two control steps [s], positive: that of the reference trajectory, or the motion is of
                another speed than was demonstrated.
            shorter: primitives of the same motion and constraints with histories of 1 … P − 1 outputs, and their
                gains (O,).

        Raises:
            InputError: if a gain has the wrong shape or is not finite, the period is not positive, or a shorter history
                is not shorter, has a length that another has, or other constraints.
        """
        super().__init__()
        outputs = primitive.num_outputs
        if any(not 0 < other.history < primitive.history for other, _ in shorter):
            raise InputError(f"a shorter history has 1 to {primitive.history - 1} outputs")
        if len({other.history for other, _ in shorter}) < len(shorter):
            raise InputError("two shorter histories are of one length")
        for other, _ in shorter:
            mine, its = primitive.constraints, other.constraints
            if not (np.array_equal(mine.G, its.G) and np.array_equal(mine.c, its.c)):
                raise InputError(f"the primitive with a history of {other.history} outputs has other constraints")
        check_period(period)
        self._primitive, self._period = primitive, period
        self._by_history_length = {
            other.history: (other, _checked_gain(its_gain, outputs))
            for other, its_gain in [(primitive, gain), *shorter]
        }

        self._null_space_action_port = self.DeclareVectorInputPort("null_space_action", outputs)
        self._history_port = (
            self.DeclareVectorInputPort("history", primitive.history * outputs) if primitive.history else None
        )
        self._history_length_port = self.DeclareVectorInputPort("history_length", 1) if shorter else None
        self._step = self.DeclareDiscreteState(1)
        start = primitive.constraints.nearest(primitive.reference.means[0])
        self._first_safe = start
        self._last_safe = self.DeclareDiscreteState(start)
        self.DeclareInitializationDiscreteUpdateEvent(self._begin)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._advance)

        prerequisites = {
            self._null_space_action_port.ticket(),
            self.discrete_state_ticket(self._step),
            self.discrete_state_ticket(self._last_safe),
        }
        prerequisites |= {port.ticket() for port in (self._history_port, self._history_length_port) if port is not None}
        self._command = declare_cache(self, "command", self._calc_command, prerequisites_of_calc=prerequisites)
        command = {self._command.ticket()}
        self._command_port = self.DeclareVectorOutputPort(
            "command", outputs, self._calc_output, prerequisites_of_calc=command
        )
        self._constraint_violation_port = self.DeclareVectorOutputPort(
            "constraint_violation", 1, self._calc_constraint_violation, prerequisites_of_calc=command
        )
        self._fallback_port = self.DeclareVectorOutputPort(
            "fallback", 1, self._calc_fallback, prerequisites_of_calc=command
        )

    @property
    def primitive(self) -> LcNsKmp:
        """The primitive with the longest history."""
        return self._primitive

    @property
    def gain(self) -> np.ndarray:
        """Its raw null-space action per unit of the policy's action, (O,)."""
        return self._by_history_length[self._primitive.history][1].copy()

    def get_null_space_action_input_port(self) -> InputPort:
        """The policy's action in [−1, 1], (O,)."""
        return self._null_space_action_port

    def get_history_input_port(self) -> InputPort:
        """The last outputs (P*O,), oldest first.

        Raises:
            InputError: if the primitive has no history.
        """
        if self._history_port is None:
            raise InputError("this primitive has no history (P = 0), hence no such port")
        return self._history_port

    def get_history_length_input_port(self) -> InputPort:
        """The length of the history that is used, (1,).

        Raises:
            InputError: if there is only one.
        """
        if self._history_length_port is None:
            raise InputError("this system has one primitive, hence no such port: give it shorter ones")
        return self._history_length_port

    def get_command_output_port(self) -> OutputPort:
        """The command, (O,)."""
        return self._command_port

    def get_constraint_violation_output_port(self) -> OutputPort:
        """max(c − G y) of the command, (1,)."""
        return self._constraint_violation_port

    def get_fallback_output_port(self) -> OutputPort:
        """1 where the command is what is nearest to the last one within the constraints, (1,)."""
        return self._fallback_port

    def _begin(self, context: Context, discrete_state: DiscreteValues) -> EventStatus:
        step = round(context.get_time() / self._period)
        discrete_state.set_value(self._step, [step])
        if step == 0:  # whoever goes on from a later state falls back to the last command
            discrete_state.set_value(self._last_safe, self._first_safe)
        return EventStatus.Succeeded()

    def _advance(self, context: Context, discrete_state: DiscreteValues) -> EventStatus:
        step = round(context.get_time() / self._period)
        if step > 0:
            command = self._command.Eval(context)
            discrete_state.set_value(self._last_safe, command.output)
        discrete_state.set_value(self._step, [step])
        return EventStatus.Succeeded()

    def _calc_command(self, context: Context) -> _Command:
        step = int(context.get_discrete_state(self._step).value()[0])
        length = self._primitive.history
        if self._history_length_port is not None:
            length = self._history_length_port.Eval(context)[0]
            if length not in self._by_history_length:
                known = ", ".join(map(str, sorted(self._by_history_length)))
                raise InputError(f"there is no primitive with a history of {length:g} outputs, only with {known}")
            length = int(length)
        primitive, gain = self._by_history_length[length]
        action = gain * self._null_space_action_port.Eval(context)
        history = None
        if self._history_port is not None:
            history = self._history_port.Eval(context).reshape(-1, primitive.num_outputs)[-length:]
        try:
            output, fallback = primitive.predict(step, action, history).output, 0.0
        except UnsolvableError:
            output, fallback = self._fall_back(context, step), 1.0
        return _Command(step, output, fallback)

    def _fall_back(self, context: Context, step: int) -> np.ndarray:
        """What is nearest to the last command: what was safe a step ago need not be now, where constraints change."""
        last_safe = context.get_discrete_state(self._last_safe).value()
        try:
            return self._primitive.constraints.nearest(last_safe, step)
        except UnsolvableError:
            return last_safe.copy()  # the arm still has to be told something

    def _calc_output(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._command.Eval(context).output)

    def _calc_constraint_violation(self, context: Context, output: BasicVector) -> None:
        command = self._command.Eval(context)
        violation = self._primitive.constraints.violation(command.output, command.step)
        output.SetAtIndex(0, max(violation, self.UNCONSTRAINED))

    def _calc_fallback(self, context: Context, output: BasicVector) -> None:
        output.SetAtIndex(0, self._command.Eval(context).fallback)


def _checked_gain(gain: np.ndarray | None, outputs: int) -> np.ndarray:
    checked = np.ones(outputs) if gain is None else np.array(gain, dtype=float)
    if checked.shape != (outputs,) or not np.isfinite(checked).all():
        raise InputError(f"the gain must be {outputs} finite numbers, not {gain}")
    return checked
