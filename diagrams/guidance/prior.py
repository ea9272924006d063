"""Prior knowledge about a task, from which guidance is built.

`Prior` is what a task declares, `PriorKnowledge` what guidance is built from: `diagrams/envs/assemble.py` fills the
fields of `PrimitiveConfig` from those of `PrimitiveOptions` with equal names. `PriorKnowledge.primitive` is a
configuration, whose method `primitive` makes the movement primitive.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar

import numpy as np
from pydrake.math import RigidTransform

from guiderail.models.common.errors import InputError
from guiderail.models.common.transforms import POSE_SIZE, WRENCH_SIZE
from guiderail.models.primitives import Kernel, LcNsKmp, LinearConstraints, ReferenceTrajectory, SquaredExponential
from guiderail.models.primitives.gains import authority_gains, residual_gains
from guiderail.models.primitives.lc_ns_kmp import HISTORY, HORIZON, get_shared_primitive

if TYPE_CHECKING:
    from guiderail.models.control.command_filters import KeepOut
    from guiderail.models.control.motion_constraints import MotionConstraints
    from guiderail.models.laws import StateProgress
    from guiderail.models.templates import SharedControlTemplate


def limits_per_output(name: str, limits: Sequence[float], outputs: int) -> np.ndarray:
    """Return one limit for each output, (O,), from O limits, or from one limit for positions and one for angles.

    If only the limit for positions is given, angles have no limit (infinity).

    Raises:
        InputError: If there are no limits, or more than two but not O; `name` is their name in the message.
    """
    if len(limits) == outputs:
        return np.array(limits)
    if not 1 <= len(limits) <= 2:
        raise InputError(f"{name} is 1, 2 or {outputs} numbers for {outputs} outputs, not {len(limits)}")
    return np.where(np.arange(outputs) < 3, limits[0], (*limits, np.inf)[1])


@dataclass(frozen=True)
class PrimitiveConfig:
    """Configuration of a movement primitive: demonstrations, constraints, and the range of a policy's actions.

    Attributes:
        reference: Reference trajectory of the demonstrations, in steps of the control period.
        constraints: Linear constraints G y ≥ c on every command y.
        motion: Constraints of the commanded motion (shapes, speed, acceleration, joints), which are enforced on the
            primitive's output; None if there are none.
        control_period: Control period [s].
        history: P, number of past outputs that sKGRL's motion passes through.
        history_variance: ρ, variance of the past outputs [output²].
        adaptive_history: True if sKGRL's history is shortened during contact: repeatedly halved, down to one output.
        history_source: "commanded" or "measured" poses. Use commanded poses under impedance control: with a long
            measured history at a high rate, commands would follow the robot, and the force would vanish. Use measured
            poses if an operator may push a robot that tracks well.
        horizon: H, number of future points at which the constraints are satisfied.
        lambda_: Regularization λ of the thesis's problem 4.5.
        beta: Weight β of a null-space action in the thesis's problem 4.5.
        kernel: Kernel k of the movement primitive.
        action_scale: κ; a constant action of ±1 moves the outputs by √3 κ standard deviations of the demonstrations.
        action_dims: Indices of the outputs that the action moves; the action has one entry for each. Default: all.
        gains: Null-space action per unit of the policy's action, (O,); default: computed from κ.
        isotropic_groups: Groups of indices of outputs with the same unit; residual guidance has the same gain for all
            outputs of a group. Default: one group.
        keep_out: Walls at which safe residual RL stops the robot, if the task provides any.
        progress: Rule by which the motion waits for the robot; None if the clock drives the motion.
        wrench_size: W, size of a measured wrench.

    Raises:
        InputError: If an attribute is out of range, or the motion waits for the robot while constraints differ from
            step to step.
    """

    reference: ReferenceTrajectory
    constraints: LinearConstraints
    control_period: float
    history: int = HISTORY
    history_variance: float = 1e-6
    history_source: str = "commanded"
    adaptive_history: bool = False
    horizon: int = HORIZON
    lambda_: float = 6.0
    beta: float = 6.0
    kernel: Kernel = SquaredExponential()  # noqa: RUF009 (it is immutable)
    action_scale: float = 1.0
    action_dims: tuple[int, ...] | None = None
    gains: tuple[float, ...] | None = None
    isotropic_groups: tuple[tuple[int, ...], ...] | None = None
    keep_out: KeepOut | None = None
    motion: MotionConstraints | None = None
    progress: StateProgress | None = None
    wrench_size: int = 6

    def __post_init__(self) -> None:
        if self.progress is not None and self.constraints.num_steps is not None:
            raise InputError("constraints that differ from step to step need progress=clock")
        if self.action_dims is not None and not self.action_dims:
            raise InputError("a policy must move at least one output: name it in action_dims")
        if len(set(self.action_dims or ())) < len(self.action_dims or ()):
            raise InputError(f"action_dims names an output twice, {self.action_dims}: name each output once")
        if any(not 0 <= o < self.num_outputs for o in self.action_dims or ()):
            raise InputError(f"action_dims must be outputs from 0 to {self.num_outputs - 1}, not {self.action_dims}")

    @property
    def num_outputs(self) -> int:
        """O, size of a pose."""
        return self.reference.num_outputs

    @property
    def explored_outputs(self) -> tuple[int, ...]:
        """Indices of the outputs that an action moves, in the order of its entries."""
        return tuple(range(self.num_outputs)) if self.action_dims is None else self.action_dims

    @property
    def num_actions(self) -> int:
        """A, size of an action."""
        return len(self.explored_outputs)

    @cached_property
    def selection(self) -> np.ndarray:
        """Matrix (O, A) from an action to all outputs."""
        return np.eye(self.num_outputs)[:, list(self.explored_outputs)]

    @property
    def shorter_histories(self) -> tuple[int, ...]:
        """Lengths of an adaptive history that are shorter than P: P/2, P/4, … 1."""
        lengths, length = [], self.history
        while self.adaptive_history and length > 1:
            length //= 2
            lengths.append(length)
        return tuple(lengths)

    def primitive_of_length(self, history: int) -> LcNsKmp:
        """Return sKGRL's movement primitive with another length of the history."""
        return replace(self, history=history).primitive(history=True)

    def primitive(self, *, history: bool, constrained: bool = True) -> LcNsKmp:
        """Return the movement primitive.

        Args:
            history: True for the primitive of sKGRL, False for that of KGRL, which has no history.
            constrained: Enforce `constraints`; False for a baseline without constraints.
        """
        return get_shared_primitive(
            self.reference,
            self.constraints if constrained else LinearConstraints.none(self.num_outputs),
            self.kernel,
            lambda_=self.lambda_,
            beta=self.beta,
            horizon=self.horizon,
            history=self.history if history else 0,
            history_variance=self.history_variance,
        )

    def null_space_gains(self, primitive: LcNsKmp) -> np.ndarray:
        """Return the null-space action per unit of the policy's action, (O,).

        Raises:
            InputError: If `gains` are not O finite numbers, or actions have no effect on this primitive.
        """
        if self.gains is None:
            return authority_gains(primitive, self.action_scale, outputs=np.array(self.explored_outputs))
        gains = np.array(self.gains, dtype=float)
        if gains.shape != (self.num_outputs,) or not np.isfinite(gains).all():
            raise InputError(f"gains are {self.num_outputs} finite numbers, one per output, not {self.gains}")
        return gains

    def residual_gains(self) -> np.ndarray:
        """Return the displacement (O,) of a residual command per unit of the action, equal in each isotropic group."""
        return residual_gains(self.reference, self.action_scale, self.isotropic_groups or ())


