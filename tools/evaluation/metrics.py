"""Metrics: the columns of an episode's row, and the statistics of many episodes.

An episode's numbers are computed from its `EpisodeTrace`, which contains all control steps of each action.
`guiderail list metrics` prints the definitions.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import scipy  # `scipy.stats` is imported on first use

from guiderail.diagrams.envs.trace import QUASI_STATIC_TIME, EpisodeTrace, Metric, mean_jerk
from guiderail.diagrams.envs.trace import TOLERANCE as TOLERANCE
from guiderail.diagrams.tasks.registry import TASKS
from guiderail.models.common.arrays import as_whole, find_streak
from guiderail.models.common.errors import InputError
from guiderail.models.common.registry import did_you_mean
from guiderail.models.common.termination import Termination

CONFIDENCE = 0.95  # level of all confidence intervals
CONVERGED_SUCCESSES = 10  # consecutive successes that count as convergence
REPORTS_SUCCESS = "reports_success"  # column of another package's environment: 1 if `info` has a success flag


def wilson(successes: int, episodes: int) -> tuple[float, float]:
    """Return the 95 % Wilson interval of a success rate over at least one episode.

    The episodes of several seeds are not pooled into one interval, because they are not independent: all episodes of
    one seed use the same policy.
    """
    interval = scipy.stats.binomtest(int(successes), int(episodes)).proportion_ci(CONFIDENCE, method="wilson")
    return float(interval.low), float(interval.high)


def jerk(poses: np.ndarray, period: float) -> dict[str, float]:
    """Return the mean jerk of poses (n, O) at intervals of `period` [s]: "linear" [m/s³] and "angular" [rad/s³].

    The angular jerk is that of the three orientation coordinates; it is 0 unless O is 6.
    """
    poses = np.array(poses)
    angular = mean_jerk(poses[:, 3:], period) if poses.shape[1] == 6 else 0.0
    return {"linear": mean_jerk(poses[:, :3], period), "angular": angular}


STEPS, VIOLATION = "control steps", "m or rad"
UNCONSTRAINED = -1e30  # violation without any constraint, as `ConstraintViolation.UNCONSTRAINED`
ENDINGS = "success, collision, spill, blocked, violation, terminated, time_limit or simulation_failure"
COLLISION = "contact force, or the task's own collision signal, above its limit"


def violation_text(violation: float, text: str = f"{{:.1e}} {VIOLATION}") -> str:
    """Return the largest violation of episodes for a reader; `text` formats one above the solver's rounding."""
    if violation <= UNCONSTRAINED:
        return "unconstrained"
    return "none" if violation <= TOLERANCE else text.format(violation)


class Column(NamedTuple):
    """Column of an episode's row; see `episode_row`."""

    name: str
    unit: str  # unit, or the quantity that is counted; "" if there is none
    description: str  # definition in words


VIOLATIONS = tuple(
    Column(
        f"max_{which}_violation",
        VIOLATION,
        f"largest constraint violation of any {which} pose; negative: slack; −1e30: unconstrained",
    )
    for which in ("commanded", "measured")
)
COLUMNS = (
    Column("episode", "", "number of the episode, from 0"),
    Column("return", "reward", "sum of all rewards, undiscounted"),
    Column("success", "", "1 if the task was done"),
    Column("termination", "", f"reason of the end: {ENDINGS} (`Task.done` has the conditions)"),
    Column("steps", STEPS, "length (in actions if the environment does not count control steps)"),
    Column(
        "peak_force", "N", "largest force of the impedance, or of the contact without an impedance, of any control step"
    ),
    Column("peak_contact_force", "N", "largest contact force of any control step, low-pass filtered (10 ms)"),
    Column("quasi_static_force", "N", f"largest contact force that lasts {QUASI_STATIC_TIME:g} s"),
    Column("mean_force", "N", "force as in peak_force, mean over control steps"),
    Column("mean_squared_force", "N²", "squared contact force, mean over control steps"),
    *(
        Column(f"jerk_{which}_{part}", unit, f"third derivative of the {which} {of}, mean norm")
        for which in ("commanded", "measured")
        for part, of, unit in (("linear", "position", "m/s³"), ("angular", "orientation (0 without one)", "rad/s³"))
    ),
    *VIOLATIONS,
    Column("collisions", "", f"collisions that began, of any duration ({COLLISION})"),
    Column("collision_steps", STEPS, "control steps in collision"),
    Column("cost", STEPS, "control steps with a violated constraint or in collision"),
    Column("saturated_steps", STEPS, "control steps with the controller at a limit"),
    Column("fallback_steps", STEPS, "control steps at which guidance replaced the requested pose by a safe pose"),
)


