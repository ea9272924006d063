"""Ways to explore: what a policy that knows nothing yet does, one action a control step.

Every one of them has the same root mean square (that of uniform numbers in [−1, 1]), the same limits and a random
generator of its own, so that what they stir up differs in its shape alone.
"""

from collections.abc import Callable, Iterator
from typing import Any

import colorednoise
import numpy as np
from scipy import signal

from guiderail.models.common.errors import InputError
from guiderail.tools.evaluation.rollout import PolicyFn

RMS = 1.0 / np.sqrt(3.0)
FEATURES = 64  # of gSDE: as wide as a small policy's last layer


def white(rng: np.random.Generator, steps: int, size: int, action_repeat: int = 1) -> np.ndarray:
    """Uniform in [−1, 1], each held for `action_repeat` control steps (action repeat)."""
    return np.repeat(rng.uniform(-1.0, 1.0, (-(-steps // action_repeat), size)), action_repeat, axis=0)[:steps]


def pink(rng: np.random.Generator, steps: int, size: int) -> np.ndarray:
    """Coloured noise with a power of 1/f (Eberhard et al., 2023), for a whole episode at once."""
    return colorednoise.powerlaw_psd_gaussian(1.0, (size, steps), random_state=rng).T


def ornstein_uhlenbeck(rng: np.random.Generator, steps: int, size: int, correlation: float = 15.0) -> np.ndarray:
    """Noise that forgets itself after `correlation` control steps (θ dt = 1/15; DDPG's own is 0.15)."""
    keep = np.exp(-1.0 / correlation)
    return _filtered(rng, steps, size, [np.sqrt(1.0 - keep**2)], [1.0, -keep])


def low_pass(rng: np.random.Generator, steps: int, size: int, cutoff: float = 1.0, period: float = 0.02) -> np.ndarray:
    """White noise behind a second-order Butterworth filter of `cutoff` Hz."""
    return _filtered(rng, steps, size, *signal.butter(2, cutoff, fs=1.0 / period))


def _filtered(rng: np.random.Generator, steps: int, size: int, numerator: Any, denominator: Any) -> np.ndarray:
    """White noise behind a filter, after it has forgotten where it began."""
    lead = 300
    return signal.lfilter(numerator, denominator, rng.normal(size=(lead + steps, size)), axis=0)[lead:]


def open_loop(
    make: Callable[..., np.ndarray], rng: np.random.Generator, steps: int, size: int, **arguments: Any
) -> PolicyFn:
    """Actions made for an episode in advance; they do not look at what is observed.

    Raises:
        InputError: if there is nothing to make.
    """
    if steps < 1 or size < 1:
        raise InputError(f"an exploration needs at least one step and one action, not {steps} and {size}")
    sequence: Iterator[np.ndarray] = iter(_with_rms(make(rng, steps, size, **arguments)))
    return lambda observation: next(sequence)


def state_dependent(rng: np.random.Generator, steps: int, size: int, interval: int) -> PolicyFn:
    """gSDE (Raffin et al., 2022): noise that is linear in features of the state, sampled anew every `interval` steps.

    The features are those of an make_baseline network: rectified, not learned.
    """
    mix: np.ndarray | None = None
    weights = np.zeros((0, 0))
    count = 0

    def act(observation: np.ndarray) -> np.ndarray:
        nonlocal mix, weights, count
        if mix is None:
            mix = rng.normal(size=(FEATURES, len(observation))) / np.sqrt(len(observation))
        features = np.tanh(mix @ observation)
        if count % interval == 0:
            weights = rng.normal(size=(size, FEATURES))
        count += 1
        # Divided by what the noise's deviation is in this very state: gSDE's own scale would depend on the network.
        return np.clip(RMS * weights @ features / np.linalg.norm(features), -1.0, 1.0)

    return act


def _with_rms(sequence: np.ndarray) -> np.ndarray:
    """Scaled so that, after clipping to [−1, 1], every action has the common root mean square."""
    scale = np.full(sequence.shape[1], RMS) / np.maximum(np.sqrt(np.mean(sequence**2, axis=0)), 1e-12)
    for _ in range(20):
        clipped = np.clip(sequence * scale, -1.0, 1.0)
        scale *= RMS / np.sqrt(np.mean(clipped**2, axis=0))
    return np.clip(sequence * scale, -1.0, 1.0)
