"""Constraints of a commanded motion (shapes, speed, acceleration and others), and a filter that satisfies them.

Joint limits are a `StateConstraints` of `models/robots/joint_range.py`. A robot's own limits are `MotionLimits` of
packages/hardware. `CommandFilter` and `PrimitiveLaw` use the filter, so kgrl, skgrl, kmp and `GuidedEnv` do; residual
guidance refuses limits.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike

from guiderail.models.common.arrays import as_numbers, is_finite
from guiderail.models.common.errors import InputError, brief
from guiderail.models.control.damped_inverse import LEVER
from guiderail.models.control.shapes import CLEARANCE, ConvexShape
from guiderail.models.primitives import LinearConstraints, UnsolvableError
from guiderail.models.primitives.constraints import TOLERANCE
from guiderail.models.primitives.qp import solve_least_norm

# Distances from a shape and from the plane of a linear constraint: the distance that the QP requires, and the smaller
# distance that every command has. The difference allows for the solver's tolerance.
_SHAPE, _PLANE = (CLEARANCE, 0.5 * CLEARANCE), (0.0, -0.5 * TOLERANCE)
# Largest difference of an output between the desired and the last command [unit of the output]. Larger differences are
# clipped, because the command is the desired one plus a move, and the sum of two large numbers is inexact.
_REACH = 1e4
_ROUNDING = 5e-7  # share of the width of the speed and acceleration box by which a solution may exceed the box
_BISECTIONS = 12  # number of bisections between the braking command and the nearest command


class StateConstraints(Protocol):
    """Constraints that are linearized at the last command and checked at the next one, such as joint limits."""

    def linearize(self, output: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return rows G (F, O) of unit norm and c (F,) of G y ≥ c near an output (O,)."""
        ...

    def violation(self, output: np.ndarray) -> float:
        """Return the violation of an output (O,) [rad], negative inside."""
        ...


class Violations(NamedTuple):
    """Largest violation of each kind of constraint, negative inside and −inf without constraints of the kind."""

    linear: float  # max(c − G y) with rows of unit norm [unit of the output]
    shapes: float  # largest depth inside a shape [m]
    state: float  # largest violation of state constraints, such as joint limits [rad]


@dataclass(frozen=True)
class MotionConstraints:
    """Constraints of a commanded motion.

    Raises:
        InputError: If sizes do not match, a limit is not positive, or `linear` differs from step to step.
    """

    linear: LinearConstraints  # G y ≥ c on every command (O,), the same at every step
    outside: Sequence[ConvexShape] = ()  # shapes that the commanded positions (the first D outputs) must not enter
    max_speed: ArrayLike | None = None  # largest speed of each output, (O,) [unit/s]; infinite by default
    max_acceleration: ArrayLike | None = None  # largest acceleration, (O,) [unit/s²]; infinite by default
    state: Sequence[StateConstraints] = ()  # further constraints, such as joint limits

    def __post_init__(self) -> None:
        if self.linear.num_steps is not None:
            raise InputError("shapes, speed and acceleration need linear constraints that do not change between steps")
        if any(shape.num_dims > self.num_outputs for shape in self.outside):
            raise InputError(f"a shape has more dimensions than a command has outputs, {self.num_outputs}")
        for name in ("max_speed", "max_acceleration"):
            value = getattr(self, name)
            limit = np.full(self.num_outputs, np.inf) if value is None else as_numbers(value, name)
            if limit.shape != (self.num_outputs,) or not (limit > 0.0).all():
                raise InputError(f"{name} is {self.num_outputs} positive numbers, not {brief(value)}")
            object.__setattr__(self, name, limit)

    @property
    def num_outputs(self) -> int:
        """Number of outputs O."""
        return self.linear.num_outputs

    @property
    def num_steps(self) -> None:
        """None: the constraints are the same at every step."""
        return None

    def violations(self, output: np.ndarray) -> Violations:
        """Return the largest violation of each kind of constraint by a command (O,).

        A violation is NaN if that of one constraint is NaN, as for a command with NaN.
        """
        shapes = [-shape.distance(output[: shape.num_dims]) for shape in self.outside]
        state = [constraint.violation(output) for constraint in self.state]
        return Violations(self.linear.violation(output), _largest(shapes), _largest(state))

    def violation(self, output: np.ndarray, step: int = 0) -> float:
        """Return the largest of the `violations` of a command (O,), with angles as arc lengths of radius `LEVER`.

        `step` has no effect; `LinearConstraints.violation` has the same argument.
        """
        linear, shapes, state = self.violations(output)
        return _largest([linear, shapes, LEVER * state])

    def refuse_limits(self) -> None:
        """Raise an InputError if there are limits besides shapes, for guidance that does not enforce them."""
        limits = {
            "max_speed": np.isfinite(np.asarray(self.max_speed, dtype=float)).any(),
            "max_acceleration": np.isfinite(np.asarray(self.max_acceleration, dtype=float)).any(),
            "joint_margin": bool(self.state),
        }
        if names := " and ".join(name for name, is_given in limits.items() if is_given):
            raise InputError(f"only kgrl, skgrl and kmp enforce {names}: choose one of them, or leave {names} out")


