"""External wrench on a tool from the wrist's reaction and the tool's motion, and its center of pressure."""

import numpy as np

from guiderail.models.common.arrays import cross


def center_of_pressure(wrench: np.ndarray, min_force: float) -> np.ndarray:
    """Compute the center of pressure (−τ_y, τ_x) / f_z relative to the tool center, (2,) [m].

    Args:
        wrench: Wrench about the tool center (6,), force first [N, Nm].
        min_force: Smallest normal force f_z [N]; below it the result is zero, because the quotient is not reliable.
    """
    if wrench[2] < min_force:
        return np.zeros(2)
    return np.array([-wrench[4], wrench[3]]) / wrench[2]


def external_wrench(
    F_reaction: np.ndarray, M: np.ndarray, V: np.ndarray, A: np.ndarray, gravity: np.ndarray
) -> np.ndarray:
    """Compute the external wrench on a rigid tool, F_external = M A + bias(V) − M [0, g] − F_reaction.

    Spatial vectors are [rotational, translational] (6,), about one point P of the tool, and expressed in one frame,
    which may be any.

    Args:
        F_reaction: Wrench of the wrist on the tool (6,).
        M: Spatial inertia of the tool about P (6, 6).
        V: Spatial velocity of the tool at P in an inertial frame (6,).
        A: Spatial acceleration of the tool at P in an inertial frame (6,).
        gravity: Gravity vector (3,) [m/s²].

    Returns:
        The wrench of the surroundings on the tool (6,), [torque, force].
    """
    omega = V[:3]
    momentum = M[:, :3] @ omega  # I ω, and m ω × p_PCom by the inertia's own coupling block
    wrench = M @ A - M[:, 3:] @ gravity - F_reaction
    wrench[:3] += cross(omega, momentum[:3])
    wrench[3:] += cross(omega, momentum[3:])
    return wrench
