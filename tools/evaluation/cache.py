"""Stored tables of evaluated episodes: CSV files, each named by a digest of everything that determines its rows."""

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import pandas as pd

from guiderail.tools.environments import task_content
from guiderail.tools.files import write_atomically
from guiderail.tools.learning.run_folder import RunConfig, RunFolder, installed_versions
from guiderail.tools.tables import read_table, table_text

POLICY = "policy"  # name of the run's own policy
POLICY_FOLDER = "held_out"  # folder of the policy's episodes, in the run
BASELINES_FOLDER = "baselines"  # folder of the baseline policies' episodes, in the run


def load_or_compute(file: Path, compute: Callable[[], pd.DataFrame]) -> pd.DataFrame:
    """Return the rows of a file; if it does not exist, compute and write them. Empty tables are not written."""
    if not file.exists():
        rows = compute()
        if not len(rows):
            return rows
        write_atomically(file, table_text(rows).encode())
    return read_table(file)


def episodes_file(
    folder: Path, name: str, config: RunConfig, environment: Mapping[str, Any], *, about: Any = None, **how: Any
) -> Path:
    """Return the path of a policy's evaluated episodes, with its `name` and a digest of all that they depend on.

    The digest covers the environment, the run's seed, the task's files, package versions, and the arguments `how` of
    `evaluate_policy` except `label` and `processes`. `about` is anything else, such as the digest of the policy.
    """
    how = {key: value for key, value in how.items() if key not in ("label", "processes")}
    content = task_content(config.task, environment, config.imports)
    more = [*([] if about is None else [about]), *filter(None, [content])]
    key = json.dumps([environment, how, config.seed, installed_versions(), *more], sort_keys=True, default=str)
    return folder / f"{name}-{hashlib.blake2b(key.encode(), digest_size=6).hexdigest()}.csv"


def policy_digest(folder: RunFolder) -> str:
    """Return the digest of a run's policy."""
    return hashlib.blake2b((folder.path / "policy.safetensors").read_bytes(), digest_size=8).hexdigest()


def stored_episodes(folder: RunFolder, config: RunConfig, seed: int) -> Iterator[tuple[str, pd.DataFrame]]:
    """Yield the name of each policy and its stored episodes in the run's own environment that begin at `seed`."""
    digest = policy_digest(folder) if (folder.path / "policy.safetensors").is_file() else None
    for file in sorted(
        path for part in (POLICY_FOLDER, BASELINES_FOLDER) for path in (folder.path / part).glob("*.csv")
    ):
        name, rows = file.stem.rpartition("-")[0], read_table(file)
        about = digest if file.parent.name == POLICY_FOLDER else None
        how = {"episodes": len(rows), "seed": seed}
        if file == episodes_file(file.parent, name, config, config.environment, about=about, **how):
            yield name, rows
