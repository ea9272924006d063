"""Reward as a sum of named terms."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from operator import itemgetter
from typing import Any

import numpy as np
from pydrake.systems.framework import Context, OutputPort

from guiderail.models.common.errors import InputError, brief
from guiderail.systems.support import declarations as declare
from guiderail.systems.support.convertible_system import ConvertibleSystem
from guiderail.systems.support.declarations import SignalPorts, check_signature, output_getter


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
