"""Nine synthetic demonstrations through the narrow passage.

They replace the hand-drawn demonstrations of the thesis (figures 4.3 and 5.3), which are not published. Like the
originals, they are smooth, have the same duration, vary where the plane is free, and agree in the passage. Their starts
and goals differ by about 1 cm (standard deviation). They ignore the obstacle and the restricted zone: their mean
crosses the obstacle, and two of them enter the zone.
"""

from pathlib import Path

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.ndimage import gaussian_filter1d

from guiderail.models.primitives import Demonstrations

PATH = Path(__file__).with_name("narrow_passage.npz")

NUM_DEMONSTRATIONS = 9
NUM_STEPS = 400
PERIOD = 0.02  # time between points [s]

# Knots (progress, value) of the mean of x, and of the standard deviations of x and y [m]. The progress along the path
# is from 0 to 1.
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
_Y = (0.05, 0.95)  # y of start and goal [m]
_ARRIVAL = 0.95  # fraction of the duration after which the goal is reached
_CORRELATION = 0.22  # correlation time of the deviations, as a fraction of the duration
_CENTERING = 0.7  # fraction of the mean of the nine random curves that is subtracted from each curve
_SMOOTHING = 4.0  # standard deviation of the smoothing [steps]


def generate() -> Demonstrations:
    """Return nine demonstrations: a mean path plus smooth random curves, scaled by the standard deviations."""
    rng = np.random.default_rng(0)
    phase = np.linspace(0, 1, NUM_STEPS)
    progress = np.clip(phase / _ARRIVAL, 0, 1)
    progress = 0.5 * progress + 0.5 * (3 * progress**2 - 2 * progress**3)
    covariance = np.exp(-0.5 * ((phase[:, None] - phase) / _CORRELATION) ** 2) + 1e-6 * np.eye(NUM_STEPS)
    noise = rng.standard_normal((NUM_DEMONSTRATIONS, NUM_STEPS, 2))
    curves = np.einsum("ij,mjo->mio", np.linalg.cholesky(covariance), noise)
    curves -= _CENTERING * curves.mean(axis=0)
    x = _profile(_MEAN_X, progress) + _profile(_DEVIATION_X, progress) * curves[..., 0]
    y = _Y[0] + (_Y[1] - _Y[0]) * progress + _profile(_DEVIATION_Y, progress) * curves[..., 1]
    outputs = gaussian_filter1d(np.stack([x, y], axis=-1), _SMOOTHING, axis=1, mode="nearest")
    return Demonstrations(PERIOD * np.arange(NUM_STEPS), list(outputs), names=("x [m]", "y [m]"))


def load() -> Demonstrations:
    """Load the nine demonstrations of 400 positions [m] each."""
    return Demonstrations.load(PATH)


def _profile(knots: list[tuple[float, float]], progress: np.ndarray) -> np.ndarray:
    return PchipInterpolator(*np.array(knots).T)(progress)