@dataclass(frozen=True)
class PlacedTemplate:
    """Shared control template and the poses of its objects in a scene.

    Attributes:
        template: Shared control template.
        frames: Poses X_TF of the template's objects by name, in the frame of the station's poses.
        active_constraints: True if the active constraints are enforced; None: the guidance's default.
        max_tracking_error: Distance between robot and command [m] beyond which the last command is repeated, unless the
            new one is closer to the robot.

    Raises:
        InputError: If the template is not a `SharedControlTemplate`, or the frames are not poses by name.
    """

    template: SharedControlTemplate
    frames: Mapping[str, RigidTransform]
    active_constraints: bool | None = None
    max_tracking_error: float = np.inf

    def __post_init__(self) -> None:
        from guiderail.models.templates.template import check_template  # a task without a template does not need it

        check_template(self.template, self.frames)

    def is_constrained(self, by_default: bool) -> bool:
        """Return `active_constraints`, or the guidance's default `by_default` if `active_constraints` is None."""
        return by_default if self.active_constraints is None else self.active_constraints


@dataclass(frozen=True)
class ScriptedApproach:
    """Straight motion along z, for guidance without demonstrations, and the range of a policy's action around it.

    Attributes:
        heights: First and last height [m].
        speed: Speed [m/s].
        reach: Displacement of the command [m] along each axis at an action of 1.
    """

    heights: tuple[float, float]
    speed: float
    reach: float


