"""From one pose to another at a crawl."""

import numpy as np

from guiderail.models.common.units import DEGREE, MM

CRAWL, CRAWL_TURN = 0.02, 0.1  # [m/s], [rad/s]
BACK, BACK_TURN = 0.01, 0.5  # [m/s], [rad/s]: slower than this nobody needs to go back along a way that was gone
NEAR, NEAR_TURN = 3.0 * MM, 2.0 * DEGREE  # of where the arm was sent, to be there
SETTLE = 0.5  # [s] at the end


def difference(to: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Of two poses, each angle the shorter way, (6,)."""
    change = to - at
    change[3:] = (change[3:] + np.pi) % (2.0 * np.pi) - np.pi
    return change


def distance(one: np.ndarray, other: np.ndarray) -> tuple[float, float]:
    """Between two poses [m], and between the farthest of their angles [rad]."""
    change = difference(one, other)
    return float(np.linalg.norm(change[:3])), float(np.abs(change[3:]).max())


def crawl(here: np.ndarray, there: np.ndarray, period: float) -> np.ndarray:
    """A pose for each period [s], along a straight line to `there`, (6,), and some on which the arm settles, (n, 6)."""
    away, turned = distance(there, here)
    moving = int(np.ceil(max(away / CRAWL, turned / CRAWL_TURN) / period)) or 1
    steps = np.arange(1, moving + round(SETTLE / period))
    return here + np.minimum(steps / moving, 1.0)[:, None] * difference(there, here)


def is_near(one: np.ndarray, other: np.ndarray) -> bool:
    """Whether the arm is where it was sent."""
    away, turned = distance(one, other)
    return away <= NEAR and turned <= NEAR_TURN


def back(way: np.ndarray, period: float) -> list[np.ndarray]:
    """A pose for each period [s], backwards along a way (n, 6) with a pose for each period, to where it began.

    At the pace at which it was gone, but without the time for which the arm stood still or nearly so.
    """
    poses: list[np.ndarray] = []
    for pose in way[::-1]:
        away, turned = distance(pose, poses[-1]) if poses else (np.inf, np.inf)
        if away >= BACK * period or turned >= BACK_TURN * period:
            poses.append(pose.copy())
    if len(way):
        poses.append(way[0].copy())
    return poses