def episode_row(
    index: int, trace: EpisodeTrace, total: float, terms: Mapping[str, float], info: Mapping[str, Any]
) -> dict[str, Any]:
    """Return an episode's row: every column, and each reward term's sum as `reward_<term>`.

    Args:
        index: Number of the episode, from 0.
        trace: Every control step.
        total: Sum of the rewards that the environment returned.
        terms: Sum of each reward term.
        info: `info` of the last step.
    """
    values: dict[str, Any] = {**trace.statistics(), "episode": index, "return": total}
    if not len(trace):  # the simulation failed at the first step: violations are those of the start
        values["max_commanded_violation"] = info["constraint_violation"]
        values["max_measured_violation"] = info["measured_violation"]
    values["success"] = bool(info["is_success"])
    failure = Termination.SIMULATION_FAILURE.value
    values["termination"] = failure if "simulation_failure" in info else info["termination"]
    values["mean_squared_force"] = float(np.mean(np.asarray(trace.force) ** 2)) if len(trace) else 0.0
    for which in ("commanded", "measured"):
        for part, value in jerk(getattr(trace, which), trace.period).items():
            values[f"jerk_{which}_{part}"] = value
    row = {name: int(values[name]) if name in COUNTS else values[name] for name, _, _ in COLUMNS}
    return row | {f"reward_{name}": value for name, value in terms.items()}


def outside_row(index: int, total: float, infos: Sequence[Mapping[str, Any]], *, is_terminated: bool) -> dict[str, Any]:
    """Return an episode's row for an environment that is not of this package, with the columns that `info` provides.

    `infos` are those of all steps. The episode succeeds if `is_success`, or without it `success`, is true at any step;
    without either in any step, the column `REPORTS_SUCCESS` is 0. The largest `constraint_violation`,
    `impedance_force` and `contact_force` of any step are the columns `max_commanded_violation`, `peak_force` and
    `peak_contact_force`; without an impedance, `peak_force` is the largest `contact_force`. `steps` is the last
    `control_steps`, which `GuidedEnv` counts, or the number of actions if `info` does not have it. `is_terminated` is
    False if the episode was truncated.
    """
    success = any(bool(info.get("is_success", info.get("success", False))) for info in infos)
    row = {
        "episode": index,
        "return": total,
        "success": int(success),
        "termination": _outside_termination(success, is_terminated).value,
        "steps": as_whole(infos[-1].get("control_steps", len(infos)), "control_steps in info"),
    }
    own_force = "impedance_force" if any("impedance_force" in info for info in infos) else "contact_force"
    for column, name in (
        ("max_commanded_violation", "constraint_violation"),
        ("peak_force", own_force),
        ("peak_contact_force", "contact_force"),
    ):
        if values := [float(info[name]) for info in infos if name in info]:
            row[column] = float(np.max(values))  # NaN if any value is NaN
    return row | {REPORTS_SUCCESS: int(any("is_success" in info or "success" in info for info in infos))}


def _outside_termination(success: bool, is_terminated: bool) -> Termination:
    if success:
        return Termination.SUCCESS
    return Termination.TERMINATED if is_terminated else Termination.TIME_LIMIT


