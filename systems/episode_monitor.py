"""Termination of episodes by named conditions."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from pydrake.systems.framework import Context, DiscreteValues, EventStatus, LeafSystem

from guiderail.models.common.arrays import is_whole
from guiderail.models.common.errors import InputError, brief
from guiderail.models.common.termination import EVALUATED, TERMINATIONS, Termination
from guiderail.systems.support import declarations as declare
from guiderail.systems.support.declarations import SignalPorts, check_signature, output_getter


@dataclass(frozen=True)
class TerminationTerm:
    """Condition that terminates an episode.

    Args:
        termination: Reason that is reported, one of `EVALUATED`, such as "success".
        inputs: Size of each signal that the condition depends on, by name. Terms of one monitor that name the same
            signal share its port.
        condition: Pure function with these signals as keyword arguments; returns True if the condition is met.
        steps: Number of control steps in which the condition must be met before the episode ends, at least 1.
        progress: Optional function of the same signals. Without this function, the steps must be consecutive. With this
            function, they need not be consecutive; their count is reset when the function's value exceeds its value at
            the previous reset by more than `min_progress`.
        min_progress: Increase of the value of `progress` up to which the count is not reset, not negative, finite.

    Raises:
        InputError: If the termination is unknown, or `steps` is out of range.
    """

    termination: str
    inputs: Mapping[str, int]
    condition: Callable[..., bool]
    steps: int = 1
    progress: Callable[..., float] | None = None
    min_progress: float = 0.0

    def __post_init__(self) -> None:
        if self.termination not in EVALUATED:
            raise InputError(f"an episode can't end as '{self.termination}', only as {', '.join(EVALUATED)}")
        if not is_whole(self.steps, 1):
            raise InputError(f"the steps of a condition must be a whole number of at least 1, not {brief(self.steps)}")


class EpisodeMonitor(LeafSystem):
    """Evaluate termination terms and output the reason of the first term, in order of precedence, that is met.

    Each term counts the control steps in which its condition is met. At the end of a step, the output already counts
    this step, and the update event of the same instant stores the count. The output is constant after a term has
    terminated the episode. `simulator.set_monitor(episode_monitor.monitor)` ends the simulation with it.

    ``termination`` is (1,), an index of a `Termination`; 0 while the episode continues.

    Args:
        terms: Termination terms in order of precedence, at least one.
        period: Control period [s], positive.
        task_name: Name of the task, for messages.

    Raises:
        InputError: If a signal has two sizes, or the parameters of a function are not named like its signals. At
            evaluation, if a condition is neither a truth value nor one finite number.
    """

    def __init__(self, terms: Sequence[TerminationTerm], period: float, task_name: str = ""):
        super().__init__()
        self._period = period
        self._of_task = f" of {task_name}" if task_name else ""
        for term in terms:
            for function in filter(None, (term.condition, term.progress)):
                check_signature(function, term.inputs, f"the condition {term.termination!r}{self._of_task}")
        self._terms = tuple(terms)
        self._indices = [Termination(term.termination).index for term in terms]
        self._signals = SignalPorts(self, *(term.inputs for term in terms))

        # [count, progress at the last reset of the count] of each term, then the index of the termination.
        self._state = self.DeclareDiscreteState(np.append(np.tile([0.0, -np.inf], len(self._terms)), 0.0))
        # The output and the event of the same instant share one evaluation.
        self._next = declare.cache(self, "next_state", self._calc_next, [*self._signals.tickets, self._state])
        declare.part_output(self, "termination", self._next, lambda state: state[-1])
        declare.update_after_start(self, period, self._update, declare.reset_to_default(self))

    get_signal_input_port = declare.get_signal_input_port
    get_termination_output_port = output_getter("termination", "index of a `Termination`, (1,)")

    def monitor(self, root_context: Context) -> EventStatus:
        """End a simulation at the end of the control step in which an episode ends, for `Simulator.set_monitor`.

        The status that `Simulator.AdvanceTo` returns then has the reason as its message, such as "success".
        """
        context = self.GetMyContextFromRoot(root_context)
        steps = context.get_time() / self._period
        if abs(steps - round(steps)) > 1e-6:  # within a control step
            return EventStatus.DidNothing()
        index = int(self.GetOutputPort("termination").Eval(context)[0])
        if index == 0:
            return EventStatus.DidNothing()
        return EventStatus.ReachedTermination(self, TERMINATIONS[index].value)

    def _calc_next(self, context: Context) -> np.ndarray:
        signals = self._signals.eval(context)
        state = context.get_discrete_state().value(self._state).copy()
        for i, term in enumerate(self._terms):
            inputs = {name: signals[name].copy() for name in term.inputs}
            if term.progress is not None:
                progress = float(term.progress(**inputs))
                if progress > state[2 * i + 1] + term.min_progress:
                    state[2 * i : 2 * i + 2] = 0.0, progress
                elif self._is_met(term, inputs):
                    state[2 * i] += 1
            else:
                state[2 * i] = state[2 * i] + 1 if self._is_met(term, inputs) else 0.0
            if state[-1] == 0 and state[2 * i] >= term.steps:
                state[-1] = self._indices[i]
        return state

    def _is_met(self, term: TerminationTerm, inputs: Mapping[str, np.ndarray]) -> bool:
        result = term.condition(**inputs)
        if isinstance(result, bool | np.bool_):
            return bool(result)
        array = np.asarray(result)
        if array.size != 1 or array.dtype.kind not in "fiub" or not np.isfinite(array).all():
            raise InputError(
                f"the condition {term.termination!r}{self._of_task} must be true or false, and it is {brief(result)}"
            )
        return bool(array.item())

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        discrete_state.set_value(self._state, self._next.Eval(context))
