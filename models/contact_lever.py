"""Where a contact pushes, told from its force and torque."""

from __future__ import annotations

import numpy as np


def contact_lever(wrench: np.ndarray, least_force: float) -> np.ndarray:
    """(−τ_y, τ_x) / f_z of a wrench (6,) about a tool centre: from there to where it pushes, (2,) [m].

    Zero where f_z is less than `least_force` [N]: a torque divided by next to nothing says nothing.
    """
    if wrench[2] < least_force:
        return np.zeros(2)
    return np.array([-wrench[4], wrench[3]]) / wrench[2]
