"""The wrench of the surroundings on a tool, from what a wrist feels and how the tool moves."""

from __future__ import annotations

import numpy as np

from guiderail.models.common.arrays import cross


def center_of_pressure(wrench: np.ndarray, least_force: float) -> np.ndarray:
    """(−τ_y, τ_x) / f_z of a wrench (6,) about a tool centre: from there to where it pushes, (2,) [m].

    Zero where f_z is less than `least_force` [N]: a torque divided by next to nothing says nothing.
    """
    if wrench[2] < least_force:
        return np.zeros(2)
    return np.array([-wrench[4], wrench[3]]) / wrench[2]


def external_wrench(
    F_reaction: np.ndarray, M: np.ndarray, V: np.ndarray, A: np.ndarray, gravity: np.ndarray
) -> np.ndarray:
    """Newton and Euler for a rigid tool: F_external = M A + bias(V) − M [0, g] − F_reaction.

    All spatial vectors are [rotational, translational] (6,), about one point P of the tool and in the axes of one
    frame, which may be any; M is the tool's spatial inertia (6, 6) about P in those axes.

    Args:
        F_reaction: of the wrist on the tool.
        M: mass [kg] and inertia.
        V, A: spatial velocity and acceleration of the tool at P, in an inertial frame.
        gravity: (3,) [m/s²].

    Returns:
        The wrench of the surroundings on the tool, [torque, force] (6,).
    """
    omega = V[:3]
    momentum = M[:, :3] @ omega  # I ω, and m ω × p_PCom by the inertia's own coupling block
    wrench = M @ A - M[:, 3:] @ gravity - F_reaction
    wrench[:3] += cross(omega, momentum[:3])
    wrench[3:] += cross(omega, momentum[3:])
    return wrench
