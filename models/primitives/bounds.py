"""Bounds from demonstrations: in each phase what was shown there, and a margin (the constraints of problem 4.5)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from guiderail.models.common.errors import InputError
from guiderail.models.primitives.demonstrations import Demonstrations


@dataclass(frozen=True)
class DemonstratedBounds:
    """Lower and upper bounds of each output in each phase.

    Attributes:
        names: of the outputs (O,).
        phases: where each begins, (K,), from 0 to 1.
        lower, upper: (K, O), infinite where an output is free.
        fastest: the largest change of each output in a second that was shown, (O,).
    """

    names: tuple[str, ...]
    phases: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    fastest: np.ndarray

    def holds(self, outputs: np.ndarray) -> np.ndarray:
        """Whether each of N samples (N, O) of a whole motion is inside, (N,)."""
        phase = np.searchsorted(self.phases, np.linspace(0.0, 1.0, len(outputs)), side="right") - 1
        return np.all((outputs >= self.lower[phase]) & (outputs <= self.upper[phase]), axis=1)


def demonstrated_bounds(
    demonstrations: Demonstrations,
    phases: int = 1,
    margin: float = 0.1,
    least: float = 0.0,
    bounded: Sequence[int] | None = None,
) -> DemonstratedBounds:
    """Bounds that every demonstration keeps.

    A phase's range takes in the samples at its borders, so that who goes from one phase to the next finds a way.

    Args:
        demonstrations: at least one.
        phases: K, parts of the motion of equal length.
        margin: on each side, as a part of the range of the phase.
        least: on each side at least [unit of the output].
        bounded: numbers of the outputs that are; all unless given.

    Raises:
        InputError: if an argument is out of range.
    """
    common = demonstrations.resampled()
    outputs = np.stack(common.outputs)
    steps = outputs.shape[1]
    if not 1 <= phases <= steps // 2:
        raise InputError(f"there are from 1 to {steps // 2} phases in {steps} samples, not {phases}")
    if not (np.isfinite([margin, least]).all() and margin >= 0 and least >= 0):
        raise InputError(f"a margin is no less than zero, not {margin} and {least}")
    chosen = list(range(outputs.shape[2])) if bounded is None else list(bounded)
    if not chosen or not all(0 <= one < outputs.shape[2] for one in chosen):
        raise InputError(f"outputs are numbered from 0 to {outputs.shape[2] - 1}, not {chosen}")
    starts = np.arange(phases) / phases
    lower, upper = (np.full((phases, outputs.shape[2]), inf) for inf in (-np.inf, np.inf))
    # Between the common clock's instants a sample of one's own may lie further out.
    curves = [(np.linspace(0.0, 1.0, steps), y) for y in outputs]
    curves += [((t - t[0]) / (t[-1] - t[0]), y) for t, y in _as_shown(demonstrations)]
    border = 1.5 / (steps - 1)
    for k, start in enumerate(starts):
        end = start + 1.0 / phases
        inside = np.concatenate([y[(at >= start - border) & (at <= end + border)] for at, y in curves])
        low, high = inside.min(axis=0), inside.max(axis=0)
        room = np.maximum(margin * (high - low), least)
        lower[k, chosen], upper[k, chosen] = (low - room)[chosen], (high + room)[chosen]
    changes = [np.abs(np.diff(y, axis=0) / np.diff(t)[:, None]).max(axis=0) for t, y in _as_shown(demonstrations)]
    return DemonstratedBounds(demonstrations.names, starts, lower, upper, np.max(changes, axis=0))


def _as_shown(demonstrations: Demonstrations) -> list[tuple[np.ndarray, np.ndarray]]:
    return list(zip(demonstrations.times, demonstrations.outputs, strict=True))
