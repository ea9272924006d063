"""How a scripted demonstrator puts a plug in: straight for a test, searching for demonstrations.

Poses are of the plug in the target frame, [x y z Rz Ry Rx]. A command lies below what stops the plug: under impedance
control the difference is the push.
"""

from __future__ import annotations

import numpy as np

from guiderail.models.common.poses import POSE_SIZE
from guiderail.models.common.units import DEGREE, MM
from guiderail.models.objects.bnc_connector.demonstrations import correlated

DESCENT_SPEED = 18.0 * MM  # [m/s]
INSERTION_SPEED = 12.0 * MM
TOUCH, TOUCH_SPEED = 0.5 * MM, 4.0 * MM  # [m] above and below the rim, and how fast it passes that [m/s]
TURN_SPEED = 45.0 * DEGREE  # [rad/s]
SEARCH = 1.8  # [s] on the rim
PAUSE = 0.3  # [s] after each part of the motion
NUM_DEMONSTRATIONS = 5

# How much the hand varies, as standard deviations [m, rad], at the waypoints of `searching`: it wanders over the rim,
# and is precise where the parts leave no choice.
_WIDE = np.array([1.2 * MM, 1.2 * MM, 0.7 * MM, 1.0 * DEGREE, 0.8 * DEGREE, 0.8 * DEGREE])
_NARROW = np.array([0.12 * MM, 0.12 * MM, 0.4 * MM, 0.5 * DEGREE, 0.15 * DEGREE, 0.15 * DEGREE])
_CORRELATION = (0.22, 0.22, 0.35, 0.5, 0.3, 0.3)  # [s]
_CENTRING = 0.9  # of the mean of five random curves that is taken out: nobody knows a better path


def straight(travel: float, rim: float, turn: float, push: float) -> tuple[np.ndarray, np.ndarray]:
    """Times (N,) and poses (N, 6): down, slowly past the rim, pushing, a turn where there is one, and to the target.

    Args:
        travel, rim: heights of the start, and of a plug that stands on the rim [m].
        turn: at the bottom [rad].
        push: commanded below the target [m].
    """
    low = rim - TOUCH
    points = [
        (PAUSE, travel, -turn),
        ((travel - rim - TOUCH) / INSERTION_SPEED, rim + TOUCH, -turn),
        (2.0 * TOUCH / TOUCH_SPEED, low, -turn),
        ((low + push) / INSERTION_SPEED, -push, -turn),
        (PAUSE, -push, -turn),
    ]
    if turn:
        points += [(abs(turn) / TURN_SPEED + PAUSE, -push, 0.0)]
    points += [(PAUSE, -push, 0.0), (PAUSE, 0.0, 0.0), (PAUSE, 0.0, 0.0)]
    return _poses([(0.0, travel, -turn), *points])


def searching(travel: float, rim: float, turn: float, push: float, press: float) -> tuple[np.ndarray, np.ndarray]:
    """Times (N,) and poses (N, 6) of a demonstration: to the rim, a search on it, in, a turn where there is one."""
    down = (travel - rim + press) / DESCENT_SPEED + 0.3
    points = [
        (0.0, travel, -turn),
        (0.2, travel, -turn),
        (down, rim - press, -turn),
        (SEARCH, rim - press - 0.5 * MM, -turn),
        ((rim - press + push) / INSERTION_SPEED + 0.3, -push, -turn),
        (PAUSE, -push, -turn),
    ]
    if turn:
        points += [(abs(turn) / TURN_SPEED + PAUSE, -push, 0.0)]
    points += [(PAUSE, -push, 0.0), (0.4, -0.5 * push, 0.0), (PAUSE, -0.5 * push, 0.0)]
    return _poses(points)


def demonstrator_motions(
    seed: int, script: tuple[np.ndarray, np.ndarray], press_from: float, times: np.ndarray
) -> np.ndarray:
    """Five searching motions (5, N, 6) at `times` (N,) [s]: like a hand, never twice the same.

    Args:
        seed: of the hand.
        script: of `searching`.
        press_from: height of the command above which the hand wanders [m].
        times: of the control steps.
    """
    rng = np.random.default_rng(seed)
    at, poses = script
    heights = np.interp(times, at, poses[:, 2])
    # From wide to narrow over the first 3 mm below the search.
    wide = np.clip((heights - press_from) / (3.0 * MM) + 1.0, 0.0, 1.0)[:, None]
    scale = wide * _WIDE + (1.0 - wide) * _NARROW
    curves = np.stack(
        [
            np.stack([correlated(rng, times, length) for length in _CORRELATION], axis=1)
            for _ in range(NUM_DEMONSTRATIONS)
        ]
    )
    wander = curves - _CENTRING * curves.mean(axis=0)
    nominal = np.stack([np.interp(times, at, column) for column in poses.T], axis=1)
    return nominal + scale * wander


def _poses(points: list[tuple[float, float, float]]) -> tuple[np.ndarray, np.ndarray]:
    lasts, heights, turns = np.array(points).T
    poses = np.zeros((len(points), POSE_SIZE))
    poses[:, 2], poses[:, 3] = heights, turns
    return np.cumsum(lasts), poses
