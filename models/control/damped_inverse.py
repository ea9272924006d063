"""Damped inverse kinematics: joint velocities for a tool velocity, bounded near singular postures.

`LEVER` also scales the violations that `MotionConstraints` reports, and the masses of the
impedance law; joint limits use `TOOL_SCALE`.
"""

import numpy as np

LEVER = 0.25  # distance from the tool center that converts rotational to translational quantities [m]
# Smallest singular value that is not damped, tool velocity per joint velocity [m]; 0.1 or more in usual postures.
REGULAR = 0.03
STILL = 1e-3  # desired tool speed below which any motion counts as following [m/s]
TOOL_SCALE = np.array([LEVER, LEVER, LEVER, 1.0, 1.0, 1.0])  # scale of a tool velocity [rotational, translational]


def damped_joint_velocities(J: np.ndarray, V: np.ndarray, preferred: np.ndarray) -> tuple[np.ndarray, bool]:
    """Compute J⁺ V + (1 − J⁺ J) v_preferred (n,) with a pseudoinverse J⁺ that is damped near singular directions.

    Each singular value σ below σ₀ = `REGULAR` is inverted as σ / (σ² + λ²) with λ² = σ₀² − σ², which is σ / σ₀²
    (numerical filtering after Maciejewski and Klein 1988). The result is continuous and bounded. For a regular posture,
    J⁺ is the pseudoinverse. In singular directions, the joints follow the preferred velocities, so that the arm leaves
    a singular posture.

    Args:
        J: Jacobian (6, n), [rotational, translational], of six joints or more.
        V: Tool velocity (6,) in the same order [rad/s, m/s].
        preferred: Preferred joint velocities (n,) [rad/s].

    Returns:
        The joint velocities (n,), and True if J is regular. In this case nothing is damped, and J v = V.
    """
    U, sigma, WT = np.linalg.svd(TOOL_SCALE[:, None] * J, full_matrices=False)
    is_regular = bool(sigma[-1] >= REGULAR)
    inverse = sigma / (sigma if is_regular else np.maximum(sigma, REGULAR)) ** 2
    v = preferred + WT.T @ (inverse * (U.T @ (TOOL_SCALE * V)) - inverse * sigma * (WT @ preferred))
    return v, is_regular


def is_following(J: np.ndarray, v: np.ndarray, V: np.ndarray) -> bool:
    """Return True if joint velocities v (n,) move the tool along V (6,), or if V is slower than `STILL`.

    The tool must move by more than 1 % of V along V, and by at most 10 % of V across it. J (6, n) and V are
    [rotational, translational].
    """
    actual, desired = TOOL_SCALE * (J @ v), TOOL_SCALE * V
    squared = float(desired @ desired)
    if squared < STILL**2:
        return True
    along = float(actual @ desired) / squared
    return along > 0.01 and float(np.linalg.norm(actual - along * desired)) <= 0.1 * np.sqrt(squared)
