"""Impedance that a robot's own controller runs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydrake.math import RigidTransform


@dataclass(frozen=True)
class RobotImpedance:
    """Impedance at the tool center, for a robot with its own impedance controller."""

    X_FlangeTool: RigidTransform  # pose of the tool center on the flange
    stiffness: np.ndarray  # stiffness in the axes of the robot's base, (6, 6) [N/m, Nm/rad], translation first
    damping: np.ndarray  # damping in the same axes and order, (6, 6) [Ns/m, Nms/rad]
    # Largest magnitude of each component of the impedance's wrench in the axes of the base, (6,) [N, Nm].
    max_wrench: np.ndarray
    posture: np.ndarray  # joint positions towards which the null space is controlled, (n,) [rad]
    mass: float  # mass of tool and workpiece [kg]
    center_of_mass: np.ndarray  # center of mass of tool and workpiece in the flange's frame, (3,) [m]
    inertia: np.ndarray  # inertia of tool and workpiece about the center of mass in the flange's axes, (3, 3) [kg m²]
