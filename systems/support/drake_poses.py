"""Conversion of poses to and from Drake's rigid transforms; `models.common.poses` has the same without Drake."""

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix


def pose_to_transform(pose: np.ndarray) -> RigidTransform:
    """Return X = (Rz(a) Ry(b) Rx(c), [x y z]) of a pose [x y z a b c] (6,) [m, rad]."""
    return RigidTransform(RollPitchYaw(pose[5], pose[4], pose[3]), pose[:3])


def transform_to_pose(X: RigidTransform) -> np.ndarray:
    """Return the pose (6,) of a transform, with a and c in (−π, π] and b in [−π/2, π/2] [m, rad]."""
    return np.concatenate([X.translation(), RollPitchYaw(X.rotation()).vector()[::-1]])


def orientation_error(R_desired: RotationMatrix, R: RotationMatrix) -> tuple[float, np.ndarray]:
    """Return the quaternion (η, ε) of R_desired Rᵀ with η ≥ 0, the shorter rotation, which has no singularity."""
    q = (R_desired @ R.inverse()).ToQuaternion()
    sign = 1.0 if q.w() >= 0.0 else -1.0
    return sign * q.w(), sign * q.xyz()
