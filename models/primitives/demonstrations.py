"""Demonstrations: what a person showed (thesis, section 2.2.2)."""

import csv
import zipfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from guiderail.models.errors import InputError


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
        self.outputs = tuple(_array(y, f"demonstration {m}") for m, y in enumerate(outputs))
        if not self.outputs:
            raise InputError("there is no demonstration: give at least one")
        common = len(times) > 0 and np.ndim(times[0]) == 0
        clocks = [times] * len(self.outputs) if common else list(times)
        if len(clocks) != len(self.outputs):
            raise InputError(f"there are {len(clocks)} time vectors for {len(self.outputs)} demonstrations")
        self.times = tuple(_array(t, f"demonstration {m}'s time") for m, t in enumerate(clocks))
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
            if not (np.diff(t) > 0).all():
                at = int(np.argmax(np.diff(t) <= 0)) + 1
                raise InputError(f"demonstration {m}'s time does not increase at sample {at}: sort or drop samples")
        self.names = tuple(names) if names is not None else tuple(f"y{o + 1}" for o in range(self.num_outputs))
        if len(self.names) != self.num_outputs:
            raise InputError(f"there are {len(self.names)} names for {self.num_outputs} outputs")

    def _drop_repeated_samples(self) -> None:
        """A recorder that is faster than its robot logs a sample twice, time and all: that is one sample."""
        times, outputs = [], []
        for t, y in zip(self.times, self.outputs, strict=True):
            new = np.append(True, (np.diff(t) != 0) | (np.diff(y, axis=0) != 0).any(axis=1))
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
        lengths = np.array([len(t) for t in self.times])
        if path.suffix == ".npz":
            np.savez_compressed(
                path,
                lengths=lengths,
                times=np.concatenate(self.times),
                outputs=np.concatenate(self.outputs),
                names=np.array(self.names),
            )
        elif path.suffix == ".csv":
            with path.open("w", newline="") as file:
                writer = csv.writer(file)
                writer.writerow(["demonstration", "time", *self.names])
                for m, (t, y) in enumerate(zip(self.times, self.outputs, strict=True)):
                    writer.writerows(
                        [m, repr(float(a)), *(repr(float(v)) for v in b)] for a, b in zip(t, y, strict=True)
                    )
        else:
            raise InputError(f"cannot write demonstrations to '{path.name}': use the ending .npz or .csv")

    @classmethod
    def load(cls, path: str | Path) -> "Demonstrations":
        """Reads what `save` writes; an `.npz` may also hold `times` (N,) or (M, N) with `outputs` (M, N, O).

        Nothing in a file is ever executed: arrays of Python objects are refused.

        Raises:
            InputError: if there is no such file, it is truncated or damaged, or what it holds are no demonstrations.
        """
        path = Path(path)
        if not path.is_file():
            raise InputError(f"there is no demonstration file '{path}'")
        try:
            if path.suffix == ".npz":
                return cls._from_npz(path)
            if path.suffix == ".csv":
                return cls._from_csv(path)
        except InputError as error:
            raise InputError(f"'{path}': {error}") from error
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
            reason = str(error).split(". ")[0].rstrip(".")  # NumPy also advises to load what is pickled, unsafely
            raise InputError(f"'{path}' is damaged or no demonstration file: {reason}") from error
        raise InputError(f"cannot read demonstrations from '{path.name}': the ending must be .npz or .csv")

    @classmethod
    def _from_npz(cls, path: Path) -> "Demonstrations":
        with np.load(path, allow_pickle=False) as file:
            for key in ("times", "outputs"):
                if key not in file:
                    raise InputError(f"the array '{key}' is missing")
            times, outputs = file["times"], file["outputs"]
            names = [str(name) for name in file["names"]] if "names" in file else None
            if "lengths" not in file:
                return cls(times, list(outputs), names)
            lengths = file["lengths"]
            if lengths.sum() != len(times) or len(times) != len(outputs):
                raise InputError(f"lengths add up to {lengths.sum()}, but there are {len(times)} samples")
            cuts = np.cumsum(lengths)[:-1]
            return cls(np.split(times, cuts), np.split(outputs, cuts), names)

    @classmethod
    def _from_csv(cls, path: Path) -> "Demonstrations":
        with path.open(newline="") as file:
            rows = list(csv.reader(file))
        if not rows or rows[0][:2] != ["demonstration", "time"] or len(rows[0]) < 3:
            raise InputError("the first line must be demonstration,time,<outputs>")
        width = len(rows[0])
        for number, row in enumerate(rows[1:], start=2):
            if len(row) != width:
                raise InputError(f"line {number} has {len(row)} fields, the header has {width}")
        samples = np.array([[float(value) for value in row] for row in rows[1:]]).reshape(-1, width)
        parts = [samples[samples[:, 0] == m] for m in np.unique(samples[:, 0])]
        return cls([part[:, 1] for part in parts], [part[:, 2:] for part in parts], rows[0][2:])


def _array(values: ArrayLike, what: str) -> np.ndarray:
    try:
        return np.array(values, dtype=float)
    except (TypeError, ValueError) as error:
        raise InputError(f"{what} is not an array of numbers: {error}") from error
