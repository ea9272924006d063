"""Demonstrations: recorded motions to learn from (thesis, section 2.2.2)."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from guiderail.models.common.arrays import as_number, as_numbers, as_whole
from guiderail.models.common.errors import InputError, brief
from guiderail.models.primitives import io
from guiderail.models.primitives.poses import POSE_NAMES, Orientation, pose_outputs, without_jumps

MAX_STEPS = 20_000  # largest number of control steps of a motion: 20 s at 1 kHz, 400 s at 50 Hz
MAX_MAGNITUDE = 1e100  # largest absolute value; covariances, which are products of two outputs, must not overflow


def num_periods(duration: float, period: float) -> int:
    """Return the duration of a motion in periods, rounded; raise an InputError unless it is less than `MAX_STEPS`."""
    if not duration / period < MAX_STEPS:
        raise InputError(
            f"a motion of {duration:.3g} s has {MAX_STEPS} or more periods of {period:.3g} s: give a longer period"
        )
    return round(duration / period)


class Demonstrations:
    """M recordings of O outputs over time, each with its own length and rate.

    Repeated samples (same time, same outputs) are dropped. Jumps by a full turn, such as from π to −π, are removed from
    outputs that have the names of angles or of a rotation vector (`without_jumps`).

    Args:
        times: One clock (N,) for all demonstrations, or M clocks (N_m,), strictly increasing [s or phase].
        outputs: M arrays (N_m, O).
        names: Different names of the outputs with their units, such as "x [m]"; "y1", "y2", … by default.

    Raises:
        InputError: If there is no demonstration, a demonstration has fewer than two samples or no output, shapes or
            numbers of outputs do not match, a number is not finite or above `MAX_MAGNITUDE`, time does not increase
            strictly, `names` are not O different short printable texts, or they name an orientation in degrees.

    Attributes:
        times, outputs: M arrays (N_m,) and (N_m, O).
        names: Names of the O outputs.
    """

    def __init__(
        self,
        times: np.ndarray | Sequence[np.ndarray],
        outputs: np.ndarray | Sequence[np.ndarray],
        names: Sequence[str] | None = None,
    ):
        self.outputs = tuple(as_numbers(y, f"demonstration {m}") for m, y in enumerate(_as_list(outputs, "outputs")))
        if not self.outputs:
            raise InputError("there is no demonstration: give at least one")
        clocks = _as_list(times, "times")
        if clocks and np.isscalar(clocks[0]):
            clocks = [times] * len(self.outputs)
        if len(clocks) != len(self.outputs):
            raise InputError(f"there are {len(clocks)} time vectors for {len(self.outputs)} demonstrations")
        self.times = tuple(as_numbers(t, f"demonstration {m}'s time") for m, t in enumerate(clocks))
        for m, (t, y) in enumerate(zip(self.times, self.outputs, strict=True)):
            if t.ndim != 1 or y.ndim != 2 or len(t) != len(y):
                raise InputError(
                    f"demonstration {m} needs times (N,) and outputs (N, O), not shapes {t.shape} and {y.shape}"
                )
            if y.shape[1] < 1:
                raise InputError(
                    f"demonstration {m} has no output: record at least one, not samples of shape {y.shape}"
                )
            if y.shape[1] != self.outputs[0].shape[1]:
                raise InputError(
                    f"demonstration {m} has {y.shape[1]} outputs, the first has {self.outputs[0].shape[1]}: "
                    "record the same outputs in all of them"
                )
            if not np.isfinite(t).all() or not np.isfinite(y).all():
                raise InputError(f"demonstration {m} contains NaN or infinity: cut those samples out")
            if (largest := max(np.abs(t).max(initial=0.0), np.abs(y).max(initial=0.0))) > MAX_MAGNITUDE:
                raise InputError(f"demonstration {m} contains {largest:.3g}, which is too large: check its unit")
        self._drop_repeated_samples()
        for m, t in enumerate(self.times):
            if len(t) < 2:
                raise InputError(f"demonstration {m} has {len(t)} point: a motion needs at least two")
            if not (t[1:] > t[:-1]).all():
                at = int(np.argmax(t[1:] <= t[:-1])) + 1
                raise InputError(f"demonstration {m}'s time does not increase at sample {at}: sort or drop samples")
        default = [f"y{o + 1}" for o in range(self.num_outputs)]
        self.names: tuple[str, ...] = tuple(default if names is None else _as_list(names, "names"))
        if len(self.names) != self.num_outputs:
            raise InputError(f"there are {len(self.names)} names for {self.num_outputs} outputs")
        for name in self.names:
            if not (isinstance(name, str) and name.isprintable() and name == name.strip() and len(name) <= 200):
                raise InputError(f"an output can't be named {brief(name)}: use a short text that can be printed")
        if repeated := io.find_repeated(self.names):
            raise InputError(f"two outputs are called {brief(repeated)}: rename one")
        self.outputs = without_jumps(self.outputs, self.names)

    def _drop_repeated_samples(self) -> None:
        """Drop samples that equal their predecessor, as logged by a recorder that runs faster than its robot."""
        times, outputs = [], []
        for t, y in zip(self.times, self.outputs, strict=True):
            is_new = np.ones(len(t), dtype=bool)
            is_new[1:] = (t[1:] != t[:-1]) | (y[1:] != y[:-1]).any(axis=1)
            times.append(t[is_new])
            outputs.append(y[is_new])
        self.times, self.outputs = tuple(times), tuple(outputs)

    @property
    def num_demonstrations(self) -> int:
        """Number of demonstrations M."""
        return len(self.outputs)

    @property
    def num_outputs(self) -> int:
        """Number of outputs O."""
        return self.outputs[0].shape[1]

    def first(self, count: int | None) -> "Demonstrations":
        """Return the first `count` demonstrations, or all if `count` is None.

        Raises:
            InputError: If `count` is not a whole number from 1 to the number of demonstrations.
        """
        if count is None:
            return self
        count = as_whole(count, "the number of demonstrations", 1, self.num_demonstrations)
        return Demonstrations(self.times[:count], self.outputs[:count], self.names)

    def resampled(self, num_steps: int | None = None) -> "Demonstrations":
        """Return all demonstrations on one uniform clock, by linear interpolation.

        Each demonstration is scaled in time to the mean duration, because a primitive learns positions, not speeds.
        Demonstrations that already have one uniform clock of N steps are returned unchanged.

        Args:
            num_steps: Number of steps N, from 2 to `MAX_STEPS`; by default the largest number of samples.

        Raises:
            InputError: If `num_steps` is out of range or not a whole number.
        """
        most = max(len(t) for t in self.times)
        num_steps = most if num_steps is None else as_whole(num_steps, "num_steps", 2, MAX_STEPS)
        first = self.times[0]
        if len(first) == num_steps and all(np.array_equal(t, first) for t in self.times):
            steps = np.diff(first)
            if np.ptp(steps) <= 1e-9 * steps.mean():
                return self
        duration = float(np.mean([t[-1] - t[0] for t in self.times]))
        start = float(np.mean([t[0] for t in self.times]))
        phase = np.linspace(0, 1, num_steps)
        outputs = []
        for t, y in zip(self.times, self.outputs, strict=True):
            s = (t - t[0]) / (t[-1] - t[0])
            outputs.append(np.column_stack([np.interp(phase, s, column) for column in y.T]))
        return Demonstrations(start + duration * phase, outputs, self.names)

    def save(self, path: str | Path) -> None:
        """Write an `.npz` or a `.csv` file without rounding.

        A `.csv` file has one row per sample: demonstration, time, outputs.

        Raises:
            InputError: If `path` has another ending, or the file cannot be written.
        """
        path = Path(path)
        writer = {".npz": io.write_npz, ".csv": io.write_csv}.get(path.suffix)
        if writer is None:
            raise InputError(f"cannot write demonstrations to '{path.name}': use the ending .npz or .csv")
        writer(path, self.times, self.outputs, self.names)

    @classmethod
    def load(cls, path: str | Path) -> "Demonstrations":
        """Read a file that `save` or another program wrote.

        An `.npz` file of another program contains `times` (N,) or (M, N), and `outputs` (M, N, O). If the first line of
        a `.csv` file is `t` (or `time`, `timestamp`, `time [s]`) and the outputs' names, the file contains one
        demonstration. A folder of such files contains one demonstration per file. Time is in seconds. Arrays of Python
        objects are refused, so that reading a file never executes code.

        Raises:
            InputError: If there is no such file, or it is truncated, damaged, too large or without demonstrations.
        """
        path = Path(path)
        times, outputs, names = io.read(path)
        try:
            demonstrations = cls(times, outputs, names)
        except InputError as error:
            raise InputError(f"'{path}': {error}") from error
        resampled_size = demonstrations.num_demonstrations * max(map(np.size, demonstrations.outputs))
        if resampled_size > 2 * io.MAX_NUMBERS:
            raise InputError(f"'{path}': one demonstration has far more samples than the others: thin it out")
        return demonstrations


def _as_list(values: Any, what: str) -> list[Any]:
    try:
        return list(values)
    except TypeError as error:
        raise InputError(f"{what} must be a list, not {brief(values)}") from error


def phases_of_steps(phases: Sequence[float] | np.ndarray, num_steps: int) -> np.ndarray:
    """Return the phase index of each step of a motion, (num_steps,).

    `phases` (K,) are the increasing starts of the phases, as fractions of the duration; the first one is 0.
    """
    return np.searchsorted(phases, np.linspace(0.0, 1.0, num_steps), side="right") - 1


@dataclass(frozen=True)
class DemonstratedBounds:
    """Lower and upper bounds of each output in each phase of a motion."""

    names: tuple[str, ...]  # names of the outputs (O,)
    phases: np.ndarray  # start of each phase (K,), as a fraction of the duration from 0 to below 1
    lower: np.ndarray  # lower bounds (K, O), −inf for an unbounded output
    upper: np.ndarray  # upper bounds (K, O), inf for an unbounded output
    max_rates: np.ndarray  # largest demonstrated rate of each output (O,) [unit of the output/s]


def compute_bounds(
    demonstrations: Demonstrations,
    phases: int = 1,
    margin: float = 0.1,
    min_margin: float = 0.0,
    bounded: Sequence[int] | None = None,
) -> DemonstratedBounds:
    """Compute bounds that every demonstration satisfies.

    Samples at the border of two phases count for both phases, so that the bounds of the phases overlap.

    Args:
        demonstrations: At least one demonstration.
        phases: Number K of phases; they divide the motion into parts of equal duration.
        margin: Margin on each side, relative to the range of the phase, not negative.
        min_margin: Smallest margin on each side [unit of the output], not negative.
        bounded: Indices of the bounded outputs, not a mask; all by default.

    Raises:
        InputError: If an argument is out of range, or `phases` or an index is not a whole number.
    """
    common = demonstrations.resampled()
    outputs = np.stack(common.outputs)
    steps = outputs.shape[1]
    phases = as_whole(phases, "the number of phases", 1, steps // 2)
    if not all(0.0 <= as_number(value, "a margin") < np.inf for value in (margin, min_margin)):
        raise InputError(f"margins must be finite and not negative, not {margin} and {min_margin}")
    chosen = range(outputs.shape[2]) if bounded is None else _as_list(bounded, "bounded")
    indices = [as_whole(index, "an index of an output", 0, outputs.shape[2] - 1) for index in chosen]
    if not indices:
        raise InputError("bounds are on at least one output: name it in bounded")
    starts = np.arange(phases) / phases
    lower, upper = (np.full((phases, outputs.shape[2]), inf) for inf in (-np.inf, np.inf))
    # Resampling to common times can miss extreme values, so the original samples are included.
    samples = list(zip(demonstrations.times, demonstrations.outputs, strict=True))
    curves = [(np.linspace(0.0, 1.0, steps), y) for y in outputs]
    curves += [((t - t[0]) / (t[-1] - t[0]), y) for t, y in samples]
    border = 1.5 / (steps - 1)
    for k, start in enumerate(starts):
        end = start + 1.0 / phases
        inside = np.concatenate([y[(at >= start - border) & (at <= end + border)] for at, y in curves])
        low, high = inside.min(axis=0), inside.max(axis=0)
        margins = np.maximum(margin * (high - low), min_margin)
        lower[k, indices], upper[k, indices] = (low - margins)[indices], (high + margins)[indices]
    rates = [np.abs(np.diff(y, axis=0) / np.diff(t)[:, None]).max(axis=0) for t, y in samples]
    return DemonstratedBounds(demonstrations.names, starts, lower, upper, np.max(rates, axis=0))


def pose_demonstrations(
    times: Sequence[np.ndarray],
    positions: Sequence[np.ndarray],
    quaternions_wxyz: Sequence[np.ndarray],
    target_position: np.ndarray | None = None,
    target_quaternion_wxyz: np.ndarray | None = None,
    orientation: Orientation = "euler_zyx",
) -> Demonstrations:
    """Build demonstrations of six outputs from recorded end-effector poses.

    Args:
        times: M arrays (N_m,) [s].
        positions: p_WE, M arrays (N_m, 3) [m], in any common frame W.
        quaternions_wxyz: R_WE, M arrays (N_m, 4).
        target_position: p_WT (3,) [m]; each demonstration's last position by default (thesis, section 4.4.2).
        target_quaternion_wxyz: R_WT (4,); each demonstration's last orientation by default.
        orientation: As in `pose_outputs`.
    """
    outputs: list[np.ndarray] = []
    for p, q in zip(positions, quaternions_wxyz, strict=True):
        target_p = p[-1] if target_position is None else target_position
        target_q = q[-1] if target_quaternion_wxyz is None else target_quaternion_wxyz
        near = outputs[0][0, 3:] if outputs else None
        outputs.append(pose_outputs(p, q, target_p, target_q, orientation, near))
    return Demonstrations(times, outputs, POSE_NAMES[orientation])
