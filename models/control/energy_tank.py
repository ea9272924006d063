"""Energy that a moving reference and changing force limits add to a clipped spring, and a limit of this energy."""

from __future__ import annotations

import numpy as np


def spring_energy(stiffness: np.ndarray, limits: np.ndarray, error: np.ndarray) -> float:
    """Return the energy [J] of springs K e that are clipped at a limit F each, the sum of Huber's functions.

    The energy of a spring is ½ K e² while K |e| ≤ F, and F |e| − F² / (2 K) beyond.

    Args:
        stiffness: K (n,) [N/m, Nm/rad], positive.
        limits: F (n,) [N, Nm], not negative.
        error: e (n,) [m, rad].
    """
    # Plain numbers, as NumPy's overhead would exceed the computation, which runs several times per plant step.
    energy = 0.0
    for K, F, e in zip(stiffness.tolist(), limits.tolist(), error.tolist(), strict=True):
        distance = abs(e)
        clipped = min(distance, F / K)
        energy += K * clipped * (distance - 0.5 * clipped)
    return energy


def admissible_share(
    stiffness: np.ndarray,
    limits: tuple[np.ndarray, np.ndarray],
    errors: tuple[np.ndarray, np.ndarray],
    energy: float,
) -> float:
    """Return the largest share from 0 to 1 of a change of reference and limits that adds at most `energy` [J].

    The energy is convex in the reference, so the share is found by bisection. The share is 1 if the whole change is
    admissible. No limit may decrease: a lower limit is applied at once, which removes energy from the spring.

    Args:
        stiffness: Stiffness (n,).
        limits: Limits (n,) before and after the change.
        errors: Reference minus measured pose (n,) before and after the change.
        energy: Energy that may be added [J].
    """
    before = spring_energy(stiffness, limits[0], errors[0])

    def added(share: float) -> float:
        changed = [first + share * (second - first) for first, second in (limits, errors)]
        return spring_energy(stiffness, changed[0], changed[1]) - before

    if added(1.0) <= energy:
        return 1.0
    low, high = 0.0, 1.0
    for _ in range(40):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if added(middle) <= energy else (low, middle)
    return low
