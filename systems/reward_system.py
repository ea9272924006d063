"""A reward as a sum of named terms."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from pydrake.systems.framework import BasicVector, Context, InputPort, LeafSystem, OutputPort

from guiderail.systems.caching import declare_array_cache


@dataclass(frozen=True)
class RewardTerm:
    """One term of a reward.

    Args:
        name: of its output port.
        inputs: the signals it depends on, name to size; terms that name the same signal share it.
        value: called with those signals by name, gives the term of this control step; a pure function.
    """

    name: str
    inputs: Mapping[str, int]
    value: Callable[..., float]


class RewardSystem(LeafSystem):
    """Adds up named terms, r = Σ_i r_i (as in thesis, equation 4.22), and shows each of them.

    .. pydrake_system::

        name: RewardSystem
        input_ports:
        - one per signal of the terms
        output_ports:
        - reward
        - one per term

    Every output is (1,). The system has no state: a term that compares with the last control step gets that from a
    `ZeroOrderHold` of the control period.
    """

    def __init__(self, terms: Sequence[RewardTerm]):
        """
        Args:
            terms: at least one, of different names, none of them "reward".

        Raises:
            ValueError: if there is no term, a name is taken, or two terms disagree about the size of a signal.
        """
        super().__init__()
        names = [term.name for term in terms]
        if not names or len(set(names)) < len(names) or "reward" in names:
            raise ValueError(f"a reward needs terms of different names, other than 'reward', not {names}")
        sizes: dict[str, int] = {}
        for term in terms:
            for name, size in term.inputs.items():
                if sizes.setdefault(name, size) != size:
                    raise ValueError(f"signal '{name}' can't be of size {sizes[name]} and {size}")
        self._terms = tuple(terms)
        self._signals = {name: self.DeclareVectorInputPort(name, size) for name, size in sizes.items()}
        self._values = declare_array_cache(
            self,
            "terms",
            self._calc_terms,
            {port.ticket() for port in self._signals.values()} or {self.nothing_ticket()},
        )
        tickets = {self._values.ticket()}
        self._reward_port = self.DeclareVectorOutputPort("reward", 1, self._calc_reward, prerequisites_of_calc=tickets)
        self._term_ports = {
            term.name: self.DeclareVectorOutputPort(term.name, 1, self._term_calc(i), prerequisites_of_calc=tickets)
            for i, term in enumerate(terms)
        }

    @property
    def term_names(self) -> tuple[str, ...]:
        """The names of the terms, in order."""
        return tuple(self._term_ports)

    def get_signal_input_port(self, name: str) -> InputPort:
        """The signal of this name, of the size its terms gave it."""
        return self._signals[name]

    def get_reward_output_port(self) -> OutputPort:
        """The sum of all terms, (1,)."""
        return self._reward_port

    def get_term_output_port(self, name: str) -> OutputPort:
        """The term of this name, (1,)."""
        return self._term_ports[name]

    def _calc_terms(self, context: Context) -> np.ndarray:
        signals = {name: port.Eval(context) for name, port in self._signals.items()}
        return np.array([term.value(**{name: signals[name] for name in term.inputs}) for term in self._terms], float)

    def _calc_reward(self, context: Context, output: BasicVector) -> None:
        output.SetAtIndex(0, self._values.Eval(context).sum())

    def _term_calc(self, i: int) -> Callable[[Context, BasicVector], None]:
        return lambda context, output: output.SetAtIndex(0, self._values.Eval(context)[i])
