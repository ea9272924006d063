"""Where things really are: offsets that a reset draws, hidden for a run or anew every episode."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any

import numpy as np

from guiderail.diagrams.tasks.held_out import episode_stream
from guiderail.models.errors import InputError

MM = 1e-3
OPTIONS = ("held_out", "offset", "new_run")


class HiddenOffsets(ABC):
    """Draws, at every reset, where a fixture and a workpiece really are: offsets (2,) [m] in the target frame's xy.

    A run begins with the first reset, and with every one that has the option `new_run`. Other options: `held_out` draws
    from a stream that training never draws from, with what the run has hidden; `offset` (x, y) [m] says where instead.
    """

    task: str
    kinds: tuple[str, ...]

    def __init__(self, kind: str):
        """
        Args:
            kind: one of `kinds`.

        Raises:
            InputError: if there is no such kind.
        """
        if kind not in self.kinds:
            names = ", ".join(f"'{known}'" for known in self.kinds[:-1])
            raise InputError(f"there is no uncertainty '{kind}': use {names} or '{self.kinds[-1]}'")
        self.kind = kind
        self._run: Any = None

    def draw(self, rng: np.random.Generator, options: Mapping[str, Any]) -> tuple[np.ndarray, np.ndarray]:
        """Offsets (2,) [m] of the fixture and of the workpiece in the tool."""
        unknown = set(options) - set(OPTIONS)
        if unknown:
            raise InputError(f"{self.task} knows no reset option {sorted(unknown)}: it knows {', '.join(OPTIONS)}")
        # Every reset draws the same numbers, used or not, so that a seed means the same at the first reset and later.
        hidden = self._draw_run(rng)
        episode = episode_stream(rng, bool(options.get("held_out")))
        if self._run is None or options.get("new_run"):
            self._run = hidden
        if "offset" in options:
            return self._given(checked_offset(options["offset"]))
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


def in_ring(rng: np.random.Generator, inner: float, outer: float) -> np.ndarray:
    """A point (2,) whose density is the same everywhere between two circles."""
    radius = np.sqrt(rng.uniform(inner**2, outer**2))
    angle = rng.uniform(0.0, 2.0 * np.pi)
    return radius * np.array([np.cos(angle), np.sin(angle)])


def checked_offset(offset: Any) -> np.ndarray:
    """The option `offset` as (2,).

    Raises:
        InputError: if it is anything else than two finite numbers.
    """
    try:
        offset = np.array(offset, dtype=float)
    except (TypeError, ValueError):
        offset = np.empty(0)
    if offset.shape != (2,) or not np.isfinite(offset).all():
        raise InputError(f"the reset option 'offset' is (x, y) in metres, not {offset}")
    return offset
