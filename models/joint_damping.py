"""Torques that take an arm's speed away."""

import numpy as np


def damping_torque(M: np.ndarray, v: np.ndarray, decay_time: float, damped: float = 0.0) -> np.ndarray:
    """τ = −M(q) v exp(−t / T) / T, which takes away all joints' speed with the decay time T.

    Where the speed is an old one, what is still taken away is exactly what the arm then had: nothing is driven
    backwards by a speed that is long gone.

    Args:
        M: mass matrix, (n, n).
        v: joint velocities as they were, (n,) [rad/s].
        decay_time: T [s].
        damped: t, for how long the arm has been damped since it had these velocities [s].
    """
    return -(M @ v) * (np.exp(-damped / decay_time) / decay_time)
