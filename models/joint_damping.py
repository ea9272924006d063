"""Torques that take an arm's speed away."""

import numpy as np


def damping_torque(
    M: np.ndarray, v: np.ndarray, decay_time: float, *, period: float, damped: float = 0.0
) -> np.ndarray:
    """τ = −M(q) v exp(−t / T) (1 − exp(−h / T)) / h, which takes away all joints' speed with the decay time T.

    Held for each period h, these torques add up to exactly the momentum that the arm had: where its speed is not seen
    any more, nothing is driven backwards by one that is long gone.

    Args:
        M: mass matrix, (n, n).
        v: joint velocities as they were, (n,) [rad/s].
        decay_time: T [s].
        period: h, for which a torque is held [s].
        damped: t, for how long the arm has been damped since it had these velocities [s].
    """
    return -(M @ v) * (np.exp(-damped / decay_time) * -np.expm1(-period / decay_time) / period)
