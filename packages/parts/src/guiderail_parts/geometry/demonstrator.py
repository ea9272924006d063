"""Scripted demonstrator of an insertion: a straight motion for tests, and a search for demonstrations.

Poses [x y z Rz Ry Rx] are poses of the plug in the target frame [m, rad]. A command lies below the surface that stops
the plug; under impedance control, the distance of the command from the surface determines the push.
"""

from collections.abc import Sequence

import numpy as np

from guiderail.models.common.transforms import DEGREE, MM
from guiderail.models.objects.bnc_connector.demonstrations import poses

DESCENT_SPEED = 18.0 * MM  # [m/s]
INSERTION_SPEED = 12.0 * MM  # [m/s]
# Distance from the first contact within which the plug moves slowly [m], and its speed there [m/s].
TOUCH, TOUCH_SPEED = 0.5 * MM, 4.0 * MM
TURN_SPEED = 45.0 * DEGREE  # [rad/s]
SEARCH = 1.8  # time at the first contact [s]
SEARCH_END = 3  # index of the end of the search in the times of `plan_search`
NARROWING, NARROWING_TIME = 3.0 * MM, 0.25  # distance [m] and time [s] in which deviations become narrow
PAUSE = 0.3  # time after each part of the motion [s]
NUM_DEMONSTRATIONS = 10  # with only five, the variance along the search would vary by a factor of four
SPREAD = 1.7 * MM  # radius of the circle of the demonstrations' sockets around the nominal position [m]
_ANGLES = np.arange(NUM_DEMONSTRATIONS) * 2.0 * np.pi / NUM_DEMONSTRATIONS  # angles of the sockets on the circle [rad]

# Standard deviations of the hand's pose [m, rad]: wide on the rim, narrow where the parts guide the motion.
_WIDE = np.array([1.2 * MM, 1.2 * MM, 0.7 * MM, 1.0 * DEGREE, 0.8 * DEGREE, 0.8 * DEGREE])
_NARROW = np.array([0.12 * MM, 0.12 * MM, 0.4 * MM, 0.5 * DEGREE, 0.15 * DEGREE, 0.15 * DEGREE])
_CORRELATION = (0.22, 0.22, 0.35, 0.5, 0.3, 0.3)  # correlation times of the deviations [s]
_CENTERING = 0.9  # fraction of the mean of the random curves that is subtracted from each of them


