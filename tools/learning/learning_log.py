"""Learning log: returns, losses, values and entropy coefficients in the formats of Stable-Baselines3's logger."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from guiderail.models.common.errors import InputError, brief
from guiderail.models.common.registry import did_you_mean

FORMATS = ("tensorboard", "csv", "json", "log", "stdout")
# Columns of an episode's row that are logged, by their names in the log.
EPISODE = {
    "return": "rollout/return",
    "success": "rollout/success",
    "steps": "rollout/steps",
    "peak_force": "rollout/peak_force",
    "max_commanded_violation": "rollout/max_commanded_violation",
}


def check_formats(formats: str | Sequence[str]) -> tuple[str, ...]:
    """Return the names of log formats as a tuple.

    Raises:
        InputError: If a format is unknown, or its package is not installed.
    """
    names = (formats,) if isinstance(formats, str) else tuple(formats)
    for name in names:
        if name not in FORMATS:
            raise InputError(f"there is no log format {brief(name)}: {did_you_mean(name, FORMATS)}")
    if "tensorboard" in names and find_spec("tensorboard") is None:
        raise InputError("the log format tensorboard needs TensorBoard: pip install 'guiderail[tensorboard]'")
    return names


class LearningLog:
    """Log with one entry per episode, written next to a run; does nothing without formats.

    An entry has columns of the episode's row and the metrics of the learner, at the run's number of control steps.
    """

    def __init__(self, folder: Path, formats: str | Sequence[str] = ()):
        """Construct the log; files are opened at the first entry.

        Args:
            folder: Folder of the files.
            formats: Names of formats: tensorboard, csv, json, log or stdout.

        Raises:
            InputError: As `check_formats`.
        """
        self._folder, self._formats = folder, check_formats(formats)
        self._logger: Any = None

    def record(self, rows: Sequence[Mapping[str, Any]], metrics: Callable[[], Mapping[str, float]]) -> None:
        """Write the entry of the last episode.

        Args:
            rows: Rows of all episodes.
            metrics: Returns the metrics of the learner.
        """
        if not self._formats:
            return
        row = rows[-1]
        if self._logger is None:
            from stable_baselines3.common.logger import Logger, make_output_format  # PyTorch takes seconds

            # A resumed run must not overwrite the files of its first part.
            suffix = f"-from-{row['episode']}" if row["episode"] else ""
            self._folder.mkdir(parents=True, exist_ok=True)
            outputs = [make_output_format(name, str(self._folder), suffix) for name in self._formats]
            self._logger = Logger(str(self._folder), outputs)
        for column, name in EPISODE.items():
            if column in row:
                self._logger.record(name, row[column])
        for name, value in metrics().items():
            self._logger.record(name, value)
        self._logger.dump(sum(int(one["steps"]) for one in rows))

    def close(self) -> None:
        """Close the files."""
        if self._logger is not None:
            self._logger.close()
