"""The ledger of a run: what happened at every control step, a Parquet file for each episode, in the run's `ledger/`."""

from __future__ import annotations

import io
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from guiderail.diagrams.envs.trace import EpisodeTrace
from guiderail.models.common.errors import InputError
from guiderail.tools.evaluation.rollout import EnvCallback
from guiderail.tools.files import write_atomically

SLACK = "how far outside of the constraint: negative is slack"
# Each column, its unit and meaning; "_i" stands for a column for every number of a pose or a wrench.
MEANINGS = {
    "episode": ("", "number of the episode, from 0"),
    "step": ("control steps", "number of the control step, from 0; everything is of its end"),
    "desired_pose_i": ("m, rad", "what was commanded"),
    "pose_i": ("m, rad", "what was measured"),
    "commanded_violation": (SLACK, "of what was commanded"),
    "measured_violation": (SLACK, "of what was measured"),
    "contact_force": ("N", "the contact force"),
    "wrench_i": ("N, Nm", "of the surroundings on the tool"),
    "saturation": ("", "the greatest demand on an actuator beyond its limit, 0 within"),
    "collision": ("", "whether the robot touched what it must not"),
    "command_timed_out": ("", "whether the watchdog held the last safe pose"),
    "fallback": ("", "whether guidance commanded something safe instead of what was asked for"),
    "state": ("", "number of the template's state, where there is one"),
    "reward": ("reward", "of the control step"),
}
_FLAGS = {"collision", "command_timed_out", "fallback"}


class StepLog(EnvCallback):
    """Writes what an episode's control steps were as the episode ends: before a checkpoint can know of it.

    Attributes:
        seconds: how long that has taken so far.
    """

    def __init__(self, env: gymnasium.Env, folder: Path):
        """
        Args:
            env: the environment.
            folder: where the files go, one an episode.
        """
        super().__init__(env)
        self._folder = folder
        self.seconds = 0.0

    def on_episode_end(self, row: Mapping[str, Any]) -> Mapping[str, Any]:
        """Writes; adds no column."""
        started = time.perf_counter()
        write_ledger(ledger_file(self._folder, row["episode"]), table(self.base.trace, row["episode"]))
        self.seconds += time.perf_counter() - started
        return {}


def ledger_file(folder: Path, episode: int) -> Path:
    """Where an episode is written."""
    return folder / f"episode-{episode:06d}.parquet"


def table(trace: EpisodeTrace, episode: int) -> pa.Table:
    """An episode's control steps, a row each, with the columns of `MEANINGS` that its environment knows."""
    number = len(trace)
    columns: dict[str, np.ndarray] = {"episode": np.full(number, episode, np.int32), "step": np.arange(number)}
    columns["step"] = columns["step"].astype(np.int32)
    columns |= _numbered("desired_pose", trace.commanded) | _numbered("pose", trace.measured)
    columns["contact_force"] = trace.force
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
    return {f"{name}_{index}": values[:, index] for index in range(values.shape[1])}


def write_ledger(path: Path, rows: pa.Table) -> None:
    """Writes an episode's control steps: whole, or not at all.

    Raises:
        InputError: if they cannot be written.
    """
    file = io.BytesIO()
    # Random digits hardly compress, and whoever packs them pays with time.
    pq.write_table(rows, file, compression="NONE", use_dictionary=False)
    write_atomically(path, file.getvalue())


def read_ledger(folder: Path, columns: list[str] | None = None) -> pd.DataFrame:
    """The control steps of all episodes in a folder, in order.

    Args:
        folder: a run's `ledger/`.
        columns: those that are wanted, all of them unless given; one that a file lacks is refused.

    Raises:
        InputError: if there is no ledger, or a file is damaged.
    """
    files = sorted(folder.glob("episode-*.parquet"))
    if not files:
        raise InputError(f"{folder} holds no ledger: the run was trained without one, or with an earlier version")
    tables = []
    for file in files:
        try:
            tables.append(pq.read_table(file, columns=columns, partitioning=None))
        except (pa.ArrowException, OSError, KeyError) as error:
            raise InputError(f"{file} is damaged: restore it, or train anew") from error
    try:
        return pa.concat_tables(tables).to_pandas()
    except pa.ArrowInvalid as error:
        raise InputError(f"{folder} holds ledgers of different environments: restore them, or train anew") from error
