"""Contact map of two parts: where a misaligned plug touches the socket, by its position and tilt.

It depends on the shapes of both parts, so that the direction from the center of pressure to the socket's axis differs
from part to part. It also depends on the tilt of the plug, which moves the center of pressure to an edge. `create-task`
measures the map in simulation: it presses the plug on the rim at random positions and tilts. `SocketEstimator` compares
the centers of pressure of an episode with the map.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import cached_property
from io import StringIO
from pathlib import Path

import numpy as np

from guiderail.diagrams.envs.recording import DrivenStation, linear_motion
from guiderail.diagrams.stations.station import CONTROL_PERIOD, Station
from guiderail.diagrams.tasks.options import MIN_CONTACT_FORCE
from guiderail.models.common.errors import InputError, brief
from guiderail.models.common.files import read_bytes, write_atomically
from guiderail.models.common.transforms import DEGREE, MM
from guiderail.models.control.wrench import center_of_pressure
from guiderail.models.primitives.kernels import SquaredExponential
from guiderail_parts.task_file import IN_SOCKET, MotionNumbers

# Length scales of the regression, of positions [m] and tilts [rad], and variance of a sample relative to the map's.
POSITION_SCALE, TILT_SCALE, NOISE = 1.5 * MM, 0.010, 0.05
WEAK = 0.05  # number of samples that the variance of all centers of pressure counts as
MIN_DEVIATION = 0.3 * MM  # smallest standard deviation of a center of pressure from the map [m]
OUTLIERS = 0.02  # likelihood of a sample that contradicts the map, relative to that of its variance
MAX_SAMPLES = 600  # largest number of samples that a regression uses
COLUMNS = ("x", "y", "tilt_y", "tilt_x", "center_x", "center_y")  # of the file [mm], [degrees]
UNITS = np.array([MM, MM, DEGREE, DEGREE, MM, MM])
MAX_FILE_SIZE = 1 << 20  # [bytes]


@dataclass(frozen=True)
class ContactMap:
    """Centers of pressure of a plug on the rim, by its position relative to the socket and its tilt.

    Args:
        positions: Positions of the plug relative to the socket, x and y, (N, 2) [m].
        tilts: Tilts Ry and Rx of the plug, (N, 2) [rad].
        centers: Center of pressure of each sample, relative to the tool center, (N, 2) [m].

    Raises:
        InputError: If the arrays are not finite or not of these shapes.
    """

    positions: np.ndarray
    tilts: np.ndarray
    centers: np.ndarray

    def __post_init__(self) -> None:
        shape = self.positions.shape
        if len(shape) != 2 or not shape[0] or shape[1] != 2 or not shape == self.tilts.shape == self.centers.shape:
            raise InputError("a contact map has as many positions, tilts and centers of pressure, each (N, 2)")
        if not all(np.isfinite(samples).all() for samples in (self.positions, self.tilts, self.centers)):
            raise InputError("a contact map has values that are not finite")

    @classmethod
    def load(cls, path: Path) -> ContactMap:
        """Read a file that `save` wrote.

        Raises:
            InputError: If the file is missing, damaged or not a contact map.
        """
        text = read_bytes(path, "contact map", MAX_FILE_SIZE).decode(errors="replace")
        header, *lines = text.splitlines() or [""]
        if not lines or header != ",".join(COLUMNS):
            raise InputError(f"{path} is not a contact map: its columns are {','.join(COLUMNS)}")
        try:
            rows = np.loadtxt(lines, delimiter=",", ndmin=2)
        except ValueError as error:
            raise InputError(f"{path} is not a contact map ({brief(error)}): create the task again") from error
        if rows.shape[1:] != UNITS.shape:
            raise InputError(f"{path} is not a contact map: its columns are {','.join(COLUMNS)}")
        rows = rows * UNITS
        return cls(rows[:, :2], rows[:, 2:4], rows[:, 4:])

    def save(self, path: Path) -> None:
        """Write the samples as a table, in millimeters and degrees."""
        text = StringIO()
        rows = np.hstack([self.positions, self.tilts, self.centers]) / UNITS
        np.savetxt(text, rows, fmt="%.4f", delimiter=",", header=",".join(COLUMNS), comments="")
        write_atomically(path, text.getvalue().encode())

    @cached_property
    def _regression(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, float]:
        """Positions, tilts and centers of the used samples, their weights (N, 2), and variance of all centers [m²]."""
        every = -(-len(self.positions) // MAX_SAMPLES)
        positions, tilts, centers = (samples[::every] for samples in (self.positions, self.tilts, self.centers))
        by_tilt, by_position = SquaredExponential(TILT_SCALE), SquaredExponential(POSITION_SCALE)
        K = by_position(positions, positions) * by_tilt(tilts, tilts) + NOISE * np.eye(len(positions))
        inverse = np.linalg.inv(K)
        weights = inverse @ (centers - centers.mean(axis=0))
        # Squared error of each sample if it is left out (Rasmussen and Williams, equation 5.12)
        errors = ((weights / np.diag(inverse)[:, None]) ** 2).mean(axis=1)
        terms = np.column_stack([weights, errors, np.ones(len(errors))])
        return positions, tilts, centers, terms, float(centers.var(axis=0).mean())

    def log_likelihood(self, plug: np.ndarray, tilt: np.ndarray, center: np.ndarray, ticks: np.ndarray) -> np.ndarray:
        """Return the log-likelihood of a center of pressure for each position of the socket on a square grid.

        Args:
            plug: Position of the plug, x and y, (2,) [m].
            tilt: Its tilts Ry and Rx, (2,) [rad].
            center: Its center of pressure, (2,) [m].
            ticks: Coordinates of the socket, the same along x and y, (M,) [m].

        Returns:
            Log-likelihoods (M, M), up to a constant.
        """
        positions, tilts, centers, terms, whole = self._regression
        kernel = SquaredExponential(POSITION_SCALE)
        # The kernel is a product over x, y and tilt.
        along_x, along_y = (kernel(plug[axis] - ticks, positions[:, axis]) for axis in (0, 1))
        terms = terms * SquaredExponential(TILT_SCALE)(tilt[None], tilts).T
        sums = np.einsum("in,njk->ijk", along_x, along_y.T[:, :, None] * terms[:, None, :], optimize=True)
        difference = centers.mean(axis=0) + sums[:, :, :2] - center
        # Far from all samples, the variance is that of all centers of pressure.
        variance = (sums[:, :, 2] + WEAK * whole) / (sums[:, :, 3] + WEAK) + MIN_DEVIATION**2
        likelihood = np.exp(-0.5 * (difference**2).sum(axis=2) / variance) / variance
        return np.asarray(np.log(likelihood + OUTLIERS / (whole + MIN_DEVIATION**2)))


# Motion that measures a map: the plug touches the rim at random places and slides on it.
TOUCHES = 60
MAX_SECONDS = 15.0  # CPU time after which no further touches are simulated [s]
RADIUS = 5.0 * MM  # largest distance of the plug from the socket's axis [m]
HEIGHT = 1.0 * MM  # height above the first contact between two touches [m]
TRAVERSE, DESCENT, SLIDE, LIFT = 0.3, 0.2, 0.5, 0.15  # durations [s]
MAX_SLIDE = 3.0 * MM  # largest length of a slide [m]
MIN_PRESS = 0.4  # smallest depth of the command, relative to that of a search
TURN, TILT = 2.0 * DEGREE, 0.7 * DEGREE  # largest turn and standard deviation of the tilts of the command [rad]


def plan_touches(motion: MotionNumbers, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return times (N,) [s] and poses (N, 6) [m, rad] of `TOUCHES` touches of the rim."""
    rng = np.random.default_rng(seed)
    turn = float(motion.plan_search()[1][0, 3])
    high = motion.first_contact + HEIGHT
    durations, poses = [0.0], [np.array([0.0, 0.0, high, turn, 0.0, 0.0])]

    def draw() -> np.ndarray:
        radius, angle = RADIUS * np.sqrt(rng.uniform()), rng.uniform(0.0, 2.0 * np.pi)
        return radius * np.array([np.cos(angle), np.sin(angle)])

    for _ in range(TOUCHES):
        start, end, yaw = draw(), draw(), turn + rng.uniform(-TURN, TURN)
        end = start + (end - start) * min(1.0, MAX_SLIDE / max(float(np.linalg.norm(end - start)), 1e-9))
        first, last = rng.normal(0.0, TILT, (2, 2))
        low = motion.first_contact - rng.uniform(MIN_PRESS, 1.0) * motion.press
        above, below = (start, high, first), (end, low, last)
        steps = ((TRAVERSE, above), (DESCENT, (start, low, first)), (SLIDE, below), (LIFT, (end, high, last)))
        for duration, (xy, z, tilt) in steps:
            durations.append(duration)
            poses.append(np.array([*xy, z, yaw, *tilt]))
    return np.cumsum(durations), np.array(poses)


