"""Limits of a commanded motion: velocity, acceleration and jerk of a pose (Franka Control Interface, "Limits")."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from guiderail.models.common.errors import InputError


@dataclass(frozen=True)
class MotionLimits:
    """Largest norms of velocity, acceleration and jerk of a pose."""

    linear: tuple[float, float, float]  # limits of the position: [m/s], [m/s²], [m/s³]
    angular: tuple[float, float, float]  # limits of the orientation: [rad/s], [rad/s²], [rad/s³]

    def __post_init__(self) -> None:
        """Check the limits.

        Raises:
            InputError: If a limit is not positive and finite, or the angular limits leave no acceleration or jerk for
                the rotation vector (`rotation_vector_limits`).
        """
        if not all(np.isfinite(limit) and limit > 0.0 for limit in (*self.linear, *self.angular)):
            raise InputError(f"limits of a motion are positive and finite, not {self.linear} and {self.angular}")
        if min(self.rotation_vector_limits()) <= 0.0:
            raise InputError(f"an angular velocity of {self.angular[0]} rad/s needs more acceleration and jerk")

    def scaled(self, factor: float) -> MotionLimits:
        """Return the limits times a factor from 0 (excluded) to 1.

        Raises:
            InputError: If the factor is out of range.
        """
        if not 0.0 < factor <= 1.0:
            raise InputError(f"a share of the limits of a motion is from 0 to 1, not {factor}")
        linear, angular = ((factor * v, factor * a, factor * j) for v, a, j in (self.linear, self.angular))
        return MotionLimits(linear, angular)

    def rotation_vector_limits(self) -> tuple[float, float, float]:
        """Return limits of the derivatives of a rotation vector r that imply the angular limits.

        The angular velocity is ω = J(r) ṙ with the left Jacobian J of SO(3). For ‖r‖ ≤ π the norms of J and of its
        first and second directional derivative are at most 1, 1/2 and 1/3 (tested numerically). Hence ‖ω‖ ≤ ‖ṙ‖,
        ‖ω̇‖ ≤ ‖r̈‖ + ‖ṙ‖²/2 and ‖ω̈‖ ≤ ‖r⃛‖ + 3 ‖ṙ‖ ‖r̈‖/2 + ‖ṙ‖³/3.
        """
        velocity, acceleration, jerk = self.angular
        acceleration -= velocity**2 / 2.0
        return velocity, acceleration, jerk - 1.5 * velocity * acceleration - velocity**3 / 3.0


FRANKA_LIMITS = MotionLimits((1.7, 13.0, 6500.0), (2.5, 25.0, 12500.0))
"""Limits of a Cartesian motion that libfranka enforces for a Franka Emika Panda and an FR3."""
