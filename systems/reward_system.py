"""A reward as a sum of named terms."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from pydrake.systems.framework import BasicVector, Context, InputPort, LeafSystem, OutputPort

from guiderail.models.common.errors import InputError, brief
from guiderail.systems.support.caching import declare_cache
from guiderail.systems.support.signal_ports import SignalPorts, check_takes


@dataclass(frozen=True)
class RewardTerm:
    """One term of a reward.

    Args:
        name: of its output port.
        inputs: the signals it depends on, name to size; terms that name the same signal share it.
        value: called with those signals by name, returns the term of this control step; a pure function.
    """

    name: str
    inputs: Mapping[str, int]
    value: Callable[..., float]


class RewardSystem(LeafSystem):
    """Computes a reward as the sum of named terms, each of which is an output too.

        r = Σ_i r_i    (as in equation 4.22)

    .. pydrake_system::

        name: RewardSystem
        input_ports:
        - one per signal of the terms
        output_ports:
        - reward
        - one per term

    Every output is (1,). The system has no state: a term that depends on the last control step gets its values from a
    `ZeroOrderHold` of the control period.
    """

    def __init__(self, terms: Sequence[RewardTerm], of: str = ""):
        """
        Args:
            terms: at least one, of different names, none of them empty or "reward".
            of: whose reward it is, for sentences.

        Raises:
            InputError: if there is no term, a name is taken, two terms disagree about the size of a signal, or a
                function takes other names than its signals'. When it is evaluated: if a term is no finite number.
        """
        super().__init__()
        names = [term.name for term in terms]
        self._terms, self._of = tuple(terms), f" of {of}" if of else ""
        if not names or len(set(names)) < len(names) or "reward" in names or "" in names:
            raise InputError(
                f"a reward{self._of} needs terms of different names, neither empty nor 'reward', not {brief(names)}"
            )
        for term in terms:
            check_takes(term.value, term.inputs, f"reward term {term.name!r}{self._of}")
        self._signals = SignalPorts(self, *(term.inputs for term in terms))
        self._values = declare_cache(
            self,
            "terms",
            self._calc_terms,
            prerequisites_of_calc=self._signals.tickets or {self.nothing_ticket()},
        )
        values = {self._values.ticket()}
        self._reward_port = self.DeclareVectorOutputPort("reward", 1, self._calc_reward, prerequisites_of_calc=values)
        self._term_ports = {
            term.name: self.DeclareVectorOutputPort(term.name, 1, self._term_calc(i), prerequisites_of_calc=values)
            for i, term in enumerate(terms)
        }

    @property
    def term_names(self) -> tuple[str, ...]:
        """The names of the terms, in order."""
        return tuple(self._term_ports)

    def get_signal_input_port(self, name: str) -> InputPort:
        """The signal of this name, of the size that its terms gave it.

        Raises:
            InputError: if no term depends on such a signal.
        """
        return self._signals.port(name)

    def get_reward_output_port(self) -> OutputPort:
        """The sum of all terms, (1,)."""
        return self._reward_port

    def get_term_output_port(self, name: str) -> OutputPort:
        """The term of this name, (1,).

        Raises:
            InputError: if there is none.
        """
        if name not in self._term_ports:
            raise InputError(f"the reward has no term '{name}', only {', '.join(self._term_ports)}")
        return self._term_ports[name]

    def _calc_terms(self, context: Context) -> np.ndarray:
        signals = self._signals.eval(context)
        return np.array([self._value(term, signals) for term in self._terms])

    def _value(self, term: RewardTerm, signals: Mapping[str, np.ndarray]) -> float:
        value = term.value(**{name: signals[name] for name in term.inputs})
        array = np.asarray(value)
        if array.size != 1 or array.dtype.kind not in "fiub":
            raise InputError(f"reward term {term.name!r}{self._of} must be one number, and it is {brief(value)}")
        number = float(array.item())
        # A learner that takes this in diverges, and is blamed for it episodes later.
        if not math.isfinite(number):
            raise InputError(f"reward term {term.name!r}{self._of} is not finite, but {number}")
        return number

    def _calc_reward(self, context: Context, output: BasicVector) -> None:
        output.SetAtIndex(0, self._values.Eval(context).sum())

    def _term_calc(self, i: int) -> Callable[[Context, BasicVector], None]:
        return lambda context, output: output.SetAtIndex(0, self._values.Eval(context)[i])
