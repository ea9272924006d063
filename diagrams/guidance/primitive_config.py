"""A skill learned from demonstrations: what every guidance made of a movement primitive is built from."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from guiderail.models.common.errors import InputError
from guiderail.models.control.keep_out import KeepOut
from guiderail.models.primitives import Kernel, LcNsKmp, LinearConstraints, ReferenceTrajectory, SquaredExponential
from guiderail.models.primitives.gains import authority_gains
from guiderail.models.primitives.lc_ns_kmp import get_shared_primitive

HISTORY_SOURCES = ("commanded", "measured")


@dataclass(frozen=True)
class PrimitiveConfig:
    """Demonstrations, constraints, and how a policy may move between them.

    Attributes:
        reference: what the demonstrations have in common; its clock is the control period.
        constraints: G y ≥ c on every command.
        control_period: s, seconds between control steps.
        history: P, past outputs that sKGRL's motion passes through.
        history_variance: ρ [output²], how exactly it does.
        adaptive_history: whether sKGRL's history halves, down to a single output, while the robot touches something.
        history_source: "commanded" or "measured": what counts as the past. Commanded under impedance control (else the
            command follows the robot, and the push dies); measured where a person may push a robot that tracks well.
        horizon: H, future points that constraints are kept at.
        lambda_, beta: λ and β of problem 4.5.
        kernel: k of the movement primitive.
        action_scale: κ, where a constant action of ±1 ends up: √3 κ demonstration standard deviations away.
        explored: indices of the outputs that the policy moves; all unless given. An action has one entry for each.
        gains: (O,) raw null-space units per action, instead of those computed from κ.
        isotropic_groups: outputs of one unit each; a residual moves all outputs of a group alike. One group unless
            given.
        solver: of the constrained primitive's QP: "daqp", "osqp" or "piqp".
        keep_out: what safe residual learning stops before; None where nobody has written that down.
        wrench_size: numbers in a measured wrench.
    """

    reference: ReferenceTrajectory
    constraints: LinearConstraints
    control_period: float
    history: int = 10
    history_variance: float = 1e-6
    history_source: str = "commanded"
    adaptive_history: bool = False
    horizon: int = 40
    lambda_: float = 6.0
    beta: float = 6.0
    kernel: Kernel = SquaredExponential()  # noqa: RUF009 (it is immutable)
    action_scale: float = 1.0
    action_dims: tuple[int, ...] | None = None
    gains: tuple[float, ...] | None = None
    isotropic_groups: tuple[tuple[int, ...], ...] | None = None
    solver: str = "daqp"
    keep_out: KeepOut | None = None
    wrench_size: int = 6

    def __post_init__(self) -> None:
        if self.history_source not in HISTORY_SOURCES:
            raise InputError(f"a history is {' or '.join(HISTORY_SOURCES)}, not '{self.history_source}'")
        if not (np.isfinite(self.action_scale) and self.action_scale > 0):
            raise InputError(f"action_scale is how far a policy may go and must be positive, not {self.action_scale}")
        if self.history < 1:
            raise InputError(f"history is how many past outputs sKGRL remembers, at least 1, not {self.history}")
        if self.action_dims is not None and not self.action_dims:
            raise InputError("a policy must move at least one output: name it in explored")
        if len(set(self.action_dims or ())) < len(self.action_dims or ()):
            raise InputError(f"explored names an output twice, {self.action_dims}: each has one action")
        if any(not 0 <= o < self.num_outputs for o in self.action_dims or ()):
            raise InputError(f"explored names outputs 0 … {self.num_outputs - 1}, not {self.action_dims}")

    @property
    def num_outputs(self) -> int:
        """O."""
        return self.reference.num_outputs

    @property
    def explored_outputs(self) -> tuple[int, ...]:
        """The outputs that an action moves, in the order of its entries."""
        return tuple(range(self.num_outputs)) if self.action_dims is None else self.action_dims

    @property
    def num_actions(self) -> int:
        """Entries of an action."""
        return len(self.explored_outputs)

    @cached_property
    def selection(self) -> np.ndarray:
        """(O, A): puts an action's entries where the outputs that it moves are."""
        return np.eye(self.num_outputs)[:, list(self.explored_outputs)]

    @property
    def shorter_histories(self) -> tuple[int, ...]:
        """The lengths that an adaptive history has beside P: P/2, P/4, … 1."""
        lengths, length = [], self.history
        while self.adaptive_history and length > 1:
            length //= 2
            lengths.append(length)
        return tuple(lengths)

    def primitive_of_length(self, history: int) -> LcNsKmp:
        """sKGRL's movement primitive with another history."""
        return replace(self, history=history).primitive(history=True)

    def primitive(self, *, history: bool, constrained: bool = True) -> LcNsKmp:
        """The movement primitive of sKGRL (with history), KGRL (without) or the demonstrations alone."""
        return get_shared_primitive(
            self.reference,
            self.constraints if constrained else LinearConstraints.none(self.num_outputs),
            self.kernel,
            lambda_=self.lambda_,
            beta=self.beta,
            horizon=self.horizon,
            history=self.history if history else 0,
            history_variance=self.history_variance,
            solver=self.solver,
        )

    def null_space_gains(self, primitive: LcNsKmp) -> np.ndarray:
        """(O,): what an action of one is worth in raw null-space units.

        Raises:
            InputError: if `gains` are not O finite numbers, or actions do nothing to this primitive.
        """
        if self.gains is None:
            return authority_gains(primitive, self.action_scale, outputs=np.array(self.explored_outputs))
        gains = np.array(self.gains, dtype=float)
        if gains.shape != (self.num_outputs,) or not np.isfinite(gains).all():
            raise InputError(f"gains are {self.num_outputs} finite numbers, one per output, not {self.gains}")
        return gains

    def residual_gains(self) -> np.ndarray:
        """(O,): what an action of one adds to the command, alike for all outputs of a unit.

        √3 κ times the RMS over the motion of the demonstrations' standard deviations: as far as a null-space action of
        one goes on average, but everywhere and in every direction.
        """
        variances = np.mean(self.reference.standard_deviations**2, axis=0)
        gains = np.zeros(self.num_outputs)
        for group in self.isotropic_groups or (tuple(range(self.num_outputs)),):
            gains[list(group)] = np.sqrt(3.0) * self.action_scale * np.sqrt(variances[list(group)].mean())
        return gains
