"""Bounds on outputs from demonstrations: the demonstrated range in each phase plus a margin."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from guiderail.models.common.errors import InputError
from guiderail.models.primitives.demonstrations import Demonstrations


@dataclass(frozen=True)
class DemonstratedBounds:
    """Lower and upper bounds of each output in each phase.

    Attributes:
        names: Names of the outputs (O,).
        phases: Start of each phase (K,), from 0 to 1.
        lower, upper: Bounds (K, O), infinite where an output is free.
        max_rates: Largest demonstrated rate of each output (O,) [unit of the output/s].
    """

    names: tuple[str, ...]
    phases: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    max_rates: np.ndarray

    def contains(self, outputs: np.ndarray) -> np.ndarray:
        """Return a mask (N,), true where a sample is within the bounds; `outputs` (N, O) cover the whole motion."""
        phase = np.searchsorted(self.phases, np.linspace(0.0, 1.0, len(outputs)), side="right") - 1
        return np.all((outputs >= self.lower[phase]) & (outputs <= self.upper[phase]), axis=1)


def compute_bounds(
    demonstrations: Demonstrations,
    phases: int = 1,
    margin: float = 0.1,
    min_margin: float = 0.0,
    bounded: Sequence[int] | None = None,
) -> DemonstratedBounds:
    """Compute bounds that every demonstration satisfies.

    The range of a phase includes the samples at its borders, so that the bounds of adjacent phases overlap.

    Args:
        demonstrations: At least one demonstration.
        phases: Number K of phases; they divide the motion into parts of equal duration.
        margin: Margin on each side, relative to the range of the phase, not negative.
        min_margin: Smallest margin on each side [unit of the output], not negative.
        bounded: Indices of the bounded outputs; all by default.

    Raises:
        InputError: If an argument is out of range.
    """
    common = demonstrations.resampled()
    outputs = np.stack(common.outputs)
    steps = outputs.shape[1]
    if not 1 <= phases <= steps // 2:
        raise InputError(f"there are from 1 to {steps // 2} phases in {steps} samples, not {phases}")
    if not (np.isfinite([margin, min_margin]).all() and margin >= 0 and min_margin >= 0):
        raise InputError(f"margins must be finite and not negative, not {margin} and {min_margin}")
    indices = list(range(outputs.shape[2])) if bounded is None else list(bounded)
    if not indices or not all(0 <= index < outputs.shape[2] for index in indices):
        raise InputError(f"outputs are numbered from 0 to {outputs.shape[2] - 1}, not {indices}")
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
