"""How smooth a motion is: measures whose unit or duration does not decide."""

import numpy as np


def log_dimensionless_jerk(positions: np.ndarray, period: float) -> float:
    """Log dimensionless jerk of `positions` (N, O), higher (less negative) is smoother.

    −ln(T³/v² ∫|jerk|² dt), T the duration and v the largest speed: the same for the same motion at another tempo or in
    another unit. −inf where nothing moves, or fewer than four positions are given.
    """
    positions = np.asarray(positions, dtype=float)
    if len(positions) < 4:
        return -np.inf
    jerk = np.diff(positions, 3, axis=0) / period**3
    peak = np.max(np.linalg.norm(np.diff(positions, axis=0), axis=1)) / period
    duration = (len(positions) - 1) * period
    if not peak > 0:
        return -np.inf
    return float(-np.log(duration**3 / peak**2 * np.sum(jerk**2) * period))


def spectral_arc_length(
    positions: np.ndarray, period: float, cutoff: float = 10.0, threshold: float = 0.05, padding: int = 4
) -> float:
    """SPARC of `positions` (N, O) (Balasubramanian et al., 2015): higher (less negative) is smoother.

    The length of the curve that the normalized spectrum of the speed draws, up to the last frequency below `cutoff`
    [Hz] at which it is above `threshold`.
    """
    speed = np.linalg.norm(np.diff(np.asarray(positions, dtype=float), axis=0), axis=1) / period
    if not len(speed) or not np.max(speed) > 0:
        return 0.0
    points = int(2 ** (np.ceil(np.log2(len(speed))) + padding))
    frequencies = np.arange(points) / (points * period)
    spectrum = np.abs(np.fft.fft(speed, points))
    spectrum /= spectrum.max()
    kept = np.flatnonzero((frequencies <= min(cutoff, 0.5 / period)) & (spectrum >= threshold))
    frequencies, spectrum = frequencies[: kept[-1] + 1], spectrum[: kept[-1] + 1]
    if len(frequencies) < 2:
        return 0.0
    across = np.diff(frequencies) / (frequencies[-1] - frequencies[0])
    return float(-np.sum(np.hypot(across, np.diff(spectrum))))
