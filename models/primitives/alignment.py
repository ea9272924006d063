"""Alignment of demonstrations in time, so that the same event happens at the same phase in all of them."""

import numpy as np

from guiderail.models.common.errors import InputError
from guiderail.models.primitives.demonstrations import Demonstrations


def align_demonstrations(demonstrations: Demonstrations, band: float = 0.2) -> Demonstrations:
    """Warp demonstrations in time onto the one of median duration, by dynamic time warping.

    The cost of a match is the distance of the outputs, each divided by its standard deviation over all demonstrations.
    The path of a demonstration is monotonic; a sample of the first that matches several of the second gets their mean.

    Args:
        demonstrations: Demonstrations of one motion.
        band: Largest shift, as a share of the duration, in (0, 1].

    Returns:
        Demonstrations on one clock.

    Raises:
        InputError: If the band is out of range.
    """
    if not 0.0 < band <= 1.0:
        raise InputError(f"the band of an alignment is a share of the duration in (0, 1], not {band}")
    common = demonstrations.resampled()
    durations = [t[-1] - t[0] for t in demonstrations.times]
    target = int(np.argsort(durations, kind="stable")[len(durations) // 2])
    stacked = np.stack(common.outputs)
    scale = stacked.std(axis=(0, 1))
    scaled = stacked / np.where(scale > 0.0, scale, 1.0)
    width = max(1, round(band * stacked.shape[1]))
    aligned = []
    for index, outputs in enumerate(stacked):
        if index == target:
            aligned.append(outputs)
            continue
        matches = _warping_path(scaled[target], scaled[index], width)
        aligned.append(np.array([outputs[first : last + 1].mean(axis=0) for first, last in matches]))
    return Demonstrations(common.times[0], aligned, demonstrations.names)


def _warping_path(target: np.ndarray, other: np.ndarray, width: int) -> list[tuple[int, int]]:
    """Return the first and the last sample of `other` (N, O) that match each sample of `target` (N, O)."""
    size = len(target)
    cost = np.full((size + 1, size + 1), np.inf)
    cost[0, 0] = 0.0
    for i in range(size):
        low, high = max(0, i - width), min(size, i + width + 1)
        distances = np.linalg.norm(other[low:high] - target[i], axis=1)
        for j, distance in zip(range(low, high), distances.tolist(), strict=True):
            cost[i + 1, j + 1] = distance + min(cost[i, j], cost[i, j + 1], cost[i + 1, j])
    matches = [(size, -1)] * size
    i, j = size, size
    while i > 0 and j > 0:
        first, last = matches[i - 1]
        matches[i - 1] = min(first, j - 1), max(last, j - 1)
        steps = ((i - 1, j - 1), (i - 1, j), (i, j - 1))
        i, j = min(steps, key=lambda at: cost[at])
    return matches