def reports_success(rows: pd.DataFrame) -> bool:
    """Return False for episodes of an environment whose `info` has neither `is_success` nor `success`."""
    return REPORTS_SUCCESS not in rows or bool((rows[REPORTS_SUCCESS] > 0).any())


# Columns of text; `fault` exists on hardware only, and `environment` in runs over a set of environments.
WORDS = ("termination", "fault", "environment")
# Columns of whole numbers.
COUNTS = ("episode", "success", "steps", "collisions", "collision_steps", "cost", "saturated_steps", "fallback_steps")


def check_rows(rows: pd.DataFrame, source: Path) -> pd.DataFrame:
    """Return a table of episodes unchanged; `source` is its file, for the message."""
    text = [name for name in rows if name not in WORDS and not pd.api.types.is_numeric_dtype(rows[name])]
    fractional = [name for name in COUNTS if name in rows and name not in text and not (rows[name] % 1 == 0).all()]
    wrong = [*(text if len(rows) else ()), *fractional]
    if not wrong and "success" in rows and not rows["success"].isin([0, 1]).all():
        wrong = ["success"]
    if wrong:
        raise InputError(f"{source} has no number of {wrong[0]} for every episode: restore it, or train again")
    return rows


def own_episodes(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the episodes in which the learner acted, without demonstrations."""
    return rows[rows["is_demonstration"] == 0] if "is_demonstration" in rows else rows


def episodes_to_convergence(rows: pd.DataFrame) -> int | None:
    """Return the number of episodes before the first ten consecutive successes (thesis, figure 3.8), or None.

    A demonstration counts as an episode, but not as a success.
    """
    own_successes = (rows["success"] == 1) & (rows.get("is_demonstration", 0) == 0)
    return find_streak(own_successes, CONVERGED_SUCCESSES)


def _mean(column: str, of: slice = slice(None)) -> Callable[[pd.DataFrame], float]:
    return lambda rows: float(np.mean(rows[column].to_numpy(float)[of]))


def _success_rate(of: slice = slice(None)) -> Callable[[pd.DataFrame], float | None]:
    return lambda rows: float(np.mean(won)) if len(won := own_episodes(rows)["success"].to_numpy(float)[of]) else None


def _largest(column: str) -> Callable[[pd.DataFrame], float]:
    return lambda rows: float(rows[column].max(skipna=False))


def _total(column: str) -> Callable[[pd.DataFrame], int]:
    return lambda rows: int(rows[column].sum())


def _ended(reason: str) -> Callable[[pd.DataFrame], int]:
    return lambda rows: int((rows["termination"] == reason).sum())


def _violating(column: str) -> Callable[[pd.DataFrame], int]:
    return lambda rows: int((~(rows[column] <= TOLERANCE)).sum())  # NaN counts as a violation


def _wilson(end: int) -> Callable[[pd.DataFrame], float | None]:
    def bound(rows: pd.DataFrame) -> float | None:
        success = own_episodes(rows)["success"]
        return wilson(success.sum(), len(success))[end] if len(success) else None

    return bound


def _force_since_convergence(rows: pd.DataFrame) -> float | None:
    converged = episodes_to_convergence(rows)
    return None if converged is None else _mean("mean_squared_force", slice(converged, None))(rows)


FIRST, LAST = slice(10), slice(-10, None)
SINCE = "mean_squared_force_since_converged"
JERKS = {"jerk_commanded_linear": "m/s³", "jerk_commanded_angular": "rad/s³", "jerk_measured_linear": "m/s³"}

_STATISTICS = (
    Metric("episodes", "", "number of episodes", len),
    Metric("success_rate", "", "fraction of the learner's own episodes that succeeded", _success_rate()),
    Metric("success_low", "", "lower end of the success rate's 95 % interval (Wilson)", _wilson(0)),
    Metric("success_high", "", "upper end of the success rate's 95 % interval (Wilson)", _wilson(1)),
    Metric("success_rate_last_10", "", "success rate of the learner's own last ten episodes", _success_rate(LAST)),
    Metric(
        "episodes_to_convergence",
        "episodes",
        "training episodes before the first ten consecutive successes of the learner",
        episodes_to_convergence,
    ),
    Metric("mean_return", "reward", "return, mean over episodes", _mean("return")),
    Metric("mean_return_last_10", "reward", "return, mean over the last ten episodes", _mean("return", LAST)),
    Metric("mean_steps", STEPS, "length, mean over episodes", _mean("steps")),
    Metric("total_steps", STEPS, "length of all episodes together", _total("steps")),
    Metric("peak_force", "N", "largest force of any episode", _largest("peak_force")),
    Metric("peak_contact_force", "N", "largest contact force of any episode", _largest("peak_contact_force")),
    Metric("mean_force", "N", "each episode's mean force, mean over episodes", _mean("mean_force")),
    Metric("mean_squared_force", "N²", "mean squared force, mean over episodes", _mean("mean_squared_force")),
    Metric(SINCE, "N²", "mean squared force of the episodes after convergence", _force_since_convergence),
    *(Metric(*column, _largest(column.name)) for column in VIOLATIONS),
    *(
        Metric(name, "", f"episodes with a {pose} outside the constraints", _violating(of))
        for name, pose, of in (
            ("violating_episodes", "command", "max_commanded_violation"),
            ("measured_violating_episodes", "measured pose", "max_measured_violation"),
        )
    ),
    Metric("collisions", "", "collisions that began in all episodes", _total("collisions")),
    Metric("collision_steps", STEPS, "control steps in collision, in all episodes", _total("collision_steps")),
    Metric(
        "fallback_steps",
        STEPS,
        "control steps at which guidance replaced the requested pose, in all episodes",
        _total("fallback_steps"),
    ),
    Metric("ended_in_success", "", "episodes that ended in success", _ended("success")),
    Metric("ended_in_collision", "", "episodes that a collision ended", _ended("collision")),
    Metric("ended_in_spill", "", "episodes that a spill ended", _ended("spill")),
    Metric("ended_blocked", "", "episodes that ended because the robot made no progress", _ended("blocked")),
    *(
        Metric(f"{kind}_first_10", unit, "jerk, mean over the first ten episodes", _mean(kind, FIRST))
        for kind, unit in JERKS.items()
    ),
    Metric("wall_time", "s", "duration of acting and learning", lambda rows: float(rows["wall_time"].sum())),
)
STATISTICS = {metric.name: metric for metric in _STATISTICS}
SYMBOLS = ("N", "N²", "s", VIOLATION, *JERKS.values())
"""Units that are short enough for a table, because they are symbols and not words."""


def statistics_of(task: str | None = None) -> dict[str, Metric]:
    """Return the statistics of a task's episodes by name: common and its own; None: the statistics of all tasks."""
    tasks = TASKS.usable() if task is None else [task] if task in TASKS.names() else []
    return STATISTICS | {metric.name: metric for name in tasks for metric in TASKS.get(name).statistics}


def summary(rows: pd.DataFrame, names: Iterable[str], prefix: str = "", task: str = "") -> dict[str, Any]:
    """Return statistics of episodes by name, with a prefix; each is None if there are no episodes.

    With a task, its own statistics may be named too.
    """
    known = statistics_of(task) if task else STATISTICS
    statistics: dict[str, Any] = {}
    for name in names:
        if name not in known:
            raise InputError(f"there is no statistic {name!r}: {did_you_mean(name, known)}")
        try:
            statistics[prefix + name] = known[name].compute(rows) if len(rows) else None
        except KeyError as error:
            raise InputError(
                f"these episodes are of another version: they have no {error.args[0]}; train again"
            ) from error
    return statistics
