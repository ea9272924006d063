"""Results of an evaluation: stored episodes, statistics of a policy and of baseline policies, and their comparison.

`evaluate.py` runs the episodes and imports this module. The digest in the names of files decides which stored episodes
are used again.
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd
import scipy  # `scipy.stats` is imported on first use

from guiderail.models.common.errors import InputError, brief
from guiderail.tools.environments import task_content
from guiderail.tools.evaluation.metrics import STATISTICS, TOLERANCE, UNCONSTRAINED, reports_success
from guiderail.tools.files import write_atomically
from guiderail.tools.learning.run_folder import RunConfig, installed_versions
from guiderail.tools.tables import read_table, table_text

POLICY = "policy"  # name of the evaluated policy
POLICY_FOLDER = "held_out"  # folder of the policy's evaluated episodes, in the run's folder
MAX_NAME_BYTES = 200  # largest size of a policy's name in a file's name; a file system allows 255 for all of it
BASELINES_FOLDER = "baselines"  # folder of the baseline policies' evaluated episodes, in the run's folder


def load_or_compute(file: Path, compute: Callable[[], pd.DataFrame], episodes: int | None = None) -> pd.DataFrame:
    """Return the rows of a file; if it does not exist, compute and write them. An empty table is not written.

    With `episodes`, rows are also computed again if the file has another number of them.
    """
    if (stored := read_complete(file, episodes)) is not None:
        return stored
    rows = compute()
    if not len(rows):
        return rows
    write_atomically(file, table_text(rows).encode())
    return read_table(file)


def read_complete(file: Path, episodes: int | None = None) -> pd.DataFrame | None:
    """Return the rows of a table; None if it does not exist, or the number of rows is not `episodes`."""
    rows = read_table(file) if file.exists() else None
    return None if rows is None or (episodes is not None and len(rows) != episodes) else rows


def episodes_file(
    folder: Path, name: str, config: RunConfig, environment: Mapping[str, Any], *, about: Any = None, **kwargs: Any
) -> Path:
    """Return the path of the file for a policy's evaluated episodes; its name is `name` and a digest.

    The digest covers the task with its files, the options of the environment, the run's seed, package versions, and the
    arguments `kwargs` of `evaluate_policy` except `label` and `processes`. `about` is anything else that the episodes
    depend on, such as the digest of the policy.
    """
    if not _can_name_file(name):
        raise InputError(
            f"the name of a policy is a printable text of 1 to {MAX_NAME_BYTES} bytes without '/', not {brief(name)}"
        )
    kwargs = {key: value for key, value in kwargs.items() if key not in ("label", "processes")}
    content = task_content(config.task, environment, config.imports)
    parts = [config.task, environment, kwargs, config.seed, installed_versions(), about, content]
    key = json.dumps(parts, sort_keys=True, default=str)
    return folder / f"{name}-{hashlib.blake2b(key.encode(), digest_size=6).hexdigest()}.csv"


def _can_name_file(policy: str) -> bool:
    return policy.isprintable() and "/" not in policy and 0 < len(policy.encode()) <= MAX_NAME_BYTES


def policy_digest(source: Path) -> str:
    """Return the digest of a policy's weights in a folder, or of its file.

    For `module:function` the result is unique in each call, because the function may read other files.
    """
    file = source / "policy.safetensors" if source.is_dir() else source
    if not file.is_file():
        return str(time.time_ns())
    return hashlib.blake2b(file.read_bytes(), digest_size=8).hexdigest()


COMPARED = (
    "success_rate", "success_low", "success_high", "mean_return", "mean_steps", "max_commanded_violation",
    "max_measured_violation", "collisions", "collision_steps", "peak_force", "mean_force",
)  # fmt: skip
"""Names of the statistics of the policy and of every baseline policy; see `STATISTICS`."""
COLLISIONS = ("collisions", "collision_steps")  # statistics that need a task with a collision signal
LABELS = {
    POLICY: "policy", "demonstration": "demonstration alone", "zero": "zero action",
    "uniform_random": "uniform random actions", "constant": "constant action", "scripted": "scripted policy",
}  # fmt: skip
SIGNIFICANT = 0.05  # p-values below it support that a policy is better


class Comparison(NamedTuple):
    """Comparison of a policy's success with that of the best baseline policy, on the same episodes."""

    baseline: str  # name of the baseline policy with the most successes
    successes: int  # number of successful episodes of this baseline policy
    p: float  # largest one-sided p-value of the tests against each baseline policy; see `compare`


