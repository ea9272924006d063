"""Slow motions of the arm between pre-flight check, skill and episodes."""

import numpy as np

from guiderail.models.common.transforms import DEGREE, MM, pose_difference

SPEED, ANGULAR_SPEED = 0.02, 0.1  # of a slow approach [m/s], [rad/s]
MIN_SPEED, MIN_ANGULAR_SPEED = 0.01, 0.5  # minimum on the return path; slower segments are skipped [m/s], [rad/s]
POSITION_TOLERANCE, ANGLE_TOLERANCE = 3.0 * MM, 2.0 * DEGREE  # of a reached pose
SETTLING_TIME = 0.5  # at the end of an approach [s]


def pose_distance(a: np.ndarray, b: np.ndarray) -> tuple[float, float]:
    """Return the distance of two poses (6,) [m], and the largest difference of an angle [rad]."""
    change = pose_difference(a, b)
    return float(np.linalg.norm(change[:3])), float(np.abs(change[3:]).max())


def is_near(a: np.ndarray, b: np.ndarray) -> bool:
    """Return True if two poses (6,) are equal within the tolerances of a reached pose."""
    distance, angle = pose_distance(a, b)
    return distance <= POSITION_TOLERANCE and angle <= ANGLE_TOLERANCE


def slow_approach(pose: np.ndarray, target: np.ndarray, period: float) -> np.ndarray:
    """Return commands (n, 6) from `pose` to `target`, (6,), along a straight line at `SPEED`, then some to settle.

    The time between commands is `period` [s].
    """
    distance, angle = pose_distance(target, pose)
    moving = int(np.ceil(max(distance / SPEED, angle / ANGULAR_SPEED) / period)) or 1
    steps = np.arange(1, moving + round(SETTLING_TIME / period))
    return pose + np.minimum(steps / moving, 1.0)[:, None] * pose_difference(target, pose)


def retrace(path: np.ndarray, period: float) -> list[np.ndarray]:
    """Return commands backwards along poses (n, 6), at their own speed but without the segments nearly at rest.

    The time between poses is `period` [s].
    """
    poses: list[np.ndarray] = []
    for pose in path[::-1]:
        distance, angle = pose_distance(pose, poses[-1]) if poses else (np.inf, np.inf)
        if distance >= MIN_SPEED * period or angle >= MIN_ANGULAR_SPEED * period:
            poses.append(pose.copy())
    if len(path):
        poses.append(path[0].copy())
    return poses
