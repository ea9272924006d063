"""Joint velocities for a tool velocity near a singular posture, where the plain inverse of the Jacobian explodes."""

from __future__ import annotations

import numpy as np

# The distance from the tool centre at which a turning tool counts as a moving one [m].
LEVER = 0.25
# A tool velocity counts as lost by degrees, below this many metres a second at the tool for a radian a second in the
# joints. Usual postures have 0.1 and more.
REGULAR = 0.03  # [m]
# A tool that is to move no faster than this is where it should be [m/s].
STILL = 1e-3
_SCALE = np.array([LEVER, LEVER, LEVER, 1.0, 1.0, 1.0])


def damped_joint_velocities(J: np.ndarray, V: np.ndarray, preferred: np.ndarray) -> tuple[np.ndarray, bool]:
    """v = J⁺ V + (1 − J⁺ J) v_preferred, J⁺ a pseudoinverse that is damped in directions that are nearly lost, (n,).

    Each singular value σ below σ₀ = `REGULAR` is inverted as σ / (σ² + λ²) with λ² = σ₀² − σ², which is σ / σ₀²
    (numerical filtering after Maciejewski and Klein 1988): v is continuous, bounded, and for a regular posture what the
    plain pseudoinverse gives.
    Where the tool can't go, the joints follow what is preferred, so that a singular posture is left again.

    Args:
        J: Jacobian (6, n), [rotational, translational], six joints or more.
        V: tool velocity (6,), in the same order [rad/s, m/s].
        preferred: joint velocities (n,) that the tool need not notice [rad/s].

    Returns:
        v (n,), and whether J is regular: nothing was damped, and J v = V.
    """
    U, sigma, WT = np.linalg.svd(_SCALE[:, None] * J, full_matrices=False)
    inverse = sigma / np.maximum(sigma, REGULAR) ** 2
    wanted = WT @ preferred
    v = preferred + WT.T @ (inverse * (U.T @ (_SCALE * V)) - inverse * sigma * wanted)
    return v, bool(sigma[-1] >= REGULAR)


def follows(J: np.ndarray, v: np.ndarray, V: np.ndarray) -> bool:
    """Whether joint velocities v move the tool along V: not elsewhere, and not only a hundredth as fast."""
    moved, wanted = _SCALE * (J @ v), _SCALE * V
    squared = float(wanted @ wanted)
    if squared < STILL**2:
        return True
    along = float(moved @ wanted) / squared
    return along > 0.01 and float(np.linalg.norm(moved - along * wanted)) <= 0.1 * np.sqrt(squared)
