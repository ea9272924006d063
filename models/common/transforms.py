"""Rigid transforms in NumPy with the interface of Drake's classes of the same names, and poses as six coordinates.

Templates use these transforms in order to run without Drake, and accept Drake's objects as well. Rotations are computed
by Drake's formulas in the same order of operations, and agree with Drake's rotations to the last bit.

A pose is [x y z Rz Ry Rx], the coordinates of recorded and commanded poses in the thesis.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike


class RotationMatrix:
    """Rotation R_AB.

    Args:
        R: Orthonormal matrix (3, 3), not checked; the identity by default.
    """

    __slots__ = ("_R",)

    def __init__(self, R: ArrayLike | None = None):
        # Column-major like Drake's matrices: the memory order determines how products with vectors are rounded.
        self._R = np.eye(3) if R is None else np.asfortranarray(R, dtype=float)

    @staticmethod
    def MakeXRotation(theta: float) -> RotationMatrix:
        """Return the rotation by `theta` [rad] about x."""
        return rpy_rotation(theta, 0.0, 0.0)

    @staticmethod
    def MakeYRotation(theta: float) -> RotationMatrix:
        """Return the rotation by `theta` [rad] about y."""
        return rpy_rotation(0.0, theta, 0.0)

    @staticmethod
    def MakeZRotation(theta: float) -> RotationMatrix:
        """Return the rotation by `theta` [rad] about z."""
        return rpy_rotation(0.0, 0.0, theta)

    def matrix(self) -> np.ndarray:
        """Return the matrix (3, 3), which the caller must not change."""
        return self._R

    def col(self, index: int) -> np.ndarray:
        """Return the axis of B with this index, (3,), expressed in A."""
        return self._R[:, index]

    def multiply(self, other: RotationMatrix) -> RotationMatrix:
        """Return R_AB R_BC."""
        return RotationMatrix(self._R @ other.matrix())

    def inverse(self) -> RotationMatrix:
        """Return R_BA."""
        return RotationMatrix(self._R.T)

    def __matmul__(self, other: Any) -> Any:
        """Return R_AB R_BC for a rotation R_BC, or vectors (3,) or (3, n) in B expressed in A."""
        return self.multiply(other) if hasattr(other, "matrix") else self._R @ np.asarray(other, dtype=float)


class RigidTransform:
    """Pose X_AB.

    Args:
        R: Rotation R_AB, an object or a matrix (3, 3); the identity by default. If `p` is not given, `R` can also be a
            transform, which is copied, or a translation (3,) [m].
        p: Translation p_AB (3,) [m]; zero by default.
    """

    __slots__ = ("_p", "_rotation")

    def __init__(self, R: Any = None, p: ArrayLike | None = None):
        if p is None and hasattr(R, "translation"):
            R, p = R.rotation(), R.translation()
        elif p is None and np.shape(R) == (3,):
            R, p = None, R
        if not isinstance(R, RotationMatrix):
            R = RotationMatrix(R.matrix() if hasattr(R, "matrix") else R)
        self._rotation: RotationMatrix = R
        self._p = np.zeros(3) if p is None else np.array(p, dtype=float)

    def rotation(self) -> RotationMatrix:
        """Return R_AB."""
        return self._rotation

    def translation(self) -> np.ndarray:
        """Return p_AB (3,) [m], which the caller must not change."""
        return self._p

    def inverse(self) -> RigidTransform:
        """Return X_BA."""
        R = self._rotation.inverse()
        return RigidTransform(R, -(R.matrix() @ self._p))

    def multiply(self, other: RigidTransform) -> RigidTransform:
        """Return X_AB X_BC."""
        R = self._rotation
        return RigidTransform(R.multiply(other.rotation()), self._p + R.matrix() @ other.translation())

    def __matmul__(self, other: Any) -> Any:
        """Return X_AB X_BC for a transform X_BC, or points (3,) or (3, n) [m] in B transformed to A."""
        if hasattr(other, "translation"):
            return self.multiply(other)
        points = self._rotation.matrix() @ np.asarray(other, dtype=float)
        return points + (self._p if points.ndim == 1 else self._p[:, None])

    def GetAsMatrix34(self) -> np.ndarray:
        """Return [R_AB p_AB] (3, 4)."""
        return np.column_stack([self._rotation.matrix(), self._p])

    def GetAsMatrix4(self) -> np.ndarray:
        """Return the homogeneous matrix (4, 4)."""
        return np.vstack([self.GetAsMatrix34(), [0.0, 0.0, 0.0, 1.0]])


def rpy_rotation(roll: float, pitch: float, yaw: float) -> RotationMatrix:
    """Return Rz(yaw) Ry(pitch) Rx(roll) of angles [rad]."""
    (s0, c0), (s1, c1), (s2, c2) = _sin_cos(roll), _sin_cos(pitch), _sin_cos(yaw)
    c2s1, s2s1 = c2 * s1, s2 * s1
    return RotationMatrix(
        [
            [c2 * c1, c2s1 * s0 - s2 * c0, c2s1 * c0 + s2 * s0],
            [s2 * c1, s2s1 * s0 + c2 * c0, s2s1 * c0 - c2 * s0],
            [-s1, c1 * s0, c1 * c0],
        ]
    )


def _sin_cos(angle: float) -> tuple[float, float]:
    """Return sine and cosine of an angle [rad]; NaN for an infinite angle, which `math.sin` would refuse."""
    return (math.sin(angle), math.cos(angle)) if math.isfinite(angle) else (math.nan, math.nan)


def quaternion(R: RotationMatrix) -> tuple[float, float, float, float]:
    """Return the unit quaternion (w, x, y, z) of a rotation, with w ≥ 0."""
    (a, b, c), (d, e, f), (g, h, i) = R.matrix().tolist()
    trace = a + (e + i)
    if trace >= a and trace >= e and trace >= i:
        w, x, y, z = 1 + trace, h - f, c - g, d - b
    elif a >= e and a >= i:
        w, x, y, z = h - f, 1 - (trace - 2 * a), b + d, c + g
    elif e >= i:
        w, x, y, z = c - g, b + d, 1 - (trace - 2 * e), f + h
    else:
        w, x, y, z = d - b, c + g, f + h, 1 - (trace - 2 * i)
    scale = (-1.0 if w < 0 else 1.0) / math.sqrt((x * x + z * z) + (y * y + w * w))
    return w * scale, x * scale, y * scale, z * scale


_EPSILON = float(np.finfo(float).eps)


def rpy_angles(R: RotationMatrix) -> np.ndarray:
    """Return roll, pitch and yaw (3,) [rad] of a rotation, in [−π, π], [−π/2, π/2] and [−π, π]."""
    M = R.matrix()
    M00, M10, M20, M21, M22 = float(M[0, 0]), float(M[1, 0]), float(M[2, 0]), float(M[2, 1]), float(M[2, 2])
    w, x, y, z = quaternion(R)
    cos_pitch = math.sqrt((M22 * M22 + M21 * M21 + M10 * M10 + M00 * M00) / 2)
    half_sum, half_difference = (
        0.0 if abs(sine) <= _EPSILON and abs(cosine) <= _EPSILON else math.atan2(sine, cosine)
        for sine, cosine in ((x + z, w - y), (z - x, w + y))
    )
    roll, yaw = (_within_half_turn(a) for a in (half_sum - half_difference, half_sum + half_difference))
    return np.array([roll, math.atan2(-M20, cos_pitch), yaw])


def _within_half_turn(angle: float) -> float:
    if angle > math.pi:
        return angle - 2 * math.pi
    return angle + 2 * math.pi if angle < -math.pi else angle


def axis_angle_rotation(axis: ArrayLike, angle: float) -> RotationMatrix:
    """Return the rotation by `angle` [rad] about a vector (3,), which is normalized."""
    x, y, z = np.asarray(axis, dtype=float).tolist()
    norm = math.sqrt((x * x + y * y) + z * z)
    x, y, z = x / norm, y / norm, z / norm
    sine, cosine = _sin_cos(angle)
    sx, sy, sz = sine * x, sine * y, sine * z
    versine = 1 - cosine
    vx, vy, vz = versine * x, versine * y, versine * z
    xy, xz, yz = vx * y, vx * z, vy * z
    return RotationMatrix(
        [[vx * x + cosine, xy - sz, xz + sy], [xy + sz, vy * y + cosine, yz - sx], [xz - sy, yz + sx, vz * z + cosine]]
    )


def axis_angle(R: RotationMatrix) -> tuple[np.ndarray, float]:
    """Return the unit axis (3,) and the angle [rad] in [0, π] of a rotation; the axis is x if the angle is zero."""
    M = R.matrix()
    trace = float(M[0, 0]) + (float(M[1, 1]) + float(M[2, 2]))
    vector = np.empty(3)
    if trace > 0:
        root = math.sqrt(trace + 1)
        w, scale = 0.5 * root, 0.5 / root
        vector[:] = (M[2, 1] - M[1, 2]) * scale, (M[0, 2] - M[2, 0]) * scale, (M[1, 0] - M[0, 1]) * scale
    else:
        i = 1 if M[1, 1] > M[0, 0] else 0
        i = 2 if M[2, 2] > M[i, i] else i
        j, k = (i + 1) % 3, (i + 2) % 3
        root = math.sqrt(M[i, i] - M[j, j] - M[k, k] + 1)
        vector[i], scale = 0.5 * root, 0.5 / root
        w = float((M[k, j] - M[j, k]) * scale)
        vector[j], vector[k] = (M[j, i] + M[i, j]) * scale, (M[k, i] + M[i, k]) * scale
    x, y, z = vector.tolist()
    norm = math.sqrt((x * x + y * y) + z * z)
    if norm < _EPSILON:
        norm = math.hypot(x, y, z)  # squares underflow
    if norm == 0:
        return np.array([1.0, 0.0, 0.0]), 0.0
    return vector / (-norm if w < 0 else norm), 2 * math.atan2(norm, abs(w))


POSE_NAMES = ("x [m]", "y [m]", "z [m]", "Rz [rad]", "Ry [rad]", "Rx [rad]")
WRENCH_NAMES = ("Fx [N]", "Fy [N]", "Fz [N]", "Mx [Nm]", "My [Nm]", "Mz [Nm]")
POSE_SIZE = 6
"""Number of coordinates of a pose."""

WRENCH_SIZE = 6
"""Number of components of a wrench [fx fy fz tx ty tz], in N and Nm."""


def pose_to_transform(pose: np.ndarray) -> RigidTransform:
    """Return X = (Rz(a) Ry(b) Rx(c), [x y z]) of a pose [x y z a b c] (6,) [m, rad]."""
    return RigidTransform(rpy_rotation(float(pose[5]), float(pose[4]), float(pose[3])), pose[:3])


def transform_to_pose(X: RigidTransform) -> np.ndarray:
    """Return the pose (6,) [m, rad] of a transform or a Drake transform, Rz and Rx in [−π, π], Ry in [−π/2, π/2]."""
    return np.concatenate([X.translation(), rpy_angles(X.rotation())[::-1]])


def pose_difference(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return `first` minus `second`, two poses (6,), each angle in [−π, π)."""
    # Plain Python, because NumPy is slower for three numbers and this function runs at every step of a plant.
    x, y, z, a, b, c = (first - second).tolist()
    return np.array([x, y, z, _wrapped(a), _wrapped(b), _wrapped(c)])


