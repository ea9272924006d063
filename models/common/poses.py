"""Poses as six coordinates [x y z Rz Ry Rx], in which the thesis records and commands."""

import math

import numpy as np

from guiderail.models.common.transforms import RigidTransform, rpy_angles, rpy_rotation

POSE_SIZE = 6
"""Number of coordinates of a pose."""

WRENCH_SIZE = 6
"""Number of components of a wrench [fx fy fz tx ty tz], in N and Nm."""


def pose_to_transform(pose: np.ndarray) -> RigidTransform:
    """Return X = (Rz(a) Ry(b) Rx(c), [x y z]) of a pose [x y z a b c] (6,) [m, rad]."""
    return RigidTransform(rpy_rotation(float(pose[5]), float(pose[4]), float(pose[3])), pose[:3])


def transform_to_pose(X: RigidTransform) -> np.ndarray:
    """Return the pose (6,) of a transform, Drake's included, with a and c in (−π, π] and b in [−π/2, π/2] [m, rad]."""
    return np.concatenate([X.translation(), rpy_angles(X.rotation())[::-1]])


def pose_difference(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return `first` minus `second`, two poses (6,), each angle in [−π, π)."""
    # Angles in plain Python: NumPy is slower for three numbers, and this runs at every step of a plant.
    difference = (first - second).tolist()
    return np.array(difference[:3] + [(angle + math.pi) % (2.0 * math.pi) - math.pi for angle in difference[3:]])


def wrench_of_generalized_force(pose: np.ndarray, force: np.ndarray) -> np.ndarray:
    """Convert a generalized force along the coordinates of a pose to the wrench (6,) at P in T that does the same work.

    The components of the angles are torques about the axes ez, Rz(a) ey and Rz(a) Ry(b) ex. These are linearly
    dependent for b = ±π/2, near which the result is large.

    Args:
        pose: X_TP as [x y z a b c] (6,) [m, rad].
        force: Generalized force (6,) [N, Nm].
    """
    a, b = pose[3], pose[4]
    about_z, about_y, about_x = force[3:]
    cos_b = np.cos(b)
    cos_b = np.copysign(max(abs(cos_b), 1e-9), cos_b)
    along = (about_x + np.sin(b) * about_z) / cos_b
    cos_a, sin_a = np.cos(a), np.sin(a)
    torque = [cos_a * along - sin_a * about_y, sin_a * along + cos_a * about_y, about_z]
    return np.concatenate([force[:3], torque])
