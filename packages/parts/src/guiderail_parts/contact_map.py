"""Contact map of two parts: where a misaligned plug touches the socket, by its position.

It depends on the shapes of both parts, so that the direction from the center of pressure to the socket's axis differs
from part to part. `create-task` measures the map in simulation: it presses the plug on the rim at random positions.
`SocketEstimator` compares the centers of pressure of an episode with the map.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from io import StringIO
from pathlib import Path

import numpy as np

from guiderail.diagrams.envs.recording import drive_along
from guiderail.diagrams.stations.station import Station
from guiderail.diagrams.tasks.options import MIN_CONTACT_FORCE
from guiderail.models.common.errors import InputError, brief
from guiderail.models.common.files import read_bytes, write_atomically
from guiderail.models.common.transforms import DEGREE, MM
from guiderail.models.control.wrench import center_of_pressure
from guiderail.models.primitives.kernels import SquaredExponential
from guiderail_parts.task_file import IN_SOCKET, MotionNumbers

RADIUS = 4.25 * MM  # largest distance of the socket from its nominal position [m]
SPACING = 0.25 * MM  # distance of the positions in the map's table [m]
EXTENT = 7.0 * MM  # largest |x| and |y| of the plug relative to the socket in the map's table [m]
LENGTH_SCALE, NOISE = 0.7 * MM, 0.05  # of the regression [m]; variance of a sample relative to that of the map
NEAR = 0.4 * MM  # distance over which the variance of samples is averaged [m]
WEAK = 0.05  # number of samples that the variance of all centers of pressure counts as
MIN_DEVIATION = 0.2 * MM  # smallest standard deviation of a center of pressure from the map [m]
OUTLIERS = 0.02  # likelihood of a sample that contradicts the map, relative to the largest likelihood
COLUMNS = ("x", "y", "center_x", "center_y", "on_rim")  # of the file [mm], the last is 1 or 0
MAX_FILE_SIZE = 1 << 20  # [bytes]
MAX_SAMPLES = 600  # largest number of samples that a regression uses


@dataclass(frozen=True)
class ContactMap:
    """Samples of a pressed plug, by its position relative to the socket: on the rim or not, and center of pressure.

    Args:
        positions: Positions of the plug relative to the socket, x and y, (N, 2) [m].
        centers: Center of pressure at each position, relative to the tool center, (N, 2) [m]; unused in the socket.
        on_rim: True where the plug is on the rim, False where it has entered the socket, (N,).

    Raises:
        InputError: If the arrays are not finite or not of these shapes, or no plug is on the rim.
    """

    positions: np.ndarray
    centers: np.ndarray
    on_rim: np.ndarray

    def __post_init__(self) -> None:
        shape = self.positions.shape
        if len(shape) != 2 or shape[1] != 2 or self.centers.shape != shape or self.on_rim.shape != shape[:1]:
            raise InputError("a contact map has as many positions (N, 2) as centers of pressure (N, 2) and flags (N,)")
        if not (np.isfinite(self.positions).all() and np.isfinite(self.centers).all()):
            raise InputError("a contact map has values that are not finite")
        if not self.on_rim.any():
            raise InputError("a contact map has samples on the rim")

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
        return cls(MM * rows[:, :2], MM * rows[:, 2:4], rows[:, 4] != 0.0)

    def save(self, path: Path) -> None:
        """Write the samples as a table, in millimeters."""
        text = StringIO()
        rows = np.column_stack([self.positions / MM, self.centers / MM, self.on_rim])
        np.savetxt(text, rows, fmt=["%.4f"] * 4 + ["%d"], delimiter=",", header=",".join(COLUMNS), comments="")
        write_atomically(path, text.getvalue().encode())

    @cached_property
    def _table(self) -> np.ndarray:
        """Mean (2) and variance of the center of pressure, and probability of the rim, on a grid, (M, M, 4) [m, m²]."""
        every = -(-int(self.on_rim.sum()) // MAX_SAMPLES)
        positions, centers = (samples[self.on_rim][::every] for samples in (self.positions, self.centers))
        kernel, mean = SquaredExponential(LENGTH_SCALE), centers.mean(axis=0)
        K = kernel(positions, positions) + NOISE * np.eye(len(positions))
        weights = np.linalg.solve(K, centers - mean)
        errors = ((centers - mean - kernel(positions, positions) @ weights) ** 2).mean(axis=1)
        ticks = SPACING * np.arange(-round(EXTENT / SPACING), round(EXTENT / SPACING) + 1)
        grid = np.stack(np.meshgrid(ticks, ticks, indexing="ij"), axis=-1).reshape(-1, 2)
        predicted = mean + kernel(grid, positions) @ weights
        # Without a sample nearby, the variance is that of all centers of pressure.
        near, whole = SquaredExponential(NEAR)(grid, positions), centers.var(axis=0).mean()
        variance = (near @ errors + WEAK * whole) / (near.sum(axis=1) + WEAK) + MIN_DEVIATION**2
        # The plug stays on the rim where nothing was measured.
        every_near = SquaredExponential(NEAR)(grid, self.positions)
        rim = (every_near @ self.on_rim + WEAK) / (every_near.sum(axis=1) + WEAK)
        return np.column_stack([predicted, variance, rim]).reshape(len(ticks), len(ticks), 4)

    def log_likelihood(self, plug: np.ndarray, center: np.ndarray, positions: np.ndarray) -> np.ndarray:
        """Return the log-likelihood of a sample of a plug on the rim, for each position of the socket.

        A position is unlikely if the center of pressure would be another one, or the plug would enter.

        Args:
            plug: Position of the plug, x and y, (2,) [m].
            center: Its center of pressure, (2,) [m].
            positions: Positions of the socket, (H, 2) [m].

        Returns:
            Log-likelihoods (H,), up to a constant.
        """
        table = self._table
        i, j = np.clip(np.rint((plug - positions + EXTENT) / SPACING).astype(int), 0, len(table) - 1).T
        mean, variance, rim = table[i, j, :2], table[i, j, 2], table[i, j, 3]
        likelihood = rim * np.exp(-0.5 * ((mean - center) ** 2).sum(axis=1) / variance) / variance
        return np.asarray(np.log(likelihood + OUTLIERS / table[:, :, 2].max()))


# Motion that measures a map: the plug touches the rim at random places and slides on it.
TOUCHES = 40
HEIGHT = 1.0 * MM  # height above the first contact between two touches [m]
DESCENT, SLIDE, LIFT, TRAVERSE = 0.3, 0.4, 0.15, 0.2  # durations [s]
MAX_SLIDE = 3.0 * MM  # largest length of a slide [m]
TURN = 2.0 * DEGREE  # largest turn of the plug [rad]


def plan_touches(motion: MotionNumbers, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return times (N,) [s] and poses (N, 6) [m, rad] of `TOUCHES` touches of the rim."""
    rng = np.random.default_rng(seed)
    turn = float(motion.plan_search()[1][0, 3])
    high, low = motion.first_contact + HEIGHT, motion.first_contact - motion.press
    durations, poses = [0.0], [np.array([0.0, 0.0, high, turn, 0.0, 0.0])]

    def draw() -> np.ndarray:
        radius, angle = RADIUS * np.sqrt(rng.uniform()), rng.uniform(0.0, 2.0 * np.pi)
        return radius * np.array([np.cos(angle), np.sin(angle)])

    for _ in range(TOUCHES):
        start, end, yaw = draw(), draw(), turn + rng.uniform(-TURN, TURN)
        end = start + (end - start) * min(1.0, MAX_SLIDE / max(float(np.linalg.norm(end - start)), 1e-9))
        for duration, xy, z in ((TRAVERSE, start, high), (DESCENT, start, low), (SLIDE, end, low), (LIFT, end, high)):
            durations.append(duration)
            poses.append(np.array([*xy, z, yaw, 0.0, 0.0]))
    return np.cumsum(durations), np.array(poses)


def measure_contact_map(station: Station, motion: MotionNumbers) -> ContactMap | None:
    """Return the map of the parts of a station, whose socket is at its nominal position.

    None if the plug never touched the rim. The station becomes part of a diagram.
    """
    _, recording = drive_along(station, *plan_touches(motion))
    wrench, pose = recording["wrench"], recording["pose"]
    on_rim = pose[:, 2] >= motion.first_contact - IN_SOCKET
    used = ~on_rim | (wrench[:, 2] >= MIN_CONTACT_FORCE)
    if not (on_rim & used).any():
        return None
    centers = np.array([center_of_pressure(sample, MIN_CONTACT_FORCE) for sample in wrench[used]])
    return ContactMap(pose[used, :2], centers, on_rim[used])
