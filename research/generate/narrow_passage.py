"""Nine synthetic demonstrations through the narrow passage.

They replace the hand-drawn demonstrations of the thesis (figures 4.3 and 5.3), which are not published. Like the
originals, they are smooth, have the same duration, vary where the plane is free, and agree in the passage. Their starts
and goals differ by about 1 cm (standard deviation). They ignore the obstacle and the restricted zone: their mean
crosses the obstacle, and two of them enter the zone.

After the generator `passage-demonstrations`, run `mixtures` again.
"""

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.ndimage import gaussian_filter1d

from guiderail.models.primitives import Demonstrations

NUM_DEMONSTRATIONS = 9
NUM_STEPS = 400
PERIOD = 0.02  # time between points [s]

# Mean of x, and standard deviations of x and y. Rows: progress along the path from 0 to 1, and value [m].
_MEAN_X = np.array(
    [
        [0.0, 0.25, 0.42, 0.66, 0.80, 0.95, 1.0],
        [0.3, 0.55, 0.35, 0.35, 0.47, 0.40, 0.4],
    ]
)
_DEVIATION_X = np.array(
    [
        [0.000, 0.08, 0.16, 0.28, 0.36, 0.410, 0.670, 0.72, 0.79, 0.86, 0.950, 1.000],
        [0.012, 0.05, 0.11, 0.11, 0.03, 0.005, 0.005, 0.03, 0.09, 0.08, 0.012, 0.012],
    ]
)
_DEVIATION_Y = np.array(
    [
        [0.00, 0.200, 0.300, 0.42, 0.62, 0.780, 0.95, 1.00],
        [0.01, 0.025, 0.025, 0.01, 0.01, 0.025, 0.01, 0.01],
    ]
)
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


def _profile(knots: np.ndarray, progress: np.ndarray) -> np.ndarray:
    return PchipInterpolator(*knots)(progress)
