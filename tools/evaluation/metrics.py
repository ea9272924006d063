"""What is measured, each number once: the columns of an episode's row, and the statistics of many episodes.

Everything comes from the trace and the safety ledger, which know every control step and not only the last of a
decision. `guiderail list metrics` prints the definitions.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy import stats

from guiderail.diagrams.envs.trace import EpisodeTrace, mean_jerk
from guiderail.models.common.errors import InputError

CONFIDENCE = 0.95
RESAMPLES = 1000
TRIMMED = 0.25  # of the seeds at either end, for the interquartile mean
IN_A_ROW = 10  # successes that convergence needs


def bootstrap_band(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The 95 % interval of the mean over the first axis of (runs, n), at each of n; two runs are needed."""
    return _bootstrap(np.asarray(values, float), np.mean)


def interquartile_mean(values: Sequence[float]) -> tuple[float, tuple[float, float] | None]:
    """The mean without a quarter of the values at either end, and its 95 % interval; None for a single value.

    Of fewer than four values none is left out.
    """
    known = np.asarray(values, float)
    mean = float(stats.trim_mean(known, TRIMMED))
    if len(known) < 2:
        return mean, None
    low, high = _bootstrap(known, lambda x, axis: stats.trim_mean(x, TRIMMED, axis=axis))
    return mean, (float(low), float(high))


def _bootstrap(values: np.ndarray, statistic: Any) -> tuple[Any, Any]:
    if np.ptp(values, axis=0).max() == 0:  # nothing to resample, and SciPy would warn of it
        mean = statistic(values, axis=0)
        return mean, mean
    interval = stats.bootstrap(
        (values,), statistic, axis=0, vectorized=True, confidence_level=CONFIDENCE, n_resamples=RESAMPLES,
        method="percentile", rng=np.random.default_rng(0),
    ).confidence_interval  # fmt: skip
    return interval.low, interval.high


def wilson(successes: int, episodes: int) -> tuple[float, float]:
    """The 95 % interval of a success rate."""
    interval = stats.binomtest(int(successes), int(episodes)).proportion_ci(CONFIDENCE, method="wilson")
    return float(interval.low), float(interval.high)


def wilson_of_each(successes: Sequence[int], episodes: Sequence[int]) -> list[tuple[float, float]]:
    """The 95 % interval of each seed's success rate.

    There is none of all seeds together: episodes of one policy are independent, those of several policies are not, as
    what a seed came to decides all of its own.
    """
    return [wilson(won, of) for won, of in zip(successes, episodes, strict=True)]