def _wrapped(angle: float) -> float:
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


def nearest_pose(pose: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Return the numbers of a pose (6,) that are nearest to `near`, (6,), among those of the same orientation.

    An orientation has the angles (a, b, c) and (a + π, π − b, c + π), and each of them plus full turns.
    """
    angles, last = pose[3:], near[3:]
    angles = angles - 2 * math.pi * np.round((angles - last) / (2 * math.pi))
    other = np.array([angles[0] + math.pi, math.pi - angles[1], angles[2] + math.pi])
    other -= 2 * math.pi * np.round((other - last) / (2 * math.pi))
    if (other - last) @ (other - last) < (angles - last) @ (angles - last):
        angles = other
    return np.concatenate([pose[:3], angles])


def angle_between(first: np.ndarray, second: np.ndarray) -> float:
    """Return the angle of the rotation between the orientations of two finite poses (6,), in [0, π] [rad]."""
    R_first, R_second = pose_to_transform(first).rotation(), pose_to_transform(second).rotation()
    return axis_angle(R_first.inverse() @ R_second)[1]


def wrench_of_generalized_force(pose: np.ndarray, force: np.ndarray) -> np.ndarray:
    """Convert a generalized force (6,) along a pose's coordinates to the wrench (6,) at P in T that does the same work.

    The pose [x y z a b c] (6,) [m, rad] is X_TP. The last three components of the force are torques about the axes ez,
    Rz(a) ey and Rz(a) Ry(b) ex. For b = ±π/2 these axes are linearly dependent; near these angles the result is large.
    """
    x, y, z, about_z, about_y, about_x = force.tolist()
    (cos_a, cos_b), (sin_a, sin_b) = np.cos(pose[3:5]).tolist(), np.sin(pose[3:5]).tolist()
    cos_b = math.copysign(max(abs(cos_b), 1e-9), cos_b)
    about_heading = (about_x + sin_b * about_z) / cos_b  # torque about Rz(a) ex
    torque_x, torque_y = cos_a * about_heading - sin_a * about_y, sin_a * about_heading + cos_a * about_y
    return np.array([x, y, z, torque_x, torque_y, about_z])


MM = 1e-3  # one millimeter [m]
DEGREE = math.radians(1.0)  # one degree [rad]
