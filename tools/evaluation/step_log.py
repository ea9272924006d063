"""Step log of a run: a Parquet file for each episode in the run's `steps/`, with one row for every control step."""

from __future__ import annotations

import io
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from guiderail.diagrams.envs.trace import EpisodeTrace
from guiderail.models.common.errors import InputError
from guiderail.tools.evaluation.episode import EnvCallback, Transition
from guiderail.tools.files import write_atomically
from guiderail.tools.tables import check_parquet

SLACK = "unit of the constraint; negative is slack"
# Unit and meaning of each column; "_i" stands for one column per component of a pose or a wrench.
MEANINGS = {
    "episode": ("", "number of the episode, from 0"),
    "step": ("control steps", "number of the control step, from 0; all values are those at its end"),
    "desired_pose_i": ("m, rad", "commanded pose"),
    "pose_i": ("m, rad", "measured pose"),
    "commanded_violation": (SLACK, "violation of the commanded pose"),
    "measured_violation": (SLACK, "violation of the measured pose"),
    "force": ("N", "force of the impedance or, without an impedance, of the contact"),
    "contact_force": ("N", "contact force, low-pass filtered"),
    "wrench_i": ("N, Nm", "wrench of the surroundings on the tool"),
    "saturation": ("", "1 while the controller is at a limit; in the plane, the largest excess of a joint's force [N]"),
    "collision": ("", "True in a collision"),
    "command_timed_out": ("", "True while the last safe pose is held because commands stopped or are not finite"),
    "fallback": ("", "True if guidance commanded a safe pose instead of the requested pose"),
    "state": ("", "number of the template's state, if there is a template"),
    "reward": ("reward", "reward of the control step"),
    "disagreement": ("action", "standard deviation of the actions of an ensemble's networks, mean over the entries"),
}
_FLAGS = {"collision", "command_timed_out", "fallback"}


class StepLog(EnvCallback):
    """Callback that writes an episode's control steps to a file when the episode ends.

    The file is thus written before a checkpoint includes the episode.

    Attributes:
        seconds: Time spent on writing so far [s].
    """

    def __init__(self, env: gymnasium.Env, folder: Path, act: Any = None):
        """Construct the callback for episodes in `env`; it writes one file per episode into `folder`.

        If `act` is an `Ensemble`, the log has the column `disagreement`.
        """
        super().__init__(env)
        self._folder = folder
        self._disagreement: Callable[[np.ndarray], float] | None = getattr(act, "disagreement", None)
        self._disagreements: list[float] = []  # of each control step of the episode
        self.seconds = 0.0

    def on_episode_start(self) -> None:
        """Start an episode."""
        self._disagreements = []

    def on_step(self, transition: Transition) -> None:
        """Compute the disagreement of an ensemble for the control steps of an action."""
        if self._disagreement is not None:
            number = len(self.base.trace) - len(self._disagreements)
            self._disagreements += [self._disagreement(transition.observation)] * number

    def on_episode_end(self, row: Mapping[str, Any]) -> Mapping[str, Any]:
        """Write the episode's control steps; add no column to its row."""
        start_time = time.perf_counter()
        steps = table(self.base.trace, row["episode"])
        if self._disagreement is not None:
            steps = steps.append_column("disagreement", pa.array(self._disagreements))
        write_step_log(step_log_file(self._folder, row["episode"]), steps)
        self.seconds += time.perf_counter() - start_time
        return {}


def step_log_file(folder: Path, episode: int) -> Path:
    """Return the path of the file of episode number `episode`, from 0."""
    return folder / f"episode-{episode:06d}.parquet"


def remove_step_logs(folder: Path, episodes: int) -> None:
    """Remove the files of all but the first `episodes` episodes.

    A run that was stopped may have logged episodes after its last checkpoint.
    """
    for file in folder.glob("episode-*.parquet"):
        number = file.stem.removeprefix("episode-")
        if number.isdecimal() and int(number) >= episodes:
            file.unlink()


def table(trace: EpisodeTrace, episode: int) -> pa.Table:
    """Return an episode's control steps, one row each, with the columns of `MEANINGS` that its trace has."""
    num_steps = len(trace)
    columns: dict[str, np.ndarray] = {
        "episode": np.full(num_steps, episode, np.int32),
        "step": np.arange(num_steps, dtype=np.int32),
    }
    columns |= _numbered("desired_pose", trace.commanded) | _numbered("pose", trace.measured)
    columns["force"] = trace.force
    for name, values in trace.signals.items():
        if name in _FLAGS:
            columns[name] = values[:, 0] > 0.0
        elif name == "saturation":
            columns[name] = np.abs(values).max(axis=1)
        elif name == "state":
            columns[name] = values[:, 0].astype(np.int32)
        elif name == "wrench":
            columns |= _numbered(name, values)
        else:
            columns[name] = values[:, 0]
    columns["reward"] = trace.reward
    return pa.table({name: np.ascontiguousarray(values) for name, values in columns.items()})


def _numbered(name: str, values: np.ndarray) -> dict[str, np.ndarray]:
    """Return the columns `name_i` of values (n, size)."""
    return {f"{name}_{index}": values[:, index] for index in range(values.shape[1])}


def write_step_log(path: Path, rows: pa.Table) -> None:
    """Write an episode's control steps atomically; raise an InputError if the file cannot be written."""
    file = io.BytesIO()
    # Uncompressed: sensor noise does not compress and compression costs time.
    pq.write_table(rows, file, compression="NONE", use_dictionary=False)
    write_atomically(path, file.getvalue())


def read_step_log(folder: Path) -> pd.DataFrame:
    """Return the control steps of all episodes in a run's `steps/`, in order."""
    files = sorted(folder.glob("episode-*.parquet"))
    if not files:
        raise InputError(f"{folder} has no step log: the run was trained without a step log")
    check_parquet(files)
    tables = []
    for file in files:
        try:
            tables.append(pq.read_table(file, partitioning=None))
        except (pa.ArrowException, OSError, KeyError) as error:
            raise InputError(f"{file} is damaged: restore it, or train again") from error
    try:
        return pa.concat_tables(tables).to_pandas()
    except pa.ArrowInvalid as error:
        raise InputError(f"{folder} has step logs of different environments: restore them, or train again") from error