def survival(converged: Sequence[int | None], episodes: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
    """How many of the runs have not converged after so many episodes: steps (k,) and the part (k,) from there on.

    Kaplan and Meier's estimate. A run that never converged says only that it takes more episodes than those after which
    ten in a row would still have fitted into it.

    Args:
        converged: after how many episodes each run converged, None for never.
        episodes: how many each has.
    """
    known = [after for after in converged if after is not None]
    censored = [max(n - IN_A_ROW, 0) for after, n in zip(converged, episodes, strict=True) if after is None]
    if not known:
        return np.array([0.0]), np.array([1.0])
    function = stats.ecdf(stats.CensoredData(uncensored=known, right=censored)).sf
    return np.append(0.0, function.quantiles), np.append(1.0, function.probabilities)


def median_survival(steps: np.ndarray, left: np.ndarray) -> float | None:
    """After how many episodes half of the runs have converged; None if fewer do."""
    reached = steps[left <= 0.5]
    return float(reached[0]) if len(reached) else None


TOLERANCE = 1e-9  # what a primitive keeps its bounds to; below it there is only rounding


@dataclass(frozen=True)
class Episode:
    """An episode that is over."""

    index: int
    trace: EpisodeTrace  # every control step
    ledger: Mapping[str, float]  # the safety ledger's row
    total: float  # of the rewards
    terms: Mapping[str, float]  # the sum of each of the reward's terms
    success: bool
    termination: str


@dataclass(frozen=True)
class Metric:
    """A number with a name, a unit, a definition in words, and what computes it."""

    name: str
    unit: str
    words: str
    of: Callable[[Any], Any]


def jerk(poses: np.ndarray, period: float) -> dict[str, float]:
    """Mean jerk of positions (n, ≤ 3) and, in a pose of six numbers, of rotations [1/s³ of their units]."""
    poses = np.array(poses)
    angular = mean_jerk(poses[:, 3:], period) if poses.shape[1] == 6 else 0.0
    return {"linear": mean_jerk(poses[:, :3], period), "angular": angular}


def _jerk(which: str, part: str) -> Callable[[Episode], float]:
    return lambda e: jerk(getattr(e.trace, which), e.trace.period)[part]


def _ledger(name: str) -> Callable[[Episode], float]:
    return lambda e: float(e.ledger[name])


def _count(name: str) -> Callable[[Episode], int]:
    return lambda e: int(e.ledger.get(name, 0))


def _squared_force(e: Episode) -> float:
    return float(np.mean(np.asarray(e.trace.force) ** 2)) if len(e.trace) else 0.0


STEPS, SLACK = "control steps", "the constraint's, negative is slack"
ENDINGS = "success, collision, spill, blocked, violation, time_limit or simulation_failure"

COLUMNS = (
    Metric("episode", "", "number of the episode, from 0", lambda e: e.index),
    Metric("return", "reward", "sum of all rewards, undiscounted", lambda e: e.total),
    Metric("success", "", "1 if the task was done", lambda e: int(e.success)),
    Metric("termination", "", f"how it ended: {ENDINGS}", lambda e: e.termination),
    Metric("steps", STEPS, "how long it took", lambda e: len(e.trace)),
    Metric("peak_force", "N", "largest contact force of any control step", _ledger("peak_force")),
    Metric("mean_force", "N", "contact force, mean over control steps", _ledger("mean_force")),
    Metric("mean_squared_force", "N²", "squared contact force, mean over control steps", _squared_force),
    *(
        Metric(f"jerk_{which}_{part}", unit, f"third derivative of the {which} {of}, mean norm", _jerk(which, part))
        for which in ("commanded", "measured")
        for part, of, unit in (("linear", "position", "m/s³"), ("angular", "orientation (0 without one)", "rad/s³"))
    ),
    Metric("max_commanded_violation", SLACK, "how far any command was outside", _ledger("max_commanded_violation")),
    Metric("max_measured_violation", SLACK, "the same of measured poses", _ledger("max_measured_violation")),
    Metric("collisions", "", "collisions that began, by the safety ledger, however long", _count("collisions")),
    Metric("collision_steps", STEPS, "control steps in collision", _count("collision_steps")),
    Metric("saturated_steps", STEPS, "control steps with an actuator at its limit", _count("saturated_steps")),
    Metric("fallback_steps", STEPS, "control steps that repeated the last safe command", _count("fallback_steps")),
)


def episode_row(episode: Episode) -> dict[str, Any]:
    """An episode's row: every column, and each of the reward's terms as `reward_<term>`."""
    row = {column.name: column.of(episode) for column in COLUMNS}
    return row | {f"reward_{name}": value for name, value in episode.terms.items()}


WORDS = ("termination", "fault")  # the latter at a robot
COUNTS = ("episode", "success", "steps", "collisions", "collision_steps", "saturated_steps", "fallback_steps")


def checked_rows(rows: pd.DataFrame, where: Path) -> pd.DataFrame:
    """A table of episodes that was read from somewhere.

    Raises:
        InputError: if a column but `WORDS` holds words, or one that counts no whole numbers.
    """
    words = [name for name in rows if name not in WORDS and not pd.api.types.is_numeric_dtype(rows[name])]
    parts = [name for name in COUNTS if name in rows and name not in words and not (rows[name] % 1 == 0).all()]
    wrong = [*(words if len(rows) else ()), *parts]
    if not wrong and "success" in rows and not rows["success"].isin([0, 1]).all():
        wrong = ["success"]
    if wrong:
        raise InputError(f"{where} has no number of {wrong[0]} for every episode: restore it, or train anew")
    return rows


def first_in_a_row(good: Iterable[bool], number: int) -> int | None:
    """How many come before the first so many good ones in a row, those not counted; None if there are none."""
    run = 0
    for index, one in enumerate(good):
        run = run + 1 if one else 0
        if run == number:
            return index + 1 - number
    return None


def own(rows: pd.DataFrame) -> pd.DataFrame:
    """Those of a run's episodes in which its learner acted, and nobody that it learned from."""
    return rows[rows["is_demonstration"] == 0] if "is_demonstration" in rows else rows


def episodes_to_convergence(rows: pd.DataFrame) -> int | None:
    """Episodes before the first ten in a row that succeed, those ten not counted (the thesis's figure 3.8).

    What was demonstrated counts as an episode, and as no success.
    """
    return first_in_a_row((rows["success"] == 1) & (rows.get("is_demonstration", 0) == 0), 10)


def avoids_obstacle_from(rows: pd.DataFrame, cost: float = 1.0, in_a_row: int = 5) -> int | None:
    """The first episode, from 1, from which the obstacle costs less than 1 for five in a row.

    A path through its middle costs about a hundred; a policy that explores brushes its margin now and then.
    """
    before = first_in_a_row(rows["reward_obstacle_cost"] > -cost, in_a_row)
    return None if before is None else before + 1


def _mean(column: str, of: slice = slice(None)) -> Callable[[pd.DataFrame], float]:
    return lambda rows: float(np.mean(rows[column].to_numpy(float)[of]))


def _succeeded(of: slice = slice(None)) -> Callable[[pd.DataFrame], float | None]:
    return lambda rows: float(np.mean(found)) if len(found := own(rows)["success"].to_numpy(float)[of]) else None


def _largest(column: str) -> Callable[[pd.DataFrame], float]:
    return lambda rows: float(rows[column].max(skipna=False))


def _total(column: str) -> Callable[[pd.DataFrame], int]:
    return lambda rows: int(rows[column].sum())


def _ended(how: str) -> Callable[[pd.DataFrame], int]:
    return lambda rows: int((rows["termination"] == how).sum())


def _violating(column: str) -> Callable[[pd.DataFrame], int]:
    return lambda rows: int((~(rows[column] <= TOLERANCE)).sum())  # what is no number is no slack


def _wilson(end: int) -> Callable[[pd.DataFrame], float | None]:
    def bound(rows: pd.DataFrame) -> float | None:
        from scipy.stats import binomtest  # half a second to import

        acted = own(rows)["success"]
        if not len(acted):
            return None
        return float(binomtest(int(acted.sum()), len(acted)).proportion_ci(method="wilson")[end])

    return bound


def _force_since_converged(rows: pd.DataFrame) -> float | None:
    converged = episodes_to_convergence(rows)
    return None if converged is None else _mean("mean_squared_force", slice(converged, None))(rows)


FIRST, LAST = slice(10), slice(-10, None)
SINCE = "mean_squared_force_since_converged"
JERKS = {"jerk_commanded_linear": "m/s³", "jerk_commanded_angular": "rad/s³", "jerk_measured_linear": "m/s³"}

_STATISTICS = (
    Metric("episodes", "", "how many episodes the other numbers are of", len),
    Metric("success_rate", "", "part of the learner's own episodes that succeeded", _succeeded()),
    Metric("success_low", "", "lower end of the success rate's 95 % interval (Wilson)", _wilson(0)),
    Metric("success_high", "", "upper end of the success rate's 95 % interval (Wilson)", _wilson(1)),
    Metric("success_rate_last_10", "", "success rate of the last ten of them", _succeeded(LAST)),
    Metric(
        "episodes_to_convergence",
        "episodes",
        "before the first ten in a row that succeed, its own",
        episodes_to_convergence,
    ),
    Metric("mean_return", "reward", "return, mean over episodes", _mean("return")),
    Metric("mean_return_last_10", "reward", "return, mean over the last ten episodes", _mean("return", LAST)),
    Metric("mean_steps", STEPS, "length, mean over episodes", _mean("steps")),
    Metric("total_steps", STEPS, "length of all episodes together", _total("steps")),
    Metric("peak_force", "N", "largest force of any episode", _largest("peak_force")),
    Metric("mean_force", "N", "each episode's mean force, mean over episodes", _mean("mean_force")),
    Metric("mean_squared_force", "N²", "the same of the squared force", _mean("mean_squared_force")),
    Metric(SINCE, "N²", "the same of the episodes after `episodes_to_convergence`", _force_since_converged),
    Metric(
        "max_commanded_violation",
        SLACK,
        "of a command, the largest of any episode",
        _largest("max_commanded_violation"),
    ),
    Metric("max_measured_violation", SLACK, "of a measured pose", _largest("max_measured_violation")),
    Metric("violating_episodes", "", "episodes with a command outside", _violating("max_commanded_violation")),
    Metric("measured_violating_episodes", "", "those with a pose outside", _violating("max_measured_violation")),
    Metric("collisions", "", "collisions that began in all episodes, by the safety ledger", _total("collisions")),
    Metric("collision_steps", STEPS, "control steps in collision, in all", _total("collision_steps")),
    Metric("fallback_steps", STEPS, "repeated safe commands, in all episodes", _total("fallback_steps")),
    Metric("ended_in_success", "", "episodes that ended in success", _ended("success")),
    Metric("ended_in_collision", "", "episodes that a collision ended", _ended("collision")),
    Metric("ended_in_spill", "", "episodes that a spill ended", _ended("spill")),
    Metric("ended_blocked", "", "episodes that ended as the robot got nowhere", _ended("blocked")),
    *(Metric(f"{kind}_first_10", unit, "mean over ten episodes", _mean(kind, FIRST)) for kind, unit in JERKS.items()),
    Metric("wall_time", "s", "how long acting and learning took", lambda rows: float(rows["wall_time"].sum())),
    Metric("avoids_obstacle_from", "episode", "whose obstacle cost stays below 1, from 1", avoids_obstacle_from),
)
STATISTICS = {metric.name: metric for metric in _STATISTICS}
SYMBOLS = ("N", "N²", "s", *JERKS.values())
"""Units that are symbols, and no words: those that a table has room for."""


def summary(rows: pd.DataFrame, names: Iterable[str], prefix: str = "") -> dict[str, Any]:
    """Statistics of episodes by name, each name with `prefix`; None where there are no episodes.

    Raises:
        InputError: if the episodes lack a number that a statistic is of.
    """
    try:
        return {prefix + name: STATISTICS[name].of(rows) if len(rows) else None for name in names}
    except KeyError as error:
        raise InputError(f"these episodes are of another version: they have no {error.args[0]}; train anew") from error
