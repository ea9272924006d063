"""Synthetic handwriting: sharp corners, straight strokes, loops, and lower speed at corners."""

import numpy as np

from guiderail.models.primitives import Demonstrations

# Start point and strokes on a unit square: ("line", x, y) is a straight stroke to a point,
# ("arc", x, y, degrees) an arc around a center.
LETTERS = {
    "N": [(0, 0), ("line", 0, 1), ("line", 0.7, 0), ("line", 0.7, 1)],
    "Z": [(0, 1), ("line", 0.8, 1), ("line", 0, 0), ("line", 0.8, 0)],
    "M": [(0, 0), ("line", 0.1, 1), ("line", 0.45, 0.3), ("line", 0.8, 1), ("line", 0.9, 0)],
    "e": [(0.1, 0.5), ("line", 0.8, 0.5), ("arc", 0.45, 0.5, 310)],
    "l": [(0, 0.1), ("line", 0.35, 0.6), ("arc", 0.25, 0.75, 250), ("line", 0.2, 0.1), ("arc", 0.3, 0.1, 150)],
    "B": [(0, 0), ("line", 0, 1), ("line", 0.3, 1), ("arc", 0.3, 0.75, -180), ("line", 0, 0.5)]
    + [("line", 0.35, 0.5), ("arc", 0.35, 0.25, -180), ("line", 0, 0)],
}


def path(letter: str, points: int = 2000) -> np.ndarray:
    """Return positions, (points, 2), evenly spaced along the strokes of a letter."""
    strokes = LETTERS[letter]
    corners = [np.array(strokes[0], dtype=float)]
    for kind, x, y, *angle in strokes[1:]:
        if kind == "line":
            corners.append(np.array([x, y], dtype=float))
        else:
            center, start = np.array([x, y]), corners[-1]
            angles = np.radians(np.linspace(0, angle[0], 60)[1:])
            radius = start - center
            corners += [center + radius @ np.array([[np.cos(a), np.sin(a)], [-np.sin(a), np.cos(a)]]) for a in angles]
    corners = np.array(corners)
    lengths = np.r_[0, np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))]
    arc_lengths = np.linspace(0, lengths[-1], points)
    return np.column_stack([np.interp(arc_lengths, lengths, column) for column in corners.T])


def write_letter(
    letter: str, seed: int = 0, count: int = 6, steps: int = 200, spread: float = 0.03, size: float = 1.0, offset=(0, 0)
):
    """Return demonstrations of a letter with random shear, scale, waves and timing.

    Args:
        letter: One of `LETTERS`.
        seed: Seed of the variations.
        count: Number of demonstrations.
        steps: Number of points of each demonstration.
        spread: Standard deviation of the variations, relative to the size of the letter.
        size: Size of the letter, in any unit.
        offset: Position of the origin of the letter, (2,), in the same unit.
    """
    rng = np.random.default_rng(seed)
    template = path(letter)
    share = np.linspace(0, 1, len(template))
    # The speed is lower in curves.
    heading = np.unwrap(np.arctan2(*np.gradient(template, axis=0).T[::-1]))
    curvature = np.convolve(np.abs(np.gradient(heading)), np.ones(60), mode="same")
    clock = np.cumsum(1 + 2 * np.minimum(curvature, 1.5))
    clock = (clock - clock[0]) / (clock[-1] - clock[0])
    outputs = []
    for _ in range(count):
        waves = [
            np.sin(np.pi * k * share + rng.uniform(0, 6.28))[:, None] * rng.standard_normal(2) / k for k in (1, 2, 3)
        ]
        shape = template @ (np.eye(2) + spread * rng.standard_normal((2, 2))) + spread * rng.standard_normal(2)
        shape = shape + 0.4 * spread * np.sum(waves, axis=0)
        phase = clock + 0.3 * spread * np.sin(np.pi * clock) * rng.standard_normal()
        phase = (phase - phase[0]) / (phase[-1] - phase[0])
        t = np.linspace(0, 1, steps)
        outputs.append(np.column_stack([np.interp(t, phase, column) for column in shape.T]) * size + np.asarray(offset))
    return Demonstrations(np.linspace(0, 4, steps), outputs, ("x", "y"))


def make_correlated(seed: int = 0, count: int = 6, steps: int = 200, correlation: float = 0.98) -> Demonstrations:
    """Return demonstrations of three outputs whose deviations from the mean have the given correlation."""
    rng = np.random.default_rng(seed)
    t = np.linspace(0, 2, steps)
    mean = np.column_stack([np.sin(2 * t), np.abs(t - 1), np.cos(3 * t)])
    mix = np.linalg.cholesky(correlation * np.ones((3, 3)) + (1 - correlation) * np.eye(3))
    outputs = []
    for _ in range(count):
        waves = np.stack([np.sin(k * t + p) / k for k, p in zip((1, 2, 3), rng.uniform(0, 6.28, 3), strict=True)])
        deviation = (rng.standard_normal((3, 3)) @ waves + rng.standard_normal((3, 1))).T @ mix.T
        outputs.append(mean + 0.03 * deviation)
    return Demonstrations(t, outputs)


def share_within_deviation(demonstrations: Demonstrations, motion: np.ndarray) -> float:
    """Compute the share of steps with all outputs within one standard deviation of the demonstrations' mean."""
    outputs = np.stack(demonstrations.outputs)
    return float((np.abs(motion - outputs.mean(axis=0)) <= outputs.std(axis=0, ddof=1)).all(axis=1).mean())
