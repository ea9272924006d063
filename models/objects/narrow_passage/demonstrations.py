"""Nine demonstrations through the narrow passage, and how they were made.

They stand in for the hand-drawn ones of the thesis (figures 4.3 and 5.3), which are not published. What they share with
those: from the same start to the same goal in the same time, wide where the plane is free, narrow where the passage is,
each one smooth and its own. They were "drawn" before the obstacle and the restricted zone existed: their mean runs
into the obstacle, and two of them enter the zone.
"""

from pathlib import Path

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.ndimage import gaussian_filter1d

from guiderail.models.primitives import Demonstrations

PATH = Path(__file__).with_name("narrow_passage.npz")
"""The demonstrations as they are used."""

NUM_DEMONSTRATIONS = 9
NUM_STEPS = 400
PERIOD = 0.02
"""Seconds between two points."""

# Along the path, from 0 at the start to 1 at the goal: the mean's x, and the standard deviations of x and y.
_MEAN_X = [(0, 0.30), (0.25, 0.55), (0.42, 0.35), (0.66, 0.35), (0.80, 0.47), (0.95, 0.40), (1, 0.40)]
_DEVIATION_X = [
    (0, 0.012),
    (0.08, 0.05),
    (0.16, 0.11),
    (0.28, 0.11),
    (0.36, 0.03),
    (0.41, 0.005),
    (0.67, 0.005),
    (0.72, 0.03),
    (0.79, 0.09),
    (0.86, 0.08),
    (0.95, 0.012),
    (1, 0.012),
]
_DEVIATION_Y = [
    (0, 0.01),
    (0.20, 0.025),
    (0.30, 0.025),
    (0.42, 0.010),
    (0.62, 0.010),
    (0.78, 0.025),
    (0.95, 0.01),
    (1, 0.01),
]
_Y = (0.05, 0.95)
_ARRIVAL = 0.95  # of the time: then the hand rests on the goal
_CORRELATION = 0.22  # of the time: how long a deviation from the mean lasts
_CENTRING = 0.7  # nine random curves have a mean of their own; this much of it is taken out
_SMOOTHING = 4.0  # steps: no corner where the profiles above have one


def generate(seed: int = 0) -> Demonstrations:
    """Draws nine demonstrations: a mean path plus a smooth random curve each, scaled by how free the plane is there."""
    rng = np.random.default_rng(seed)
    phase = np.linspace(0, 1, NUM_STEPS)
    progress = np.clip(phase / _ARRIVAL, 0, 1)
    progress = 0.5 * progress + 0.5 * (3 * progress**2 - 2 * progress**3)
    covariance = np.exp(-0.5 * ((phase[:, None] - phase) / _CORRELATION) ** 2) + 1e-6 * np.eye(NUM_STEPS)
    noise = rng.standard_normal((NUM_DEMONSTRATIONS, NUM_STEPS, 2))
    curves = np.einsum("ij,mjo->mio", np.linalg.cholesky(covariance), noise)
    curves -= _CENTRING * curves.mean(axis=0)
    x = _profile(_MEAN_X, progress) + _profile(_DEVIATION_X, progress) * curves[..., 0]
    y = _Y[0] + (_Y[1] - _Y[0]) * progress + _profile(_DEVIATION_Y, progress) * curves[..., 1]
    outputs = gaussian_filter1d(np.stack([x, y], axis=-1), _SMOOTHING, axis=1, mode="nearest")
    return Demonstrations(PERIOD * np.arange(NUM_STEPS), list(outputs), names=("x [m]", "y [m]"))


def load() -> Demonstrations:
    """The nine demonstrations, 400 points each, positions in metres."""
    return Demonstrations.load(PATH)


def _profile(knots: list[tuple[float, float]], progress: np.ndarray) -> np.ndarray:
    return PchipInterpolator(*np.array(knots).T)(progress)


if __name__ == "__main__":
    generate().save(PATH)
