"""`guiderail robustness`: a policy judged where it never trained, beside policies that know nothing."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import pandas as pd

from guiderail.models.errors import InputError
from guiderail.models.policy import Policy
from guiderail.tools.guidance import is_demonstrated
from guiderail.tools.learning.run_folder import RunFolder
from guiderail.tools.report.statistics import wilson
from guiderail.tools.robustness.axes import Point, chosen_axes, points
from guiderail.tools.robustness.picture import draw
from guiderail.tools.rollouts.evaluate import HELD_OUT_SEED, judged_once
from guiderail.tools.rollouts.null_policies import still
from guiderail.tools.rollouts.rollout import Act
from guiderail.tools.rollouts.suited import as_learned
from guiderail.tools.tables import write_table
from guiderail.tools.tasks import changed_environment

EPISODES = 30  # of each who at each place
POLICY, DEMONSTRATION = "policy", "demonstration"

Acts = Callable[[gymnasium.Env], Act]


def robustness(
    run: Path,
    *,
    episodes: int = EPISODES,
    seed: int = HELD_OUT_SEED,
    environment: Mapping[str, Any] | None = None,
    axes: str | None = None,
    beside: Mapping[str, Acts] | None = None,
    out: Path | None = None,
    tell: Callable[[str], None] = lambda words: None,
) -> dict[str, Any]:
    """Judges a run's policy along each axis by itself, the rest being as it was where the policy learned.

    Every place's episodes are kept in the folder, so that whoever is interrupted goes on.

    Args:
        run: the run's folder.
        episodes: held-out ones, the same for all who act, at each place.
        seed: of the first.
        environment: arguments of the environment that are other ones throughout, such as the station.
        axes: names of axes, comma-separated; all unless given.
        beside: who else acts, by name.
        out: the folder that is written; in the run, named as its station, unless given.
        tell: is told which places are left out, and how far it has come.

    Returns:
        `table` and `picture`, the files; `rows`, the table's.

    Raises:
        InputError: if there is no trained run, or an argument makes no sense.
    """
    if episodes < 1:
        raise InputError(f"robustness needs at least one episode at each place, not {episodes}")
    folder = RunFolder(run)
    config, policy = folder.config(), Policy.load(folder.path)
    where = changed_environment(config.task, config.environment, environment or {})
    places, left_out = points(config.task, where, chosen_axes(axes))
    for sentence in left_out:
        tell(sentence)
    who: dict[str, Acts] = {POLICY: partial(as_learned, policy)}
    if is_demonstrated(where.get("guidance")):
        who[DEMONSTRATION] = still
    who |= {name: acts for name, acts in (beside or {}).items() if name != "zero" or DEMONSTRATION not in who}
    out = folder.path / "robustness" / str(where.get("station", "")) if out is None else out
    about = {POLICY: hashlib.blake2b((folder.path / "policy.safetensors").read_bytes(), digest_size=8).hexdigest()}
    rows: list[dict[str, Any]] = []
    for number, place in enumerate(places, start=1):
        for name, acts in who.items():
            words = f"{number}/{len(places)} {place.axis.name} {place.value:.3g} {name}"
            judged = judged_once(
                out / "episodes", name, config, acts, place.environment,
                about=about.get(name), episodes=episodes, seed=seed, words=words,
            )  # fmt: skip
            if judged is not None:
                rows.append(_row(place, name, judged))
    if not rows:
        raise InputError("none of these axes can be changed here: choose others with --axes")
    table = write_table(out / f"{_called(axes, environment or {})}.csv", rows).with_suffix(".csv")
    return {"table": table, "picture": draw(table.with_suffix(".png"), rows), "rows": rows}


def _called(axes: str | None, environment: Mapping[str, Any]) -> str:
    """The name of a table, by what was asked for: another question does not replace its answer."""
    asked = [] if axes is None else [axis.name for axis in chosen_axes(axes)]
    asked += [f"{key}={value}" for key, value in sorted(environment.items())]
    return re.sub(r"[^\w.=-]+", "_", "-".join(["robustness", *asked]))


def _row(place: Point, name: str, judged: pd.DataFrame) -> dict[str, Any]:
    successes = int(judged["success"].sum())
    low, high = wilson(successes, len(judged))
    return {
        "axis": place.axis.name,
        "value": float(place.value),
        "trained": None if place.trained is None else float(place.trained),
        "words": place.axis.words,
        "who": name,
        "episodes": len(judged),
        "successes": successes,
        "success_rate": successes / len(judged),
        "success_low": low,
        "success_high": high,
        "peak_force_mean": float(judged["peak_force"].mean()),
        "peak_force": float(judged["peak_force"].max()),
        "mean_steps": float(judged["steps"].mean()),
        "worst_violation": float(judged["worst_violation"].max()),
    }


def breaks(rows: Sequence[Mapping[str, Any]], name: str, least: float = 0.9) -> dict[str, list[float]]:
    """The places of each axis at which somebody's success rate is below `least`."""
    found: dict[str, list[float]] = {}
    for row in rows:
        if row["who"] == name:
            found.setdefault(row["axis"], []).extend([row["value"]] if row["success_rate"] < least else [])
    return found
