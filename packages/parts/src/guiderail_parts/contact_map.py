"""Contact map of two parts: where a misaligned plug touches the socket, by its position, height and tilt.

It depends on the shapes of both parts, so that the direction from the center of pressure to the socket's axis differs
from part to part. It also depends on the height, since a socket can have several rims, and on the tilt of the plug,
which moves the center of pressure to an edge. `create-task` measures the map in simulation: it lowers the plug onto the
socket at random positions and tilts. `SocketEstimator` compares the centers of pressure of an episode with the map.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from io import StringIO
from pathlib import Path

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource

from guiderail.diagrams.stations.station import CONTROL_PERIOD, Station
from guiderail.diagrams.tasks.options import MIN_CONTACT_FORCE
from guiderail.models.common.errors import InputError, brief
from guiderail.models.common.files import read_bytes, write_atomically
from guiderail.models.common.transforms import DEGREE, MM, POSE_SIZE
from guiderail.models.control.wrench import center_of_pressure
from guiderail.models.primitives.kernels import SquaredExponential
from guiderail_parts.task_file import MotionNumbers

# Length scales of the regression: of positions and heights [m], and of tilts [rad].
POSITION_SCALE, HEIGHT_SCALE, TILT_SCALE = 1.5 * MM, 1.0 * MM, 0.010
NOISE = 0.05  # variance of a sample relative to the map's
WEAK = 0.05  # number of samples that the variance of all centers of pressure counts as
MIN_DEVIATION = 0.3 * MM  # smallest standard deviation of a center of pressure from the map [m]
OUTLIERS = 0.02  # likelihood of a sample that contradicts the map, relative to that of its variance
MAX_SAMPLES = 600  # largest number of samples that a regression uses
COLUMNS = ("x", "y", "z", "tilt_y", "tilt_x", "center_x", "center_y")  # of the file [mm], [degrees]
UNITS = np.array([MM, MM, MM, DEGREE, DEGREE, MM, MM])
MAX_FILE_SIZE = 1 << 20  # [bytes]


@dataclass(frozen=True)
class ContactMap:
    """Centers of pressure of a plug on the socket, by its position relative to the socket and its tilt.

    Args:
        positions: Positions of the plug relative to the socket, (N, 3) [m].
        tilts: Tilts Ry and Rx of the plug, (N, 2) [rad].
        centers: Center of pressure of each sample, relative to the tool center, (N, 2) [m].

    Raises:
        InputError: If the arrays are not finite or not of these shapes.
    """

    positions: np.ndarray
    tilts: np.ndarray
    centers: np.ndarray

    def __post_init__(self) -> None:
        number = len(self.positions)
        shapes = tuple(samples.shape for samples in (self.positions, self.tilts, self.centers))
        if not number or shapes != ((number, 3), (number, 2), (number, 2)):
            raise InputError("a contact map has as many positions (N, 3), tilts (N, 2) and centers of pressure (N, 2)")
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
        return cls(rows[:, :3], rows[:, 3:5], rows[:, 5:])

    def save(self, path: Path) -> None:
        """Write the samples as a table, in millimeters and degrees."""
        text = StringIO()
        rows = np.hstack([self.positions, self.tilts, self.centers]) / UNITS
        np.savetxt(text, rows, fmt="%.4f", delimiter=",", header=",".join(COLUMNS), comments="")
        write_atomically(path, text.getvalue().encode())

    @property
    def lever(self) -> float:
        """Root mean square of the coordinates of all centers of pressure, at least `MIN_DEVIATION` [m]."""
        return max(float(np.sqrt((self.centers**2).mean())), MIN_DEVIATION)

    @cached_property
    def _regression(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, float]:
        """Positions, tilts, centers and terms of the used samples, and the variance of all centers [m²].

        Sums of the terms, (N, 4), weighted by the kernel, are the mean along x and y, the squared error, and the number
        of samples nearby.
        """
        every = -(-len(self.positions) // MAX_SAMPLES)
        positions, tilts, centers = (samples[::every] for samples in (self.positions, self.tilts, self.centers))
        by_position = SquaredExponential(POSITION_SCALE)(positions[:, :2], positions[:, :2])
        K = by_position * _by_height_and_tilt(positions, tilts, positions, tilts) + NOISE * np.eye(len(positions))
        inverse = np.linalg.inv(K)
        weights = inverse @ (centers - centers.mean(axis=0))
        # Squared error of each sample if it is left out (Rasmussen and Williams, equation 5.12)
        errors = ((weights / np.diag(inverse)[:, None]) ** 2).mean(axis=1)
        terms = np.column_stack([weights, errors, np.ones(len(errors))])
        return positions, tilts, centers, terms, float(centers.var(axis=0).mean())

    def log_likelihood(self, plug: np.ndarray, tilt: np.ndarray, center: np.ndarray, ticks: np.ndarray) -> np.ndarray:
        """Return the log-likelihood of a center of pressure for each position of the socket on a square grid.

        Args:
            plug: Position of the plug, (3,) [m].
            tilt: Its tilts Ry and Rx, (2,) [rad].
            center: Its center of pressure, (2,) [m].
            ticks: Coordinates of the socket, the same along x and y, (M,) [m].

        Returns:
            Log-likelihoods (M, M), up to a constant.
        """
        positions, tilts, centers, terms, whole = self._regression
        kernel = SquaredExponential(POSITION_SCALE)
        # The kernel is a product over x, y, and height with tilt.
        along_x, along_y = (kernel(plug[axis] - ticks, positions[:, axis]) for axis in (0, 1))
        terms = terms * _by_height_and_tilt(plug[None], tilt[None], positions, tilts).T
        x, y, error, number = ((along_x * term) @ along_y.T for term in terms.T)
        known_x, known_y = centers.mean(axis=0) - center
        # Far from all samples, the variance is that of all centers of pressure.
        variance = (error + WEAK * whole) / (number + WEAK) + MIN_DEVIATION**2
        likelihood = np.exp(-0.5 * ((known_x + x) ** 2 + (known_y + y) ** 2) / variance) / variance
        return np.asarray(np.log(likelihood + OUTLIERS / (whole + MIN_DEVIATION**2)))


def _by_height_and_tilt(p1: np.ndarray, a1: np.ndarray, p2: np.ndarray, a2: np.ndarray) -> np.ndarray:
    """Return the kernel (N, M) of heights and tilts, of positions (N, 3) with tilts (N, 2) and others, M of each."""
    by_height = SquaredExponential(HEIGHT_SCALE)(p1[:, 2], p2[:, 2])
    return np.asarray(by_height * SquaredExponential(TILT_SCALE)(a1, a2))


# Motion that measures a map: the plug is lowered onto the socket at random places and slides on it.
TOUCHES = 60
RADIUS = 5.0 * MM  # largest distance of the plug from the socket's axis [m]
MAX_SLIDE = 3.0 * MM  # largest length of a slide [m]
LOWERING, SLIDE = 2.0, 0.5  # longest duration until the plug touches, and duration of a slide [s]
SPEED = 0.05  # speed of the lowered command [m/s]
MIN_PRESS = 0.4  # smallest depth of the command below the plug, relative to that of a search
TURN, TILT = 2.0 * DEGREE, 0.7 * DEGREE  # largest turn and standard deviation of the tilts of the command [rad]


def measure_contact_map(station: Station, motion: MotionNumbers, seed: int = 0) -> ContactMap | None:
    """Return the map of the parts of a station, whose socket is at its nominal position.

    In each touch, the command stays a random depth below the plug, so that the plug descends until it touches, and
    follows the socket's surface while it slides. None if the plug never touched. The station becomes part of a diagram.
    """
    rng = np.random.default_rng(seed)
    turn = float(motion.plan_search()[1][0, 3])
    builder = DiagramBuilder()
    builder.AddSystem(station)
    source = builder.AddSystem(ConstantVectorSource(np.zeros(POSE_SIZE)))
    builder.Connect(source.get_output_port(), station.get_desired_pose_input_port())
    simulator = Simulator(builder.Build())
    context = simulator.get_mutable_context()
    initial = context.Clone()
    measured = station.GetMyContextFromRoot(context)
    command = source.get_mutable_source_value(source.GetMyMutableContextFromRoot(context))
    samples = []
    for _ in range(TOUCHES):
        first, last = _draw_slide(rng, turn)
        depth, slid, height = rng.uniform(MIN_PRESS, 1.0) * motion.press, 0.0, motion.travel
        context.SetTimeStateAndParametersFrom(initial)  # without the filtered wrench of the last touch
        command.set_value(np.insert(first, 2, height))
        station.set_pose(context, np.insert(first, 2, height))
        simulator.Initialize()
        while slid <= SLIDE and context.get_time() < LOWERING + slid:
            pose, wrench = (station.GetOutputPort(name).Eval(measured) for name in ("pose", "wrench"))
            if touches := wrench[2] >= MIN_CONTACT_FORCE:
                samples.append(np.r_[pose[:3], pose[4:], center_of_pressure(wrench, MIN_CONTACT_FORCE)])
            if touches or slid > 0.0:
                slid += CONTROL_PERIOD
            height = max(pose[2] - depth, height - SPEED * CONTROL_PERIOD)
            command.set_value(np.insert(first + (last - first) * slid / SLIDE, 2, height))
            simulator.AdvanceTo(context.get_time() + CONTROL_PERIOD)
    positions, tilts, centers = np.split(np.reshape(samples, (-1, 7)), (3, 5), axis=1)
    return ContactMap(positions, tilts, centers) if samples else None


def _draw_slide(rng: np.random.Generator, turn: float) -> tuple[np.ndarray, np.ndarray]:
    """Return [x y Rz Ry Rx] (5,) at the start and at the end of a slide, with turns around `turn` [rad]."""

    def draw() -> np.ndarray:
        radius, angle = RADIUS * np.sqrt(rng.uniform()), rng.uniform(0.0, 2.0 * np.pi)
        return radius * np.array([np.cos(angle), np.sin(angle)])

    start, end, yaw = draw(), draw(), turn + rng.uniform(-TURN, TURN)
    end = start + (end - start) * min(1.0, MAX_SLIDE / max(float(np.linalg.norm(end - start)), 1e-9))
    first, last = rng.normal(0.0, TILT, (2, 2))
    return np.array([*start, yaw, *first]), np.array([*end, yaw, *last])