@dataclass(frozen=True, eq=False)  # compared as mappings
class Evaluation(Mapping[str, Any]):
    """Result of `evaluate`, and a mapping of its statistics by name.

    Attributes:
        statistics: Statistics, as `guiderail evaluate --json` prints them.
        rows: Episodes by name of the policy, one row each; the first policy is the evaluated one.
        is_held_out: False if the environment was given as an object: its episodes may have the conditions of training.
    """

    statistics: Mapping[str, Any]
    rows: Mapping[str, pd.DataFrame]
    is_held_out: bool = True

    def __getitem__(self, name: str) -> Any:
        return self.statistics[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.statistics)

    def __len__(self) -> int:
        return len(self.statistics)

    @cached_property
    def table(self) -> pd.DataFrame:
        """Statistics `COMPARED`, one row for each policy; a statistic that no policy has is left out.

        `success_low` and `success_high` are the ends of the 95 % interval of the success rate.
        """
        names = [self._name(name) for name in self.rows]
        rows = [statistics(rows) for rows in self.rows.values()]
        table = pd.DataFrame(rows, index=pd.Index(names, name="policy")).dropna(axis="columns", how="all")
        unknown = [name for name in COLLISIONS if name in table and self.statistics.get(name, 0) is None]
        return table.drop(columns=unknown)

    @property
    def comparison(self) -> Comparison | None:
        """Comparison with the best baseline policy; None without a baseline policy or reports of success."""
        return compare(self.rows)

    @property
    def sentence(self) -> str:
        """Result in one sentence."""
        rows = self.rows[POLICY]
        episodes = f"{len(rows)} held-out episodes" if self.is_held_out else f"{len(rows)} episodes"
        if reports_success(rows):
            low, high = (100 * self.statistics[f"success_{end}"] for end in ("low", "high"))
            text = f"The policy succeeds in {int(rows['success'].sum())} of {episodes} "
            text += f"(95 % interval {low:.0f} to {high:.0f} %)"
        else:
            text = f"The environment reports no success; the policy's mean return of {episodes} is "
            text += f"{self.statistics['mean_return']:.4g}"
        if self.comparison is not None:
            baseline, successes, p = self.comparison
            verdict = "better than" if p < SIGNIFICANT else "not shown to be better than"
            text += f", {verdict} the best baseline, {self._name(baseline)} with {successes} of {len(rows)}"
            text += f" (one-sided p = {p:.2g})"
        violation = self.statistics.get("max_commanded_violation")
        if violation is not None:
            if violation <= UNCONSTRAINED:
                text += "; the commands were not checked, because there is no constraint"
            elif violation <= TOLERANCE:
                text += "; every command satisfied the constraints"
            elif violation > TOLERANCE:
                text += f"; the largest constraint violation of a command was {violation:.2g} m or rad"
            else:
                text += "; the largest constraint violation of a command is unknown, because it is not a number"
        return text + "."

    def __str__(self) -> str:
        return f"{self.table.to_string()}\n{self.sentence}"

    def _repr_html_(self) -> str:
        return f"{self.table.to_html()}<p>{self.sentence}</p>"

    @staticmethod
    def _name(policy: str) -> str:
        return LABELS.get(policy, policy.replace("_", " "))


def compare(rows: Mapping[str, pd.DataFrame]) -> Comparison | None:
    """Compare the success of the policy named `POLICY` with that of baseline policies under the same conditions.

    The test is McNemar's, exact and one-sided. It uses only the episodes in which exactly one of the two policies
    succeeds: a policy that is not better succeeds in at most half of these episodes on average. The result has the
    largest p-value of all baseline policies, so that "better than the best baseline" means better than each of them
    (intersection-union test). No correction for the number of baseline policies is needed. The result is None if there
    is no baseline policy, or the environment reports no success.
    """
    if not reports_success(rows[POLICY]):
        return None
    won = rows[POLICY]["success"].to_numpy(float)
    others = {name: table["success"].to_numpy(float) for name, table in rows.items() if name != POLICY}
    if not others:
        return None
    best = max(others, key=lambda name: others[name].sum())
    return Comparison(best, int(others[best].sum()), max(_mcnemar(won, other) for other in others.values()))


def _mcnemar(won: Any, other: Any) -> float:
    """Return the one-sided p-value of McNemar's exact test, for successes (n,) on the same episodes."""
    wins, losses = int((won > other).sum()), int((won < other).sum())
    return float(scipy.stats.binomtest(wins, wins + losses, alternative="greater").pvalue) if wins + losses else 1.0


def statistics(rows: pd.DataFrame, prefix: str = "") -> dict[str, Any]:
    """Return the statistics `COMPARED` of episodes; a statistic is None without rows or without its column.

    The statistics of success are also None if the environment reports no success.
    """
    result: dict[str, Any] = dict.fromkeys(prefix + name for name in COMPARED)
    for name in COMPARED if len(rows) else ():
        if name.startswith("success") and not reports_success(rows):
            continue
        with suppress(KeyError):
            result[prefix + name] = STATISTICS[name].compute(rows)
    return result
