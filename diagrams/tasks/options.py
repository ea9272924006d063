"""Fields of options that tasks share, hidden offsets and references fitted to files; nothing here imports Drake.

The fields and limits also define `task.yaml` of packages/parts, and exported C++ skills have `CONTACT_MEMORY` and
`MIN_CONTACT_FORCE`.
"""

from __future__ import annotations

import hashlib
from abc import ABC, abstractmethod
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from guiderail.diagrams.envs.options import Numbers, Pair, increases, satisfies
from guiderail.diagrams.stations.options import CONTROL_PERIOD
from guiderail.models.common.errors import InputError
from guiderail.models.common.transforms import DEGREE, MM, POSE_SIZE
from guiderail.models.primitives import Demonstrations, ReferenceTrajectory
from guiderail.models.primitives.reference import interpolate_prior

# Default force limit [N]. In GridClamp, an unbounded impedance of 1500 N/m does not reach it: the template's cuboid is
# 8 mm wide, and ends 6 mm below the target and 18 mm below a clamp on the table.
COLLISION_FORCE = 35.0
MIN_CONTACT_FORCE = 0.5  # smallest force along z at which a center of pressure is computed [N]
CONTACT_MEMORY = 1.0  # time over which points of contact are averaged [s]

# Scales of the observed center of pressure and of the observed command. The center of pressure, unlike the torque, does
# not increase with the contact force. The command is observed because the measured pose of a plug on a rim does not
# indicate the effect of an action.
CENTER_OF_PRESSURE_SCALE, COMMAND_SCALE = 3.0 * MM, 2.0 * MM

# Variance ρ of the history [m², rad²]; the thesis's 1e-8, (0.1 mm)², is too large for demonstrations that vary by 1 mm.
HISTORY_VARIANCE = 1e-11

# Repeatability of a demonstrator's hand, as a standard deviation: x y z [m] and Rz Ry Rx [rad]. Its square is added to
# fitted variances.
REPEATABILITY_STD = (0.05 * MM, 0.05 * MM, 0.1 * MM, 0.2 * DEGREE, 0.05 * DEGREE, 0.05 * DEGREE)

NEGLIGIBLE_OFFSET = 0.3 * MM  # largest fixture offset with fixture_offset=none [m]
LARGEST_OFFSET = 4.0 * MM  # largest fixture offset [m]; beyond it the plug misses the rim of its socket
MAX_PRIOR_STD = np.array([0.05, 0.05, 0.05, 1.0, 1.0, 1.0])  # [m], [rad]; larger values are probably in mm or degrees
FORCE_LIMITS = (1.0, 60.0)  # smallest and largest force limit [N]


OffsetRange = Annotated[
    Pair,
    increases(0.0, LARGEST_OFFSET, f"give two distances from 0 to {LARGEST_OFFSET} m, the smaller one first"),
]
PriorStd = Annotated[
    Numbers,
    satisfies(
        lambda std: not (interpolate_prior(std, 101, POSE_SIZE) > MAX_PRIOR_STD).any(),
        f"give meters and radians, at most {MAX_PRIOR_STD[0]:g} m and {MAX_PRIOR_STD[-1]:g} rad",
    ),
]
ForceRange = Annotated[
    Pair,
    increases(
        *FORCE_LIMITS, f"give two forces from {FORCE_LIMITS[0]:g} to {FORCE_LIMITS[1]:g} N, the smaller one first"
    ),
]


def force_limit_field(least: float) -> Any:
    """Return the field of a force limit of at least `least` [N]."""
    description = "force that ends an episode as a collision [N]"
    return Field(COLLISION_FORCE, ge=least, le=FORCE_LIMITS[1], description=description)


def friction_field(default: float, surfaces: str) -> Any:
    """Return the field of a friction coefficient; `surfaces` names what has it."""
    return Field(default, ge=0.05, le=0.4, description=f"friction coefficient of {surfaces}")


def length_field(default: float, least: float, largest: float, description: str) -> Any:
    """Return the field of a length [m] from `least` to `largest`."""
    return Field(default, ge=least, le=largest, description=f"{description} [m]")


def prior_std_field() -> Any:
    """Return the field of the standard deviation around a single demonstration, a `PriorStd` or None."""
    return Field(
        None,
        description="standard deviation around a single demonstration, required for one demonstration: x y z Rz Ry Rx "
        "[m], [rad], or rows of a phase from 0 to 1 and six such numbers; its square is added to the fitted variance",
        examples=[(0.002, 0.002, 0.0005, 0.02, 0.01, 0.01)],
    )