def measure_contact_map(station: Station, motion: MotionNumbers) -> ContactMap | None:
    """Return the map of the parts of a station, whose socket is at its nominal position.

    None if the plug never touched the rim. The station becomes part of a diagram. After `MAX_SECONDS` of CPU time, the
    measurement ends with the touches so far.
    """
    times, poses = plan_touches(motion)
    touch = (len(times) - 1) // TOUCHES  # poses of a touch
    driven = DrivenStation(station, linear_motion(times, poses), num_samples=round(times[-1] / CONTROL_PERIOD))
    driven.start(poses[0])
    start = time.process_time()
    for number in range(TOUCHES):
        steps = np.diff(np.rint(times[[number * touch, (number + 1) * touch]] / CONTROL_PERIOD))
        recording = driven.run(int(steps[0]))
        if time.process_time() - start > MAX_SECONDS:
            break
    wrench, pose = recording["wrench"], recording["pose"]
    on_rim = (wrench[:, 2] >= MIN_CONTACT_FORCE) & (pose[:, 2] >= motion.first_contact - IN_SOCKET)
    if not on_rim.any():
        return None
    centers = np.array([center_of_pressure(sample, MIN_CONTACT_FORCE) for sample in wrench[on_rim]])
    return ContactMap(pose[on_rim, :2], pose[on_rim, 4:], centers)
