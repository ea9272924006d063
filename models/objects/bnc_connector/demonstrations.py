"""Five demonstrations of inserting and locking a BNC plug, and the scripted demonstrator.

The scripted demonstrator replaces the human hand of the thesis (section 4.4.2). Its motions differ randomly: it
approaches the jack roughly, wanders over the rim with a light push until the plug drops in, is precise where the
connector guides the motion, and varies its speed. It moves the *desired* pose of a station with impedance control. The
file `bnc_connector.npz` holds the commanded and the measured poses. A primitive learns the commanded ones, because the
push is the difference between commanded and measured poses.

`python -m research.generate connector-demonstrations` records them again.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from guiderail.models.common.transforms import DEGREE, MM
from guiderail.models.primitives import Demonstrations

PATH = Path(__file__).with_name("bnc_connector.npz")
NUM_DEMONSTRATIONS = 5
NUM_STEPS = 400
NAMES = ("x [m]", "y [m]", "z [m]", "Rz [rad]", "Ry [rad]", "Rx [rad]")

QUARTER_TURN = np.pi / 2
# Heights of the plug in the locked frame.
CLEAR = 15.5 * MM  # above the jack
RIM = 10.5 * MM  # on the barrel's rim
# A command lies below the surface that stops the plug: under impedance control the difference is the push.
SEARCH_PUSH = 2.5 * MM
SEAT_COMMAND = -6.0 * MM
LOCK_COMMAND = -8.0 * MM

# time [s], z [m], Rz [rad]
WAYPOINTS = np.array(
    [
        [0.0, CLEAR, QUARTER_TURN],
        [0.2, CLEAR, QUARTER_TURN],
        [1.4, RIM - SEARCH_PUSH, QUARTER_TURN],
        [3.6, RIM - SEARCH_PUSH - 0.5 * MM, QUARTER_TURN],
        [4.4, SEAT_COMMAND, QUARTER_TURN],
        [4.7, SEAT_COMMAND, QUARTER_TURN],
        [6.8, LOCK_COMMAND, 0.0],
        [7.1, LOCK_COMMAND, 0.0],
        [7.6, 0.0, 0.0],
        [8.0, 0.0, 0.0],
    ]
)

# Standard deviations of the hand at times of the motion: above the jack, at the rim, searching on it (twice), dropping
# in, seated, turned and locked.
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
_CENTERING = 0.9  # part of the mean of the five random curves that is removed
_TEMPO_DEVIATION, _TEMPO_CORRELATION = 0.05, 1.5  # standard deviation and correlation time of the lead in time [s]


def poses(z: np.ndarray | float, yaw: np.ndarray | float) -> np.ndarray:
    """Return upright poses (N, 6), [x y z Rz Ry Rx], on the center line."""
    z, yaw = np.broadcast_arrays(np.atleast_1d(z), yaw)
    zero = np.zeros_like(z, dtype=float)
    return np.stack([zero, zero, z, yaw, zero, zero], axis=1)


def insert_and_lock() -> tuple[np.ndarray, np.ndarray]:
    """Return times (N,) [s] and desired poses (N, 6) of the whole motion for a jack at a known position."""
    times, z, yaw = WAYPOINTS.T
    return times, poses(z, yaw)


def demonstrator_motions(seed: int, times: np.ndarray) -> np.ndarray:
    """Return the desired poses (M, N, 6) of M demonstrations at `times` (N,) [s], in the locked frame."""
    rng = np.random.default_rng(seed)
    script_times, script = insert_and_lock()
    scripted, curves = [], []
    for _ in range(NUM_DEMONSTRATIONS):
        lead = _TEMPO_DEVIATION * correlated(rng, times, _TEMPO_CORRELATION) * np.sin(np.pi * times / times[-1])
        script_time = np.clip(times + lead, 0.0, script_times[-1])
        scripted.append(np.stack([np.interp(script_time, script_times, column) for column in script.T], axis=1))
        curves.append(np.stack([correlated(rng, times, _CORRELATION[name]) for name in _DEVIATIONS], axis=1))
    wander = np.stack(curves) - _CENTERING * np.mean(curves, axis=0)
    scale = np.stack([np.interp(times, _TIMES, deviation) for deviation in _DEVIATIONS.values()], axis=1)
    return np.stack(scripted) + scale * wander


def load() -> Demonstrations:
    """Load the commanded poses: five demonstrations of 400 poses in the locked frame."""
    return Demonstrations.load(PATH)


def random_curves(rng: np.random.Generator, times: np.ndarray, correlations: Sequence[float], count: int) -> np.ndarray:
    """Return random curves (count, N, O) of unit variance, one correlation time [s] for each of the O outputs."""
    return np.stack([np.stack([correlated(rng, times, one) for one in correlations], axis=1) for _ in range(count)])


def correlated(rng: np.random.Generator, times: np.ndarray, correlation: float) -> np.ndarray:
    """Return a random curve (N,) of unit variance with a Gaussian autocorrelation of `correlation` seconds."""
    covariance = np.exp(-0.5 * ((times[:, None] - times) / correlation) ** 2) + 1e-6 * np.eye(len(times))
    return np.linalg.cholesky(covariance) @ rng.standard_normal(len(times))
