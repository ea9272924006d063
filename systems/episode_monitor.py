"""Termination of episodes: when one ends, and why."""

from collections.abc import Callable, Mapping, Sequence
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
from guiderail.systems.support.caching import declare_cache
from guiderail.systems.support.sampling import check_period
from guiderail.systems.support.signal_ports import SignalPorts, check_takes

TERMINATIONS = ("", "success", "collision", "spill", "blocked", "violation", "time_limit")
"""How an episode can end; a ``termination`` port carries an index into this. The empty one means that it goes on."""

SUCCESS = TERMINATIONS.index("success")


@dataclass(frozen=True)
class TerminationTerm:
    """A condition that terminates an episode.

    Args:
        termination: what the episode ends as, one of `TERMINATIONS`.
        inputs: the signals it depends on, name to size; conditions of one monitor that name the same signal share it.
        holds: called with those signals by name, returns whether the condition holds; a pure function.
        steps: control steps for which it must hold before the episode ends, at least 1.
        progress: called like `holds`; where given, the steps counted are those since it last rose by `min_progress`
            above its highest value so far, whether they follow one another or not; otherwise they must be consecutive.
        min_progress: what counts as progress, in the units of `progress`.
    """

    termination: str
    inputs: Mapping[str, int]
    holds: Callable[..., bool]
    steps: int = 1
    progress: Callable[..., float] | None = None
    min_progress: float = 0.0

    def __post_init__(self) -> None:
        if self.termination not in TERMINATIONS[1:]:
            raise InputError(f"an episode can't end as '{self.termination}', only as one of {TERMINATIONS[1:]}")
        if self.steps < 1:
            raise InputError(f"a condition must hold for at least one control step, not {self.steps}")


class EpisodeMonitor(LeafSystem):
    """Evaluates named conditions, in order of precedence, and outputs which one terminated the episode.

    A condition counts every control step once: the output already counts the step that is just over, the state at the
    event of that instant. Once a condition terminated the episode, the output is constant.

    .. pydrake_system::

        name: EpisodeMonitor
        input_ports:
        - one per signal of the conditions
        output_ports:
        - termination

    ``termination`` is (1,): an index into `TERMINATIONS`, 0 while the episode goes on.
    """

    def __init__(self, conditions: Sequence[TerminationTerm], period: float, of: str = ""):
        """
        Args:
            conditions: where two hold in the same step, the first one counts.
            period: between two control steps [s], positive.
            of: whose episodes they end, for sentences.

        Raises:
            InputError: if there is no condition, the period is not positive, two conditions disagree about the size
                of a signal, or a function takes other names than its signals'.
        """
        super().__init__()
        if not conditions:
            raise InputError("a monitor needs at least one condition")
        check_period(period)
        for condition in conditions:
            for function in filter(None, (condition.holds, condition.progress)):
                whose = f" of {of}" if of else ""
                check_takes(function, condition.inputs, f"the condition {condition.termination!r}{whose}")
        self._conditions = tuple(conditions)
        self._indices = [TERMINATIONS.index(condition.termination) for condition in conditions]
        self._signals = SignalPorts(self, *(condition.inputs for condition in conditions))

        # Per condition the count and the best progress, then the termination, once there is one.
        self._initial_state = np.append(np.tile([0.0, -np.inf], len(self._conditions)), 0.0)
        self._state = self.DeclareDiscreteState(self._initial_state)
        # One evaluation a step serves both the output and, at the same instant, the event.
        self._next = declare_cache(
            self,
            "next_state",
            self._calc_next,
            prerequisites_of_calc=self._signals.tickets | {self.discrete_state_ticket(self._state)},
        )
        self._termination_port = self.DeclareVectorOutputPort(
            "termination", 1, self._calc_termination, prerequisites_of_calc={self._next.ticket()}
        )
        self.DeclareInitializationDiscreteUpdateEvent(self._reset)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)

    def get_signal_input_port(self, name: str) -> InputPort:
        """The signal of this name, of the size that its conditions gave it.

        Raises:
            InputError: if no condition depends on such a signal.
        """
        return self._signals.port(name)

    def get_termination_output_port(self) -> OutputPort:
        """Why the episode ended, (1,): an index into `TERMINATIONS`, 0 while it goes on."""
        return self._termination_port

    def _calc_next(self, context: Context) -> np.ndarray:
        signals = self._signals.eval(context)
        state = context.get_discrete_state(self._state).value().copy()
        for i, condition in enumerate(self._conditions):
            own = {name: signals[name] for name in condition.inputs}
            if condition.progress is not None:
                progress = float(condition.progress(**own))
                if progress > state[2 * i + 1] + condition.min_progress:
                    state[2 * i : 2 * i + 2] = 0.0, progress
                elif condition.holds(**own):
                    state[2 * i] += 1
            else:
                state[2 * i] = state[2 * i] + 1 if condition.holds(**own) else 0.0
            if state[-1] == 0 and state[2 * i] >= condition.steps:
                state[-1] = self._indices[i]
        return state

    def _calc_termination(self, context: Context, output: BasicVector) -> None:
        output.SetAtIndex(0, self._next.Eval(context)[-1])

    def _reset(self, context: Context, discrete_state: DiscreteValues) -> EventStatus:
        discrete_state.set_value(self._initial_state)
        return EventStatus.Succeeded()

    def _update(self, context: Context, discrete_state: DiscreteValues) -> EventStatus:
        # At time zero no step is over yet; an offset of one period instead would not fall on k * period exactly.
        if context.get_time() > 0:
            discrete_state.set_value(self._next.Eval(context))
        return EventStatus.Succeeded()