def reference_of_file(
    path: Path,
    components: int | None,
    floor: tuple[float, ...],
    count: int | None = None,
    prior_std: tuple[float, ...] | None = None,
) -> ReferenceTrajectory:
    """Fit a reference trajectory, with the mean duration of the demonstrations, to the demonstrations in a file.

    Args:
        path: File .npz or .csv with poses (N, 6) in the target frame.
        components: Number of components of the Gaussian mixture; None: selected by the Bayesian information criterion.
        floor: Repeatability of a demonstrator's hand, as a standard deviation (6,); its square is added to the fitted
            variances.
        count: Number of demonstrations to use, from the first on; None: all.
        prior_std: As in `ReferenceTrajectory.from_demonstrations`.

    Raises:
        InputError: If there is no such file, or its demonstrations are not poses.
    """
    if not path.is_file():
        raise InputError(f"there is no file {path}: give a file that guiderail teleoperate --record has written")
    with path.open("rb") as file:
        key = hashlib.file_digest(file, "sha256").digest(), components, floor, count, prior_std
    if key in _REFERENCES:
        return _REFERENCES[key]
    demonstrations = Demonstrations.load(path).first(count)
    if demonstrations.num_outputs != POSE_SIZE:
        raise InputError(
            f"{path} has {demonstrations.num_outputs} outputs: an insertion needs the six of a pose, "
            "[x y z Rz Ry Rx] in the target frame"
        )
    num_steps = control_steps(demonstrations)
    fitted = ReferenceTrajectory.from_demonstrations(
        demonstrations.resampled(num_steps), components=components, floor=np.array(floor), prior_std=prior_std
    )
    times = CONTROL_PERIOD * np.arange(num_steps)
    _REFERENCES[key] = ReferenceTrajectory(times, fitted.means, fitted.covariances)
    return _REFERENCES[key]


def control_steps(demonstrations: Demonstrations) -> int:
    """Return the number of control steps of the demonstrations' mean duration."""
    duration = float(np.mean([t[-1] - t[0] for t in demonstrations.times]))
    return round(duration / CONTROL_PERIOD) + 1


# Cache of fits, each of which takes seconds. A key contains a file's digest, not its path: `create-task` moves files.
_REFERENCES: dict[tuple[Any, ...], ReferenceTrajectory] = {}


class HiddenOffsets(ABC):
    """Sampler of the actual offsets of fixture and workpiece at every reset.

    An offset is (x, y) [m]: that of the fixture is in the target frame, that of the workpiece in the tool frame. A
    subclass may append angles [rad]; see `part_poses`.

    A run begins at the first reset, and at every reset with the option `new_run`. With the option `held_out`, the
    episode is sampled from a random stream that training never uses, and the run's hidden offset does not change. The
    option `offset` (x, y) [m] replaces the sample.
    """

    def __init__(self, kind: str = "per_run"):
        """Construct the sampler; `kind` is "per_run", "per_episode" or "none", as the option `fixture_offset`."""
        self.kind = kind

    def draw(self, rng: np.random.Generator, given: Any, run: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
        """Return the offsets of fixture and workpiece, (2,) or longer.

        `given` is an instance of `InsertionReset`; the hidden values of a run are stored in `run`.
        """
        # Every reset takes equally many numbers from `rng`, used or not, so that the options of a reset do not change
        # the samples of later resets.
        hidden = self._draw_run(rng)
        episode = episode_stream(rng, given.held_out)
        if "hidden" not in run or given.new_run:
            run["hidden"] = hidden
        if given.offset is not None:
            return self._offsets_of(np.array(given.offset))
        return self._draw_episode(episode, run["hidden"])

    @abstractmethod
    def _draw_run(self, rng: np.random.Generator) -> Any:
        """Sample the hidden parameters of a run."""

    @abstractmethod
    def _draw_episode(self, rng: np.random.Generator, run: Any) -> tuple[np.ndarray, np.ndarray]:
        """Sample the offsets of an episode of a run."""

    @abstractmethod
    def _offsets_of(self, offset: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the offsets for the option `offset`."""


_HELD_OUT_STREAM = 0x8E1D  # last seed word of the held-out stream; the training stream has 0


def episode_stream(rng: np.random.Generator, held_out: bool) -> np.random.Generator:
    """Return the random generator of an episode's conditions, for training or for held-out episodes.

    Both streams take one number from `rng`, so that later samples from `rng` do not depend on `held_out`.
    """
    return np.random.default_rng([int(rng.integers(2**62)), _HELD_OUT_STREAM if held_out else 0])


def in_ring(rng: np.random.Generator, inner: float, outer: float) -> np.ndarray:
    """Sample a point (2,) uniformly from the annulus around the origin with radii `inner` and `outer`."""
    radius = np.sqrt(rng.uniform(inner**2, outer**2))
    angle = rng.uniform(0.0, 2.0 * np.pi)
    return radius * np.array([np.cos(angle), np.sin(angle)])
