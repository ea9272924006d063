"""Demonstrations: what a person showed (thesis, section 2.2.2)."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from guiderail.models.common.arrays import numbers
from guiderail.models.common.errors import InputError, brief
from guiderail.models.primitives import io as demonstration_files


class Demonstrations:
    """M recordings of O outputs over time, each of its own length and rate.

    A sample that was recorded twice, the same time with the same outputs, counts once.

    Attributes:
        times: M arrays (N_m,), strictly increasing.
        outputs: M arrays (N_m, O).
        names: O names of the outputs, with their units ("x [m]").
    """

    def __init__(
        self,
        times: np.ndarray | Sequence[np.ndarray],
        outputs: np.ndarray | Sequence[np.ndarray],
        names: Sequence[str] | None = None,
    ):
        """
        Args:
            times: one clock (N,) for all, or M of them (N_m,) [s or phase].
            outputs: M × (N_m, O).
            names: of the outputs; "y1", "y2", … unless given.

        Raises:
            InputError: if there is no demonstration, one has fewer than two points, shapes or dimensions differ, a
                number is not finite, or time does not increase strictly.
        """
        self.outputs = tuple(numbers(y, f"demonstration {m}") for m, y in enumerate(_listed(outputs, "outputs")))
        if not self.outputs:
            raise InputError("there is no demonstration: give at least one")
        clocks = _listed(times, "times")
        if clocks and np.isscalar(clocks[0]):
            clocks = [times] * len(self.outputs)
        if len(clocks) != len(self.outputs):
            raise InputError(f"there are {len(clocks)} time vectors for {len(self.outputs)} demonstrations")
        self.times = tuple(numbers(t, f"demonstration {m}'s time") for m, t in enumerate(clocks))
        for m, (t, y) in enumerate(zip(self.times, self.outputs, strict=True)):
            if t.ndim != 1 or y.ndim != 2 or len(t) != len(y):
                raise InputError(
                    f"demonstration {m} needs times (N,) and outputs (N, O), not shapes {t.shape} and {y.shape}"
                )
            if y.shape[1] < 1 or y.shape[1] != self.outputs[0].shape[1]:
                raise InputError(
                    f"demonstration {m} has {y.shape[1]} outputs, the first has {self.outputs[0].shape[1]}: "
                    "record the same outputs in all of them"
                )
            if not np.isfinite(t).all() or not np.isfinite(y).all():
                raise InputError(f"demonstration {m} contains NaN or infinity: cut those samples out")
        self._drop_repeated_samples()
        for m, t in enumerate(self.times):
            if len(t) < 2:
                raise InputError(f"demonstration {m} has {len(t)} point: a motion needs at least two")
            if not (t[1:] > t[:-1]).all():
                at = int(np.argmax(t[1:] <= t[:-1])) + 1
                raise InputError(f"demonstration {m}'s time does not increase at sample {at}: sort or drop samples")
        default = [f"y{o + 1}" for o in range(self.num_outputs)]
        self.names: tuple[str, ...] = tuple(default if names is None else _listed(names, "names"))
        if len(self.names) != self.num_outputs:
            raise InputError(f"there are {len(self.names)} names for {self.num_outputs} outputs")
        for name in self.names:
            if not (isinstance(name, str) and name.isprintable() and name == name.strip() and len(name) <= 200):
                raise InputError(f"an output can't be named {brief(name)}: use a short text that can be printed")

    def _drop_repeated_samples(self) -> None:
        """A recorder that is faster than its robot logs a sample twice, time and all: that is one sample."""
        times, outputs = [], []
        for t, y in zip(self.times, self.outputs, strict=True):
            new = np.ones(len(t), dtype=bool)
            new[1:] = (t[1:] != t[:-1]) | (y[1:] != y[:-1]).any(axis=1)
            times.append(t[new])
            outputs.append(y[new])
        self.times, self.outputs = tuple(times), tuple(outputs)

    @property
    def num_demonstrations(self) -> int:
        """M."""
        return len(self.outputs)

    @property
    def num_outputs(self) -> int:
        """O."""
        return self.outputs[0].shape[1]

    def resampled(self, num_steps: int | None = None) -> "Demonstrations":
        """All demonstrations on one uniform clock, by linear interpolation.

        Each is stretched in time to the mean duration of all: a person is faster once than another time, and what a
        primitive learns is where, not when. Already on one uniform clock of that length, they are returned unchanged.

        Args:
            num_steps: N; that of the longest recording unless given.

        Raises:
            InputError: if fewer than two steps are asked for.
        """
        num_steps = max(len(t) for t in self.times) if num_steps is None else num_steps
        if num_steps < 2:
            raise InputError(f"a clock needs at least two steps, not {num_steps}")
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
        """Writes `.npz` (exact) or `.csv` (one row a sample: demonstration, time, outputs), by the file's ending.

        Raises:
            InputError: if the ending is neither.
        """
        path = Path(path)
        writer = {".npz": demonstration_files.write_npz, ".csv": demonstration_files.write_csv}.get(path.suffix)
        if writer is None:
            raise InputError(f"cannot write demonstrations to '{path.name}': use the ending .npz or .csv")
        writer(path, self.times, self.outputs, self.names)

    @classmethod
    def load(cls, path: str | Path) -> "Demonstrations":
        """Reads what `save` writes, and what others write.

        An `.npz` may also hold `times` (N,) or (M, N) with `outputs` (M, N, O). A `.csv` whose first line is `t` (or
        `time`, `time [s]`) and the outputs' names is one demonstration, and a folder of such files is as many. Time is
        in seconds. Nothing in a file is ever executed: arrays of Python objects are refused.

        Raises:
            InputError: if there is no such file, it is truncated, damaged or too large, or what it holds are no
                demonstrations.
        """
        path = Path(path)
        times, outputs, names = demonstration_files.read(path)
        try:
            demonstrations = cls(times, outputs, names)
        except InputError as error:
            raise InputError(f"'{path}': {error}") from error
        on_one_clock = demonstrations.num_demonstrations * max(map(np.size, demonstrations.outputs))
        if on_one_clock > 2 * demonstration_files.MOST_NUMBERS:
            raise InputError(f"'{path}': one demonstration has far more samples than the others: thin it out")
        return demonstrations


def _listed(values: Any, what: str) -> list[Any]:
    try:
        return list(values)
    except TypeError as error:
        raise InputError(f"{what} must be a list, not {brief(values)}") from error
