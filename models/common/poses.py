"""Six numbers for a pose: [x y z Rz Ry Rx], the coordinates in which the thesis records and commands."""

from __future__ import annotations

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

POSE_SIZE = 6
"""Numbers in a pose."""

WRENCH_SIZE = 6
"""Numbers in a wrench: [fx fy fz tx ty tz], N and Nm."""


def pose_to_transform(pose: np.ndarray) -> RigidTransform:
    """X = (Rz(a) Ry(b) Rx(c), [x y z]) of pose = [x y z a b c], metres and radians."""
    return RigidTransform(RollPitchYaw(pose[5], pose[4], pose[3]), pose[:3])


def transform_to_pose(X: RigidTransform) -> np.ndarray:
    """The inverse of `pose_to_transform`, with a and c in (−π, π] and b in [−π/2, π/2]."""
    return np.concatenate([X.translation(), RollPitchYaw(X.rotation()).vector()[::-1]])


def orientation_error(R_desired: RotationMatrix, R: RotationMatrix) -> tuple[float, np.ndarray]:
    """Quaternion (η, ε) of R_desired Rᵀ with η ≥ 0: the shorter way round, and no singularity anywhere."""
    q = (R_desired @ R.inverse()).ToQuaternion()
    sign = 1.0 if q.w() >= 0.0 else -1.0
    return sign * q.w(), sign * q.xyz()


def wrench_of_generalized_force(pose: np.ndarray, force: np.ndarray) -> np.ndarray:
    """The wrench [fx fy fz tx ty tz] at P in T whose work along a pose is that of a force along its coordinates.

    Position coordinates' forces are the force itself. The angles' are the torque about the axes that they turn about,
    ez, Rz(a) ey and Rz(a) Ry(b) ex; these are three as long as b is not ±π/2, near which the answer is large.

    Args:
        pose: X_TP, (6,) [x y z a b c].
        force: (6,), N along and Nm about these.
    """
    a, b = pose[3], pose[4]
    about_z, about_y, about_x = force[3:]
    cos_b = np.cos(b)
    cos_b = np.copysign(max(abs(cos_b), 1e-9), cos_b)
    along = (about_x + np.sin(b) * about_z) / cos_b
    cos_a, sin_a = np.cos(a), np.sin(a)
    torque = [cos_a * along - sin_a * about_y, sin_a * along + cos_a * about_y, about_z]
    return np.concatenate([force[:3], torque])
