"""Where things really are: offsets that a reset draws, hidden for a run or anew every episode."""

from __future__ import annotations

from abc import ABC, abstractmethod
from functools import cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field, field_validator

from guiderail.diagrams.envs.options import Numbers, Options
from guiderail.diagrams.stations.station import CONTROL_PERIOD
from guiderail.models.common.errors import InputError
from guiderail.models.common.poses import POSE_SIZE
from guiderail.models.common.units import MM
from guiderail.models.primitives import Demonstrations, ReferenceTrajectory

LARGEST_OFFSET = 4.0 * MM  # farther away a plug no longer stands on the rim of what it belongs in


class FixtureOffsetOptions(Options):
    """Of a task whose fixed part is not where it should be."""

    fixture_offset: Literal["per_run", "per_episode", "none"] = Field(
        "per_run", description="where the fixed part may be: one place for a run, one for each episode, or known"
    )
    offset_range: Numbers | None = Field(
        None,
        min_length=2,
        max_length=2,
        description="least and greatest distance of the fixed part from where it should be [m], the uncertainty's own",
    )

    @field_validator("offset_range")
    @classmethod
    def _check_range(cls, value: tuple[float, ...] | None) -> tuple[float, ...] | None:
        if value is not None and not 0.0 <= value[0] <= value[1] <= LARGEST_OFFSET:
            raise ValueError(f"give two distances from 0 to {LARGEST_OFFSET} m, the smaller one first")
        return value


def reference_of_file(path: Path, components: int | None, floor: tuple[float, ...]) -> ReferenceTrajectory:
    """What a file's demonstrations have in common, as long as they last on average.

    Args:
        path: .npz or .csv, poses (N, 6) in the target frame.
        components: of their mixture; by information criterion unless given.
        floor: standard deviation (6,) that a hand has anyway.

    Raises:
        InputError: if there is no such file, or it holds no demonstrations of a pose.
    """
    if not path.is_file():
        raise InputError(f"there is no file {path}: name demonstrations, such as guiderail teach makes")
    return _fitted(path, path.stat().st_mtime_ns, components, floor)


@cache
def _fitted(path: Path, changed: int, components: int | None, floor: tuple[float, ...]) -> ReferenceTrajectory:
    """Fitted once a process and version."""
    demonstrations = Demonstrations.load(path)
    if demonstrations.num_outputs != POSE_SIZE:
        raise InputError(
            f"{path} has {demonstrations.num_outputs} outputs: an insertion needs the six of a pose, "
            "[x y z Rz Ry Rx] in the target frame"
        )
    duration = float(np.mean([t[-1] - t[0] for t in demonstrations.times]))
    num_steps = round(duration / CONTROL_PERIOD) + 1
    fitted = ReferenceTrajectory.from_demonstrations(
        demonstrations, components=components, num_steps=num_steps, floor=np.array(floor)
    )
    return ReferenceTrajectory(CONTROL_PERIOD * np.arange(num_steps), fitted.means, fitted.covariances)


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