def _largest(violations: list[float]) -> float:
    """Return the largest violation, −inf if there is none, NaN if any is NaN (Python's `max` may ignore it)."""
    return float(np.max(violations, initial=-np.inf))


class MotionConstraintFilter:
    """Filter that computes the nearest command within `MotionConstraints` from which the motion can still stop.

    In each step all constraints are replaced by linear constraints. The shapes become half-spaces, linearized
    at the last command, so that the true constraint also holds between two commands. Speed and acceleration become
    boxes

        |y − p| ≤ v h        |y − 2 p + p'| ≤ a h²

    for the last two commands p and p'. The nearest command is the solution of a QP. It is executed if the motion can
    then brake within the constraints, on a straight line at the largest deceleration. Otherwise, the farthest safe
    command on the line from the braking command to the nearest command is executed. A safe command always exists,
    because braking was verified one step earlier. Without a largest acceleration, braking repeats the last command.

    If the start is outside of the constraints (after a push, or because the constraints moved), the commands move back
    inside. Once inside, every command satisfies all constraints.

    A motion that starts with a velocity (see `start`) stops before the constraints, even if the first step must exceed
    the largest acceleration for it. A motion that starts faster than the largest speed slows down within the largest
    acceleration.

    Args:
        constraints: Constraints.
        period: Time between two commands h [s], positive.

    Attributes:
        num_outputs: Number of outputs O.
        constraints: Constraints.
    """

    needs_pose = False

    def __init__(self, constraints: MotionConstraints, period: float):
        self.constraints, self.num_outputs = constraints, constraints.num_outputs
        self._max_step = period * np.asarray(constraints.max_speed)
        self._max_change = period**2 * np.asarray(constraints.max_acceleration)
        self._has_acceleration = bool(np.isfinite(self._max_change).any())
        self._identity = np.eye(self.num_outputs)

    def start(self, pose: np.ndarray, displacement: np.ndarray | None = None) -> np.ndarray:
        """Return the state (2 O,) of a motion that starts at a pose (O,): last command and displacement in one step.

        The displacement (O,) is zero by default. If the motion cannot brake within the largest acceleration before it
        leaves the constraints, its displacement is reduced by a factor until it can. Only this first change exceeds the
        largest acceleration.
        """
        if displacement is None:
            return np.concatenate([pose, np.zeros(self.num_outputs)])
        safe, share = 0.0, 1.0
        if not self._can_brake(pose, displacement):
            for k in range(1, _BISECTIONS + 1):
                share = safe + 0.5**k
                safe = share if self._can_brake(pose, share * displacement) else safe
            share = safe
        return np.concatenate([pose, share * displacement])

    def apply(self, state: np.ndarray, desired: np.ndarray, pose: np.ndarray | None = None) -> tuple[np.ndarray, bool]:
        """Return the next state (2 O,), which begins with the command, and True if only braking was safe.

        The motion brakes if the desired command (O,) is not finite. The measured pose is not used.
        """
        last, velocity = state[: self.num_outputs], state[self.num_outputs :]
        share, rest_share = self._braking(velocity)
        brake, rest = last + share * velocity, last + rest_share * velocity
        braking = np.concatenate([brake, brake - last]), True
        if not is_finite(desired):
            return braking
        desired = np.minimum(np.maximum(desired, last - _REACH), last + _REACH)
        G, c = self._linearize(last, rest)
        slack = np.minimum(G @ last, G @ rest) - c
        is_shape = np.arange(len(c)) < len(self.constraints.outside)
        aim, margin = (np.where(is_shape, *pair) for pair in zip(_SHAPE, _PLANE, strict=True))
        required = c + np.minimum(margin, slack)
        lower = np.minimum(np.maximum(last - self._max_step, last + velocity - self._max_change), brake)
        upper = np.maximum(np.minimum(last + self._max_step, last + velocity + self._max_change), brake)
        goals = [c + aim]
        if (is_outside := slack < margin).any():
            # First goal: approach violated constraints almost as fast as possible. Second goal: violate them no more.
            best = np.where(G > 0.0, G, 0.0) @ _finite(upper) + np.where(G < 0.0, G, 0.0) @ _finite(lower)
            towards = 0.9 * np.minimum(best, c + aim) + 0.1 * (c + slack)
            goals = [np.where(is_outside, towards, c + aim), required]
        attempts = (self._nearest(desired, G, goal, lower, upper) for goal in goals)
        nearest = next((command for command in attempts if command is not None), None)
        if nearest is None:
            return braking
        if (np.maximum(lower - nearest, nearest - upper) > _ROUNDING * (upper - lower)).any():
            nearest = np.minimum(np.maximum(nearest, lower), upper)
        states = [(limits, max(0.0, limits.violation(rest))) for limits in self.constraints.state]

        def is_safe(command: np.ndarray) -> bool:
            """Return True if the path via `command` to the end of braking satisfies the constraints."""
            displacement = command - last
            rest_share = self._braking(displacement)[1]
            end = command + rest_share * displacement
            checked = (command, end) if rest_share else (command,)
            return bool((G @ end >= required).all()) and all(
                limits.violation(output) <= bound for limits, bound in states for output in checked
            )

        if is_safe(nearest):
            return np.concatenate([nearest, nearest - last]), False
        safe, unsafe = 0.0, 1.0
        for _ in range(_BISECTIONS):
            middle = 0.5 * (safe + unsafe)
            safe, unsafe = (middle, unsafe) if is_safe(brake + middle * (nearest - brake)) else (safe, middle)
        command = brake + safe * (nearest - brake)
        return np.concatenate([command, command - last]), safe == 0.0

    def _can_brake(self, pose: np.ndarray, displacement: np.ndarray) -> bool:
        """Return True if braking from a pose (O,) satisfies the constraints, or violates them no more than the pose.

        `displacement` (O,) is the displacement of the previous step.
        """
        brake, rest = (pose + share * displacement for share in self._braking(displacement))
        constraints, rounding = self.constraints, -_PLANE[1]
        G, c = constraints.linear.G, constraints.linear.c
        if not (c - G @ rest <= np.maximum(c - G @ pose, rounding)).all():
            return False
        for shape in constraints.outside:
            first, last = pose[: shape.num_dims], rest[: shape.num_dims]
            normal, bound = shape.separate(first, last)
            if not bound - min(normal @ first, normal @ last) <= max(-shape.distance(first), rounding):
                return False
        return all(
            limits.violation(output) <= max(limits.violation(pose), rounding)
            for limits in constraints.state
            for output in (brake, rest)
        )

    def _braking(self, velocity: np.ndarray) -> tuple[float, float]:
        """Return the braking displacements in the next step and until rest, as shares of the last displacement (O,).

        The shares of the steps are 1 − φ, 1 − 2 φ, …, with the largest φ within the acceleration limits of all outputs.
        """
        share = math.inf
        if self._has_acceleration:
            pairs = zip(self._max_change.tolist(), velocity.tolist(), strict=True)
            share = min((change / abs(v) for change, v in pairs if v), default=math.inf)
        if share >= 1.0:
            return 0.0, 0.0
        steps = math.floor(1.0 / share)
        return 1.0 - share, steps - 0.5 * share * steps * (steps + 1)

    def _linearize(self, last: np.ndarray, rest: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return constraints G y ≥ c, G (F, O) and c (F,), for the path from the last command to the end of braking."""
        constraints = self.constraints
        shapes = constraints.outside
        rows, bounds = np.zeros((len(shapes), self.num_outputs)), np.zeros(len(shapes))
        for k, shape in enumerate(shapes):
            D = shape.num_dims
            rows[k, :D], bounds[k] = shape.separate(last[:D], rest[:D])
        states = [limits.linearize(last) for limits in constraints.state]
        G, c = zip((rows, bounds), (constraints.linear.G, constraints.linear.c), *states, strict=True)
        return np.concatenate(G), np.concatenate(c)

    def _nearest(
        self, desired: np.ndarray, G: np.ndarray, c: np.ndarray, lower: np.ndarray, upper: np.ndarray
    ) -> np.ndarray | None:
        """Return the command (O,) nearest to the desired one with G y ≥ c in the box, or None if there is none."""
        missing, below, above = c - G @ desired, lower - desired, upper - desired
        if max(missing.max(initial=-1.0), below.max(), -above.min()) <= 0.0:
            return desired
        is_box = np.isfinite(below)  # the upper side is then finite too
        rows = np.concatenate([G, self._identity[is_box]])
        low = np.append(missing, below[is_box])
        high = np.append(np.full(len(missing), np.inf), above[is_box])
        try:
            move, _ = solve_least_norm(rows, low, high)
        except UnsolvableError:
            return None
        return desired + move


def _finite(bounds: np.ndarray) -> np.ndarray:
    """Replace infinite bounds (O,) by large numbers, because zero times infinity is NaN."""
    return np.nan_to_num(bounds, posinf=1e9, neginf=-1e9)
