"""Recorded episodes: commanded poses, measured poses and wrenches of every control step."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from guiderail.diagrams.envs.trace import EpisodeTrace
from guiderail.models.common.errors import InputError
from guiderail.models.common.transforms import POSE_SIZE, WRENCH_SIZE
from guiderail.tools.evaluation.step_log import read_step_log

MAX_EPISODES = 20
MIN_STEPS = 50  # smallest number of control steps of an episode
MAX_DEVIATION = 0.003  # largest difference between recorded and simulated commands of the same motion [m]
SIGNALS = {"desired_pose": POSE_SIZE, "pose": POSE_SIZE, "wrench": WRENCH_SIZE}


@dataclass(frozen=True)
class Episode:
    """Recording of an episode of n control steps."""

    desired: np.ndarray  # commanded poses, (n, 6) [m, rad]
    pose: np.ndarray  # measured poses, (n, 6) [m, rad]
    wrench: np.ndarray  # measured wrenches, (n, 6) [N, Nm]

    def __len__(self) -> int:
        """Return the number of control steps."""
        return len(self.desired)

    @classmethod
    def of_trace(cls, trace: EpisodeTrace) -> Episode:
        """Return a copy of an environment's trace, in single precision."""
        signals = (trace.commanded, trace.measured, trace.signals["wrench"])
        return cls(*(np.array(values, dtype=np.float32) for values in signals))


def load_recordings(folder: Path, nominal: np.ndarray | None = None) -> list[Episode]:
    """Return the recorded episodes of a folder, in order.

    Args:
        folder: Folder with a step log (`episode-*.parquet`), as `evaluate --steps` writes it, or with a folder `steps`
            that has it, such as a run. Only the first `MAX_EPISODES` episodes are used.
        nominal: Commanded poses (N, 6) of every episode if they are always the same, as those of a probing motion.

    Raises:
        InputError: If there is no recording, one is damaged or too short, a signal is missing or not finite, or the
            commanded motion is not the nominal one.
    """
    if not folder.is_dir():
        raise InputError(f"there is no folder {folder}: record episodes with guiderail evaluate … --steps {folder}")
    if not any(folder.glob("episode-*.parquet")) and (folder / "steps").is_dir():
        folder = folder / "steps"
    if not any(folder.glob("episode-*.parquet")):
        raise InputError(f"{folder} has no recorded episode: record some with guiderail evaluate … --steps DIR")
    table = read_step_log(folder)
    columns = {name: [f"{name}_{index}" for index in range(size)] for name, size in SIGNALS.items()}
    if missing := [name for name, group in columns.items() if not {*group} <= {*table}]:
        raise InputError(
            f"the recordings in {folder} have no {missing[0]} of six components: record the task of the run"
        )
    episodes = []
    for number, rows in list(table.groupby("episode", sort=True))[:MAX_EPISODES]:
        episode = Episode(*(rows[group].to_numpy(float) for group in columns.values()))
        _check(episode, f"episode {number} in {folder}", nominal)
        episodes.append(episode)
    return episodes


def _check(episode: Episode, name: str, nominal: np.ndarray | None) -> None:
    """Raise an InputError if an episode cannot be compared with simulated ones."""
    if not all(np.isfinite(values).all() for values in (episode.desired, episode.pose, episode.wrench)):
        raise InputError(f"{name} has values that are not finite: record it again")
    if len(episode) < MIN_STEPS:
        raise InputError(
            f"{name} has {len(episode)} control steps, and at least {MIN_STEPS} are needed: record it again"
        )
    if nominal is not None:
        steps = min(len(episode), len(nominal))
        error = np.abs(episode.desired[:steps, :3] - nominal[:steps, :3]).max()
        if error > MAX_DEVIATION:
            raise InputError(
                f"{name} is another motion than the probing motion: their commands differ by {1e3 * error:.1f} mm; "
                "record the probing motion, or leave --probe out"
            )
