"""Exploration noise of an untrained policy: one action per control step.

All kinds have the root mean square of uniform numbers in [−1, 1], the same limits and separate random generators. The
excited motions differ only by the shape of the noise.
"""

from collections.abc import Callable, Iterator
from typing import Any

import colorednoise
import numpy as np
from scipy import signal

from guiderail.models.common.errors import InputError
from guiderail.tools.evaluation.episode import PolicyFn

RMS = 1.0 / np.sqrt(3.0)
FEATURES = 64  # features of gSDE, as many as the last layer of a small policy has
WARM_UP = 300  # filtered samples that are discarded, so that the filter's initial state has decayed


def uniform(rng: np.random.Generator, steps: int, size: int, action_repeat: int = 1) -> np.ndarray:
    """Sample uniform actions in [−1, 1], each repeated for `action_repeat` control steps; (steps, size)."""
    return np.repeat(rng.uniform(-1.0, 1.0, (-(-steps // action_repeat), size)), action_repeat, axis=0)[:steps]


def pink(rng: np.random.Generator, steps: int, size: int) -> np.ndarray:
    """Sample noise with a power spectrum of 1/f (Eberhard et al., 2023); (steps, size)."""
    return colorednoise.powerlaw_psd_gaussian(1.0, (size, steps), random_state=rng).T


def ornstein_uhlenbeck(rng: np.random.Generator, steps: int, size: int, correlation: float = 15.0) -> np.ndarray:
    """Sample an Ornstein–Uhlenbeck process; (steps, size).

    Args:
        rng: Random generator.
        steps: Number of control steps.
        size: Number of entries of an action.
        correlation: Correlation time in control steps, 1/(θ dt).
    """
    decay = np.exp(-1.0 / correlation)
    return _filtered(rng, steps, size, [np.sqrt(1.0 - decay**2)], [1.0, -decay])


def low_pass(rng: np.random.Generator, steps: int, size: int, cutoff: float = 1.0, period: float = 0.02) -> np.ndarray:
    """Sample white noise through a second-order Butterworth filter; (steps, size).

    Args:
        rng: Random generator.
        steps: Number of control steps.
        size: Number of entries of an action.
        cutoff: Cutoff frequency [Hz].
        period: Control period [s].
    """
    return _filtered(rng, steps, size, *signal.butter(2, cutoff, fs=1.0 / period))


def _filtered(rng: np.random.Generator, steps: int, size: int, numerator: Any, denominator: Any) -> np.ndarray:
    return signal.lfilter(numerator, denominator, rng.normal(size=(WARM_UP + steps, size)), axis=0)[WARM_UP:]


def open_loop(
    sample: Callable[..., np.ndarray], rng: np.random.Generator, steps: int, size: int, **arguments: Any
) -> PolicyFn:
    """Return a policy that plays a sequence sampled for the whole episode, independent of observations.

    Args:
        sample: Sampler of this module, of (steps, size) numbers.
        rng: Random generator.
        steps: Number of control steps, at least 1.
        size: Number of entries of an action, at least 1.
        arguments: Further arguments of the sampler.

    Raises:
        InputError: If `steps` or `size` is out of range.
    """
    if steps < 1 or size < 1:
        raise InputError(f"an exploration needs at least one step and one action, not {steps} and {size}")
    sequence: Iterator[np.ndarray] = iter(_with_rms(sample(rng, steps, size, **arguments)))
    return lambda observation: next(sequence)


def state_dependent(rng: np.random.Generator, steps: int, size: int, interval: int) -> PolicyFn:
    """Return a policy with gSDE noise (Raffin et al., 2022), linear in random features of the observation.

    Args:
        rng: Random generator.
        steps: Ignored; the noise has no fixed length.
        size: Number of entries of an action.
        interval: Control steps after which the linear map is sampled again.
    """
    projection: np.ndarray | None = None
    weights = np.zeros((0, 0))
    count = 0

    def act(observation: np.ndarray) -> np.ndarray:
        nonlocal projection, weights, count
        if projection is None:
            projection = rng.normal(size=(FEATURES, len(observation))) / np.sqrt(len(observation))
        features = np.tanh(projection @ observation)
        if count % interval == 0:
            weights = rng.normal(size=(size, FEATURES))
        count += 1
        # Normalize by the noise's standard deviation in this state, because gSDE's own scale depends on the network.
        return np.clip(RMS * weights @ features / max(float(np.linalg.norm(features)), 1e-12), -1.0, 1.0)

    return act


def _with_rms(sequence: np.ndarray) -> np.ndarray:
    """Scale a sequence (steps, size) so that every column has the common RMS after clipping to [−1, 1]."""
    scale = np.full(sequence.shape[1], RMS) / np.maximum(np.sqrt(np.mean(sequence**2, axis=0)), 1e-12)
    for _ in range(20):
        clipped = np.clip(sequence * scale, -1.0, 1.0)
        scale *= RMS / np.sqrt(np.mean(clipped**2, axis=0))
    return np.clip(sequence * scale, -1.0, 1.0)
