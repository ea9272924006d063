"""Demonstrations of inserting and locking a BNC plug, five in each of three sets, and the scripted demonstrator.

The scripted demonstrator replaces the human hand of the thesis (section 4.4.2). It moves the *desired* pose of a
station with impedance control. The files contain the commanded and the measured poses. A primitive is fitted to the
commanded poses, because the push is the difference between commanded and measured poses.

- Insertion, for a jack at a known position: the motions differ randomly. The demonstrator approaches the jack
  imprecisely, wanders over the rim with a light push until the plug drops in, is precise where the connector guides the
  motion, and varies its speed.
- Search, for a jack at an uncertain position: the demonstrator circles around the expected position with a light push,
  and then inserts the plug. The five circles begin a fifth of a turn apart. During the search the five positions are
  always evenly spaced on a circle. Until the plug drops in, their mean is the center of the circle, and their
  covariance is the same in every direction. An action of a policy therefore has the same effect in every direction
  during the whole search.
- Firm search, recorded on an arm: the push is four times as large. The torque from the rim shows on which side of the
  rim the plug stands. With the firm push this torque is as large as the errors of an arm's joint torques. With the
  light push it is a quarter of these errors.

`python -m research.generate` with `connector-demonstrations`, `connector-search-demonstrations` or
`connector-firm-search-demonstrations` records them again.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from guiderail.models.common.transforms import DEGREE, MM

# Files of the sets: five demonstrations of 400 poses in the locked frame each.
PATH, SEARCH_PATH, FIRM_SEARCH_PATH = (
    Path(__file__).with_name(f"{name}.npz") for name in ("bnc_connector", "bnc_search", "bnc_firm_search")
)
NUM_DEMONSTRATIONS = 5
NUM_STEPS = 400

QUARTER_TURN = np.pi / 2
# Heights of the plug in the locked frame [m].
CLEAR = 15.5 * MM  # above the jack
RIM = 10.5 * MM  # on the barrel's rim
# A command lies below the surface that stops the plug: under impedance control, the distance between command and
# surface determines the push.
SEARCH_PUSH = 2.5 * MM
SEAT_COMMAND = -6.0 * MM
LOCK_COMMAND = -8.0 * MM

# Waypoints of the plug: time [s], z [m], Rz [rad].
_ABOVE = [[0.0, CLEAR, QUARTER_TURN], [0.2, CLEAR, QUARTER_TURN]]
_LOCKING = [[6.8, LOCK_COMMAND, 0.0], [7.1, LOCK_COMMAND, 0.0], [7.6, 0.0, 0.0], [8.0, 0.0, 0.0]]
WAYPOINTS = np.array(
    [
        *_ABOVE,
        [1.4, RIM - SEARCH_PUSH, QUARTER_TURN],
        [3.6, RIM - SEARCH_PUSH - 0.5 * MM, QUARTER_TURN],
        [4.4, SEAT_COMMAND, QUARTER_TURN],
        [4.7, SEAT_COMMAND, QUARTER_TURN],
        *_LOCKING,
    ]
)

# Standard deviations of the hand's pose at eight times of the motion: above the jack, at the rim, at begin and end of
# the search on the rim, dropping in, seated, turned and locked.
_TIMES = [0.0, 1.2, 1.6, 3.4, 4.1, 4.8, 7.0, 8.0]  # [s]
_DEVIATIONS = {
    "x": np.array([1.0, 1.2, 1.2, 1.2, 0.35, 0.15, 0.15, 0.10]) * MM,
    "y": np.array([1.0, 1.2, 1.2, 1.2, 0.35, 0.15, 0.15, 0.10]) * MM,
    "z": np.array([1.0, 0.9, 0.5, 0.5, 0.7, 0.5, 0.5, 0.3]) * MM,
    "Rz": np.array([2.0, 1.5, 1.0, 1.0, 1.0, 1.5, 1.5, 0.7]) * DEGREE,
    "Ry": np.array([1.2, 1.2, 1.2, 1.2, 0.5, 0.2, 0.2, 0.15]) * DEGREE,
    "Rx": np.array([1.2, 1.2, 1.2, 1.2, 0.5, 0.2, 0.2, 0.15]) * DEGREE,
}
_CORRELATION = {"x": 0.22, "y": 0.22, "z": 0.35, "Rz": 0.5, "Ry": 0.3, "Rx": 0.3}  # correlation times [s]
_CENTERING = 0.9  # fraction of the mean of the five random curves that is subtracted from each curve
_TEMPO_DEVIATION, _TEMPO_CORRELATION = 0.05, 1.5  # standard deviation and correlation time of the time shift [s]


def poses(z: np.ndarray | float, yaw: np.ndarray | float) -> np.ndarray:
    """Return upright poses (N, 6), [x y z Rz Ry Rx], on the center line, for heights [m] and yaw angles [rad], (N,)."""
    z, yaw = np.broadcast_arrays(np.atleast_1d(z), yaw)
    zero = np.zeros_like(z, dtype=float)
    return np.stack([zero, zero, z, yaw, zero, zero], axis=1)


def insert_and_lock() -> tuple[np.ndarray, np.ndarray]:
    """Return times (N,) [s] and desired poses (N, 6) of the N waypoints of an insertion at a known position."""
    times, z, yaw = WAYPOINTS.T
    return times, poses(z, yaw)


def demonstrator_motions(seed: int, times: np.ndarray) -> np.ndarray:
    """Return the desired poses (M, N, 6) of the M demonstrated insertions at `times` (N,) [s], in the locked frame."""
    rng = np.random.default_rng(seed)
    script_times, script = insert_and_lock()
    scripted, curves = [], []
    for _ in range(NUM_DEMONSTRATIONS):
        time_shift = _TEMPO_DEVIATION * correlated(rng, times, _TEMPO_CORRELATION) * np.sin(np.pi * times / times[-1])
        script_time = np.clip(times + time_shift, 0.0, script_times[-1])
        scripted.append(np.stack([np.interp(script_time, script_times, column) for column in script.T], axis=1))
        curves.append(np.stack([correlated(rng, times, _CORRELATION[name]) for name in _DEVIATIONS], axis=1))
    wander = np.stack(curves) - _CENTERING * np.mean(curves, axis=0)
    return np.stack(scripted) + _interpolate(times, _TIMES, _DEVIATIONS) * wander


def _interpolate(times: np.ndarray, at: list[float], deviations: dict[str, np.ndarray]) -> np.ndarray:
    """Interpolate the standard deviations of each coordinate, given at the times `at` [s]; return (N, 6)."""
    return np.stack([np.interp(times, at, deviation) for deviation in deviations.values()], axis=1)


def random_curves(rng: np.random.Generator, times: np.ndarray, correlations: Sequence[float], count: int) -> np.ndarray:
    """Return random curves (count, N, O) of unit variance, one correlation time [s] for each of the O outputs."""
    return np.stack([np.stack([correlated(rng, times, one) for one in correlations], axis=1) for _ in range(count)])


def correlated(rng: np.random.Generator, times: np.ndarray, correlation: float) -> np.ndarray:
    """Return a random curve (N,) of unit variance, with a Gaussian autocorrelation of width `correlation` [s]."""
    covariance = np.exp(-0.5 * ((times[:, None] - times) / correlation) ** 2) + 1e-6 * np.eye(len(times))
    return np.linalg.cholesky(covariance) @ rng.standard_normal(len(times))


RADIUS = 2.5 * MM  # radius of the circle
TURN = 0.3  # duration of one circle [s], much shorter than the search
LIGHT_PUSH = 1.5 * MM  # distance of the command below the rim, which causes a force of about two newtons
FIRM_PUSH = 6.0 * MM  # distance of the command below the rim, which causes a force of about nine newtons
SEARCH = (1.2, 3.0)  # begin and end of the search [s]
HOLD_UNTIL, IN_BY = 3.6, 4.1  # times when the circle begins to shrink and when it has vanished [s]

# Waypoints of the plug: time [s], z [m], Rz [rad].
SEARCH_WAYPOINTS = np.array(
    [
        *_ABOVE,
        [SEARCH[0], RIM - LIGHT_PUSH, QUARTER_TURN],
        [SEARCH[1], RIM - LIGHT_PUSH - 0.3 * MM, QUARTER_TURN],
        [SEARCH[1] + 0.8, SEAT_COMMAND, QUARTER_TURN],
        [4.6, SEAT_COMMAND, QUARTER_TURN],
        *_LOCKING,
    ]
)
# Standard deviations of the hand's pose in addition to the circle, at five times of the motion: at the start, when the
# circle begins to shrink, inserted, turned and locked.
_SEARCH_TIMES = [0.0, HOLD_UNTIL, IN_BY, 7.0, 8.0]  # [s]
_SEARCH_DEVIATIONS = {
    "x": np.array([0.05, 0.05, 0.15, 0.15, 0.10]) * MM,
    "y": np.array([0.05, 0.05, 0.15, 0.15, 0.10]) * MM,
    "z": np.array([0.9, 0.5, 0.5, 0.5, 0.3]) * MM,
    "Rz": np.array([1.5, 1.0, 1.0, 1.5, 0.7]) * DEGREE,
    "Ry": np.array([0.3, 0.3, 0.3, 0.2, 0.15]) * DEGREE,
    "Rx": np.array([0.3, 0.3, 0.3, 0.2, 0.15]) * DEGREE,
}
_SEARCH_CORRELATION = 0.3  # correlation time [s]


def search_motions(seed: int, times: np.ndarray, push: float = LIGHT_PUSH) -> np.ndarray:
    """Return the desired poses (M, N, 6) of the M demonstrated searches at `times` (N,) [s], in the locked frame.

    `push` is the distance of the command below the rim at the beginning of the search [m].
    """
    rng = np.random.default_rng(seed)
    script_times, z, yaw = SEARCH_WAYPOINTS.T
    searches = (script_times >= SEARCH[0]) & (script_times <= SEARCH[1])
    z = np.where(searches, z + LIGHT_PUSH - push, z)
    remaining = np.clip((IN_BY - times) / (IN_BY - HOLD_UNTIL), 0.0, 1.0)
    radius = RADIUS * remaining**2 * (3.0 - 2.0 * remaining)
    wander = random_curves(rng, times, [_SEARCH_CORRELATION] * len(_SEARCH_DEVIATIONS), NUM_DEMONSTRATIONS)
    motions = _interpolate(times, _SEARCH_TIMES, _SEARCH_DEVIATIONS) * (wander - wander.mean(axis=0))
    motions[..., 2] += np.interp(times, script_times, z)
    motions[..., 3] += np.interp(times, script_times, yaw)
    for number, motion in enumerate(motions):
        angle = 2.0 * np.pi * (times / TURN + number / NUM_DEMONSTRATIONS)
        motion[:, 0] += radius * np.cos(angle)
        motion[:, 1] += radius * np.sin(angle)
    return motions