def plan_straight_insertion(
    travel: float, first_contact: float, turn: float, push: float, advance: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Return times (N,) [s] and poses (N, 6) [m, rad] of a straight insertion.

    The plug moves down, slowly past the first contact, is pushed, turns, and moves to the target.

    Args:
        travel: Height of the start [m].
        first_contact: Height at which a misaligned plug touches the socket [m].
        turn: Angle of the turn at the bottom [rad].
        push: Distance of the command below the target [m].
        advance: Height lost during the turn [m].
    """
    low = first_contact - TOUCH
    points = [
        (PAUSE, travel, -turn),
        ((travel - first_contact - TOUCH) / INSERTION_SPEED, first_contact + TOUCH, -turn),
        (2.0 * TOUCH / TOUCH_SPEED, low, -turn),
        ((low + push - advance) / INSERTION_SPEED, advance - push, -turn),
        (PAUSE, advance - push, -turn),
    ]
    if turn:
        points += [(abs(turn) / TURN_SPEED + PAUSE, -push, 0.0)]
    points += [(PAUSE, -push, 0.0), (PAUSE, 0.0, 0.0), (PAUSE, 0.0, 0.0)]
    return _timed_poses([(0.0, travel, -turn), *points])


def plan_search(
    travel: float, first_contact: float, turn: float, push: float, press: float, advance: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Return times (N,) [s] and poses (N, 6) [m, rad] of a demonstration without its random deviations.

    The plug moves to the first contact, stays there for the time `SEARCH`, is inserted, and turns.
    `demonstrator_motions` adds the lateral motion of the search.

    Args:
        travel: Height of the start [m].
        first_contact: Height at which a misaligned plug touches the socket [m].
        turn: Angle of the turn at the bottom [rad].
        push: Distance of the command below the target [m].
        press: Distance of the command below the first contact in the search [m].
        advance: Height lost during the turn [m].
    """
    pressed = first_contact - press
    down = (travel - first_contact + press) / DESCENT_SPEED + 0.3
    points = [
        (0.0, travel, -turn),
        (0.2, travel, -turn),
        (down, pressed, -turn),
        (SEARCH, pressed - 0.5 * MM, -turn),
        (abs(pressed + push - advance) / INSERTION_SPEED + 0.3, advance - push, -turn),
        (PAUSE, advance - push, -turn),
    ]
    if turn:
        points += [(abs(turn) / TURN_SPEED + PAUSE, -push, 0.0)]
    points += [(PAUSE, -push, 0.0), (0.4, -0.5 * push, 0.0), (PAUSE, -0.5 * push, 0.0)]
    return _timed_poses(points)


def demonstrator_motions(
    seed: int, script: tuple[np.ndarray, np.ndarray], press_from: float, times: np.ndarray, search_turn: float = 0.0
) -> np.ndarray:
    """Return different searches (D, N, 6) at `times` (N,) [s], from times and poses of `plan_search` and a seed.

    The random deviations are wide while the command is above the height `press_from` [m], and become narrow over the
    distance `NARROWING` below. If the script does not go down so far, they become narrow after the search, within the
    time `NARROWING_TIME`. Each search ends at a different socket position (`socket_offsets`). The variance of the
    demonstrations is then the variance of the socket positions, so that actions can follow a displaced socket down to
    the target. With a `search_turn` [rad] the sockets are also turned (`socket_turns`), and each motion has its
    socket's turn from the start.
    """
    rng = np.random.default_rng(seed)
    script_times, script_poses = script
    heights = np.interp(times, script_times, script_poses[:, 2])
    wide = np.clip((heights - press_from) / NARROWING + 1.0, 0.0, 1.0)[:, None]
    if heights.min() > press_from - NARROWING:
        wide = np.clip(1.0 - (times - script_times[SEARCH_END]) / NARROWING_TIME, 0.0, 1.0)[:, None]
    scale = wide * _WIDE + (1.0 - wide) * _NARROW
    curves = random_curves(rng, times, _CORRELATION, NUM_DEMONSTRATIONS)
    wander = curves - _CENTERING * curves.mean(axis=0)
    wander /= wander.std(axis=0)  # otherwise an action would have little effect where the curves are close by chance
    nominal = np.stack([np.interp(times, script_times, column) for column in script_poses.T], axis=1)
    motions = nominal + scale * wander
    motions[:, :, :2] += (1.0 - wide) * socket_offsets()[:, None, :]
    motions[:, :, 3] += socket_turns(search_turn)[:, None]
    return motions


def socket_offsets() -> np.ndarray:
    """Return the offsets (x, y) of the sockets of the demonstrations, (D, 2) [m]; their mean is zero."""
    return SPREAD * np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=1)


def socket_turns(largest: float) -> np.ndarray:
    """Return the turns (D,) [rad] of the sockets of the demonstrations, from minus `largest` to `largest` [rad].

    Their mean is zero, and they are not correlated with the offsets.
    """
    return largest * np.cos(3.0 * _ANGLES)


def _timed_poses(points: list[tuple[float, float, float]]) -> tuple[np.ndarray, np.ndarray]:
    """Return times (N,) [s] and poses (N, 6) from the duration [s], the height [m] and the turn [rad] of each point."""
    durations, heights, turns = np.array(points).T
    return np.cumsum(durations), poses(heights, turns)


def random_curves(rng: np.random.Generator, times: np.ndarray, correlations: Sequence[float], count: int) -> np.ndarray:
    """Return random curves (count, N, O) of unit variance, one correlation time [s] for each of the O outputs."""
    return np.stack([np.stack([correlated(rng, times, one) for one in correlations], axis=1) for _ in range(count)])


def correlated(rng: np.random.Generator, times: np.ndarray, correlation: float) -> np.ndarray:
    """Return a random curve (N,) of unit variance, with a Gaussian autocorrelation of width `correlation` [s]."""
    covariance = np.exp(-0.5 * ((times[:, None] - times) / correlation) ** 2) + 1e-6 * np.eye(len(times))
    return np.linalg.cholesky(covariance) @ rng.standard_normal(len(times))
