"""Alignment of demonstrations in time."""

import numpy as np

from guiderail.models.common.arrays import as_number
from guiderail.models.common.errors import InputError
from guiderail.models.primitives import Demonstrations

MAX_ALIGNED_SAMPLES = 10_000  # largest number of samples of an alignment; memory and time grow with its square


def align_demonstrations(demonstrations: Demonstrations, band: float = 0.2) -> Demonstrations:
    """Warp demonstrations in time onto the demonstration of median duration, by dynamic time warping.

    The cost of a match is the distance of the samples, with each output divided by its standard deviation over all
    demonstrations. The warping path is monotonic. The warped output at each step is the mean of the matched samples.

    Args:
        demonstrations: Demonstrations of one motion.
        band: Largest shift in time, as a share of the duration, in (0, 1].

    Returns:
        Demonstrations on one clock.

    Raises:
        InputError: If the band is out of range, or a demonstration has more than `MAX_ALIGNED_SAMPLES` samples.
    """
    if not 0.0 < as_number(band, "band") <= 1.0:
        raise InputError(f"the band of an alignment is a share of the duration in (0, 1], not {band}")
    common = demonstrations.resampled()
    if len(common.times[0]) > MAX_ALIGNED_SAMPLES:
        raise InputError(
            f"demonstrations of {len(common.times[0]):,} samples can't be aligned, at most {MAX_ALIGNED_SAMPLES:,}: "
            "resample them first, for example with demonstrations.resampled(1000)"
        )
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
    # Only two rows of the cost matrix are stored, and for each match in the band its predecessor: 0 for the previous
    # samples of both, 1 for the previous sample of `target` alone, 2 for the previous sample of `other` alone.
    predecessors = np.zeros((size, min(size, 2 * width + 1)), dtype=np.uint8)
    last = [0.0] + [np.inf] * size
    for i in range(size):
        low, high = max(0, i - width), min(size, i + width + 1)
        distances = np.linalg.norm(other[low:high] - target[i], axis=1)
        costs, choices = [np.inf] * (size + 1), []
        for j, distance in zip(range(low, high), distances.tolist(), strict=True):
            cost, choice = last[j], 0
            if last[j + 1] < cost:
                cost, choice = last[j + 1], 1
            if costs[j] < cost:
                cost, choice = costs[j], 2
            costs[j + 1] = distance + cost
            choices.append(choice)
        predecessors[i, : high - low] = choices
        last = costs
    matches = [(size, -1)] * size
    i, j = size - 1, size - 1
    while i >= 0 and j >= 0:
        first, end = matches[i]
        matches[i] = min(first, j), max(end, j)
        choice = predecessors[i, j - max(0, i - width)]
        i, j = i - (choice != 2), j - (choice != 1)
    return matches