Known = TypeVar("Known")
MaybeLazy: TypeAlias = Known | Callable[[], Known]
"""Value, or function that computes it when it is needed."""


@dataclass(frozen=True)
class Prior:
    """Prior knowledge that a task declares; what takes time may be a function without arguments.

    Attributes:
        reference: Reference trajectory of demonstrations; it is resampled to the control period.
        constraints: G y ≥ c on every commanded pose, or a function of the number of control steps that returns them;
            None if only the guidance has constraints, such as a template's.
        motion: Nonlinear constraints of the commanded motion, such as shapes to stay outside of, which guidance by a
            primitive enforces. Their linear part is `constraints`.
        keep_out: Walls at which safe residual RL stops the robot.
        template: Shared control template and the poses of its objects.
        approach: Scripted approach.
        isotropic_groups: Groups of outputs with the same unit, as indices. In residual RL, an action of 1 displaces all
            outputs of a group by the same amount. None: one group of all outputs.
        start_within: Largest start offset of a reset, training or held-out, which certificates assume: the distance
            from the reference's first pose for each output, (O,), or one number. Starts that are given by the options
            of a reset are not included.
    """

    reference: MaybeLazy[ReferenceTrajectory] | None = None
    constraints: LinearConstraints | Callable[[int], LinearConstraints] | None = None
    motion: MotionConstraints | None = None
    keep_out: KeepOut | None = None
    template: MaybeLazy[PlacedTemplate] | None = None
    approach: ScriptedApproach | None = None
    isotropic_groups: tuple[tuple[int, ...], ...] | None = None
    start_within: np.ndarray | float = 0.0

    @property
    def provides(self) -> tuple[str, ...]:
        """Kinds of prior knowledge: keys of `guidance.registry.REQUIREMENTS`."""
        fields = {name: name for name in ("keep_out", "template", "approach")} | {"demonstrations": "reference"}
        return tuple(name for name, attribute in fields.items() if getattr(self, attribute) is not None)


@dataclass(frozen=True)
class PriorKnowledge:
    """Prior knowledge about a task; an attribute is None if the task does not provide it.

    Attributes:
        period: Control period [s].
        primitive: Movement primitive of demonstrations with constraints, keep-out walls, and the range of a policy's
            action.
        template: Shared control template and the poses of its objects.
        approach: Scripted approach.
        options: Options of the guidance by name; empty if it declares none.
        pose_size: Size O of the station's pose.
        wrench_size: Size W of the station's wrench.
    """

    period: float
    primitive: PrimitiveConfig | None = None
    template: PlacedTemplate | None = None
    approach: ScriptedApproach | None = None
    options: Mapping[str, Any] = field(default_factory=dict)
    pose_size: int = POSE_SIZE
    wrench_size: int = WRENCH_SIZE

    @property
    def constraints(self) -> LinearConstraints:
        """Linear constraints on a commanded pose (O,); no rows without demonstrations."""
        config = self.primitive
        return LinearConstraints.none(self.pose_size) if config is None else config.constraints

    def has(self, requirement: str) -> bool:
        """Return True if the task provides a requirement: "demonstrations", "keep_out", "template" or "approach"."""
        if requirement == "keep_out":
            return self.primitive is not None and self.primitive.keep_out is not None
        return getattr(self, "primitive" if requirement == "demonstrations" else requirement) is not None
