"""Limits of velocity, acceleration and jerk of the desired poses that a robot accepts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from guiderail.models.common.errors import InputError


@dataclass(frozen=True)
class MotionLimits:
    """Largest norms of velocity, acceleration and jerk of a pose.

    Raises:
        InputError: If a limit is not positive and finite, or the angular limits leave no acceleration or jerk for the
            rotation vector (`rotation_vector_limits`).
    """

    linear: tuple[float, float, float]  # velocity [m/s], acceleration [m/s²] and jerk [m/s³] of the position
    angular: tuple[float, float, float]  # velocity [rad/s], acceleration [rad/s²] and jerk [rad/s³] of the orientation

    def __post_init__(self) -> None:
        if not all(np.isfinite(limit) and limit > 0.0 for limit in (*self.linear, *self.angular)):
            raise InputError(f"limits of a motion must be positive and finite, not {self.linear} and {self.angular}")
        if min(self.rotation_vector_limits()) <= 0.0:
            raise InputError(f"an angular velocity of {self.angular[0]} rad/s needs more acceleration and jerk")

    def scaled(self, factor: float) -> MotionLimits:
        """Return the limits times a factor in (0, 1].

        Raises:
            InputError: If the factor is out of range.
        """
        if not 0.0 < factor <= 1.0:
            raise InputError(f"a factor of motion limits must be above 0 and at most 1, not {factor}")
        linear, angular = ((factor * v, factor * a, factor * j) for v, a, j in (self.linear, self.angular))
        return MotionLimits(linear, angular)

    def rotation_vector_limits(self) -> tuple[float, float, float]:
        """Return limits of the derivatives of a rotation vector r that imply the angular limits.

        The angular velocity is ω = J(r) ṙ with the left Jacobian J of SO(3). For ‖r‖ ≤ π the norms of J and of its
        first and second directional derivatives are at most 1, 1/2 and 1/3 (tested numerically). Hence ‖ω‖ ≤ ‖ṙ‖,
        ‖ω̇‖ ≤ ‖r̈‖ + ‖ṙ‖²/2 and ‖ω̈‖ ≤ ‖r⃛‖ + 3 ‖ṙ‖ ‖r̈‖/2 + ‖ṙ‖³/3.
        """
        velocity, acceleration, jerk = self.angular
        acceleration -= velocity**2 / 2.0
        return velocity, acceleration, jerk - 1.5 * velocity * acceleration - velocity**3 / 3.0
