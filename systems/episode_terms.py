"""Reward and termination of an episode, as named terms on signals."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from operator import itemgetter
from typing import Any

import numpy as np
from pydrake.systems.framework import Context, DiscreteValues, EventStatus, LeafSystem, OutputPort

from guiderail.models.common.arrays import as_whole
from guiderail.models.common.errors import InputError, brief
from guiderail.models.common.termination import EVALUATED, TERMINATIONS, Termination
from guiderail.systems.support import declarations as declare
from guiderail.systems.support.declarations import SignalPorts, check_signature, output_getter
from guiderail.systems.support.scalar_conversion import ConvertibleSystem


@dataclass(frozen=True)
class RewardTerm:
    """Named term of a reward.

    Args:
        name: Name of the term and of its output port.
        inputs: Size of each signal that the term depends on, by name. Terms that name the same signal share its port.
        value: Pure function with these signals as keyword arguments; returns the term's value in this control step.
    """

    name: str
    inputs: Mapping[str, int]
    value: Callable[..., float]


class RewardSystem(ConvertibleSystem):
    """Sum of named reward terms, with an output port for each term.

        r = Σ_i r_i    (as in equation 4.22)

    All outputs are (1,). The system has no state: values of the previous control step come from a `ZeroOrderHold` of
    the control period. `ToAutoDiffXd` and `ToSymbolic` convert the system if the functions of the terms accept arrays
    of these numbers: without ``float()``, and for `ToSymbolic` without comparisons.

    Args:
        terms: Reward terms, at least one, with different names, neither empty nor "reward".
        task_name: Name of the task, for messages.

    Raises:
        InputError: If a signal has two sizes, or the parameters of a function are not named like its signals. At an
            evaluation, if a term is not one finite number, or the sum of the terms is not finite.
    """

    def __init__(self, terms: Sequence[RewardTerm], task_name: str = ""):
        super().__init__()
        self._of_task = f" of {task_name}" if task_name else ""
        self._terms = tuple(terms)
        for term in terms:
            check_signature(term.value, term.inputs, f"reward term {term.name!r}{self._of_task}")
        self._signals = SignalPorts(self, *(term.inputs for term in terms))
        sources = self._signals.tickets or {self.nothing_ticket()}
        self._values = declare.cache(self, "terms", self._calc_terms, sources)
        declare.part_output(self, "reward", self._values, self._sum)
        for i, term in enumerate(terms):
            declare.part_output(self, term.name, self._values, itemgetter(i))

    @property
    def term_names(self) -> tuple[str, ...]:
        """Names of the terms, in order."""
        return tuple(term.name for term in self._terms)

    get_signal_input_port = declare.get_signal_input_port
    get_reward_output_port = output_getter("reward", "sum of all terms, (1,)")

    def get_term_output_port(self, name: str) -> OutputPort:
        """Return the port of the term `name`, (1,)."""
        return self.GetOutputPort(name)

    def declare_converted(self, system: Any, scalar: type) -> None:
        """Declare the ports of this system in `system`; the terms are computed with numbers of the type `scalar`."""
        signals = SignalPorts(system, *(term.inputs for term in self._terms))
        sources = signals.tickets or {system.nothing_ticket()}

        def term_output(term: RewardTerm) -> Callable[[Context], Any]:
            def value(context: Context) -> Any:
                present = signals.eval(context)
                return self._converted_value(term, {name: present[name] for name in term.inputs}, scalar)

            return value

        functions = [term_output(term) for term in self._terms]
        declare.scalar_output(
            system, "reward", lambda context: sum((f(context) for f in functions), scalar(0.0)), sources
        )
        for term, function in zip(self._terms, functions, strict=True):
            declare.scalar_output(system, term.name, function, sources)

    def _converted_value(self, term: RewardTerm, signals: Mapping[str, np.ndarray], scalar: type) -> Any:
        try:
            value = np.asarray(term.value(**signals)).item()
            return value if isinstance(value, scalar) else scalar(float(value))
        except (TypeError, ValueError, AttributeError, RuntimeError) as error:
            raise InputError(
                f"reward term {term.name!r}{self._of_task} cannot be computed with {scalar.__name__}: use operators "
                "and NumPy, without float() and math, and without comparisons for Expression"
            ) from error

    def _calc_terms(self, context: Context) -> np.ndarray:
        signals = self._signals.eval(context)
        return np.array([self._value(term, signals) for term in self._terms])

    def _sum(self, values: np.ndarray) -> np.ndarray:
        with np.errstate(over="ignore"):
            total = np.add.reduce(values)
        if not math.isfinite(total):
            raise InputError(f"the sum of the reward terms{self._of_task} is not finite, but {total}: scale them down")
        return total

    def _value(self, term: RewardTerm, signals: Mapping[str, np.ndarray]) -> float:
        # The arguments are copied, so that a function that changes them does not affect the next term.
        value = term.value(**{name: signals[name].copy() for name in term.inputs})
        array = np.asarray(value)
        if array.size != 1 or array.dtype.kind not in "fiub":
            raise InputError(f"reward term {term.name!r}{self._of_task} must be one number, and it is {brief(value)}")
        number = float(array.item())
        # Without this error, a learner would diverge many episodes after the cause.
        if not math.isfinite(number):
            raise InputError(f"reward term {term.name!r}{self._of_task} is not finite, but {number}")
        return number


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
        as_whole(self.steps, "the steps of a condition", 1)


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
