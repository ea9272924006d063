"""Where things really are: offsets that a reset draws, hidden for a run or anew every episode."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import numpy as np


class HiddenOffsets(ABC):
    """Draws, at every reset, where a fixture and a workpiece really are: offsets (2,) [m] in the target frame's xy.

    A run begins with the first reset, and with every one that has the option `new_run`. Other options: `held_out` draws
    from a stream that training never draws from, with what the run has hidden; `offset` (x, y) [m] says where instead.
    """

    def __init__(self) -> None:
        self._run: Any = None

    def draw(self, rng: np.random.Generator, options: Any) -> tuple[np.ndarray, np.ndarray]:
        """Offsets (2,) [m] of the fixture and of the workpiece in the tool; `options` are an `InsertionReset`."""
        # Every reset draws the same numbers, used or not, so that a seed means the same at the first reset and later.
        hidden = self._draw_run(rng)
        episode = episode_stream(rng, options.held_out)
        if self._run is None or options.new_run:
            self._run = hidden
        if options.offset is not None:
            return self._given(np.array(options.offset))
        return self._draw_episode(episode, self._run)

    @abstractmethod
    def _draw_run(self, rng: np.random.Generator) -> Any:
        """What stays hidden for a run."""

    @abstractmethod
    def _draw_episode(self, rng: np.random.Generator, run: Any) -> tuple[np.ndarray, np.ndarray]:
        """The offsets of an episode of a run."""

    @abstractmethod
    def _given(self, offset: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The offsets that the option `offset` stands for."""


# No seed of a training run leads to this stream.
_HELD_OUT_STREAM = 0x8E1D


def episode_stream(rng: np.random.Generator, held_out: bool) -> np.random.Generator:
    """The generator that an episode's conditions are drawn from: training's, or one that only evaluation has.

    It takes one number from `rng` whichever it is, so that a seed means the same at the first reset and later.
    """
    return np.random.default_rng([int(rng.integers(2**62)), _HELD_OUT_STREAM if held_out else 0])


def in_ring(rng: np.random.Generator, inner: float, outer: float) -> np.ndarray:
    """A point (2,) whose density is the same everywhere between two circles."""
    radius = np.sqrt(rng.uniform(inner**2, outer**2))
    angle = rng.uniform(0.0, 2.0 * np.pi)
    return radius * np.array([np.cos(angle), np.sin(angle)])
