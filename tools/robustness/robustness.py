"""`guiderail robustness`: policies judged where they never trained, beside policies that know nothing."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import pandas as pd

from guiderail.models.errors import InputError
from guiderail.models.policy import Policy
from guiderail.tools.guidance import is_demonstrated, label
from guiderail.tools.learning.run_folder import RunConfig, RunFolder
from guiderail.tools.report.statistics import wilson
from guiderail.tools.robustness.axes import Axis, Point, chosen_axes, points
from guiderail.tools.robustness.picture import draw
from guiderail.tools.rollouts.evaluate import HELD_OUT_SEED, judged_once
from guiderail.tools.rollouts.null_policies import still
from guiderail.tools.rollouts.rollout import Act
from guiderail.tools.rollouts.suited import as_learned
from guiderail.tools.tables import write_table
from guiderail.tools.tasks import changed_environment

EPISODES = 30  # of each who at each place
LONGEST = 120  # characters of a table's name
POLICY, DEMONSTRATION = "policy", "demonstration"  # names in the table

Acts = Callable[[gymnasium.Env], Act]


@dataclass(frozen=True)
class _Who:
    """Somebody who acts, in a run's environment.

    Attributes:
        name: in the table.
        acts: for an environment.
        config: of the run.
        environment: its arguments, with those that are other ones throughout.
        about: what its episodes depend on beside its name.
    """

    name: str
    acts: Acts
    config: RunConfig
    environment: Mapping[str, Any]
    about: str | None = None


def robustness(
    runs: Sequence[Path],
    *,
    episodes: int = EPISODES,
    seed: int = HELD_OUT_SEED,
    environment: Mapping[str, Any] | None = None,
    axes: str | None = None,
    beside: Mapping[str, Acts] | None = None,
    out: Path | None = None,
    tell: Callable[[str], None] = lambda words: None,
) -> dict[str, Any]:
    """Judges runs' policies along each axis by itself, the rest being as it was where each of them learned.

    Every place's episodes are kept in the folder, so that whoever is interrupted goes on, and a further run costs
    only its own episodes.

    Args:
        runs: folders of runs of one task. Whoever else acts does so through the guidance of the first.
        episodes: held-out ones, the same for all who act, at each place.
        seed: of the first.
        environment: arguments of the environment that are other ones throughout, such as the station.
        axes: names of axes, comma-separated; all unless given.
        beside: who else acts, by name.
        out: the folder that is written; in the run, named as its station, unless given. Several runs need it.
        tell: is told in what runs differ, which places are left out, and how far it has come.

    Returns:
        `table` and `picture`, the files; `rows`, the table's; `policies`, what the runs' policies are called.

    Raises:
        InputError: if there is no trained run, runs are of different tasks, or an argument makes no sense.
    """
    if episodes < 1:
        raise InputError(f"robustness needs at least one episode at each place, not {episodes}")
    policies = _policies(runs, dict(environment or {}), tell)
    if out is None and len(runs) > 1:
        raise InputError("say with --out where the table and the picture of several runs go")
    first = policies[0]
    who = list(policies)
    if is_demonstrated(first.environment.get("guidance")):
        who.append(_Who(DEMONSTRATION, still, first.config, first.environment))
    for name, acts in (beside or {}).items():
        if name != "zero" or len(who) == len(policies):
            who.append(_Who(name, acts, first.config, first.environment))
    out = runs[0] / "robustness" / str(first.environment.get("station", "")) if out is None else out
    places = _places(who, chosen_axes(axes), tell)
    rows: list[dict[str, Any]] = []
    for number, (one, place) in enumerate(places, start=1):
        words = f"{number}/{len(places)} {place.axis.name} {place.value:.3g} {one.name}"
        options = {"options": dict(place.options)} if place.options else {}
        judged = judged_once(
            out / "episodes", one.name, one.config, one.acts, place.environment,
            about=one.about, episodes=episodes, seed=seed, words=words, **options,
        )  # fmt: skip
        if judged is not None:
            rows.append(_row(place, one.name, judged))
    if not rows:
        raise InputError("none of these axes can be changed here: choose others with --axes")
    asked = dict(environment or {})
    asked |= {"episodes": episodes} if episodes != EPISODES else {}
    asked |= {"seed": seed} if seed != HELD_OUT_SEED else {}
    others = [*([one.name for one in policies] if len(policies) > 1 else []), *sorted(beside or {})]
    table = write_table(out / f"{_called(axes, asked, others)}.csv", rows).with_suffix(".csv")
    picture = draw(table.with_suffix(".png"), rows)
    return {"table": table, "picture": picture, "rows": rows, "policies": [one.name for one in policies]}


def _policies(runs: Sequence[Path], environment: Mapping[str, Any], tell: Callable[[str], None]) -> list[_Who]:
    """The runs' policies: one is called so, several by their guidance, and by their folder where that is the same."""
    if not runs:
        raise InputError("robustness needs the folder of a run")
    folders = [RunFolder(run) for run in runs]
    configs = [folder.config() for folder in folders]
    tasks = sorted({config.task for config in configs})
    if len(tasks) > 1:
        raise InputError(f"runs that are compared are of one task, not of {' and '.join(tasks)}")
    kinds = [label(str(config.environment.get("guidance"))) for config in configs]
    names = [POLICY] if len(runs) == 1 else kinds if len(set(kinds)) == len(kinds) else [run.name for run in runs]
    if len(set(names)) < len(names):
        raise InputError("runs that are compared are different ones, in folders of different names")
    where = [changed_environment(config.task, config.environment, environment) for config in configs]
    asked: list[dict[str, Any]] = [{"seed": config.seed, **one} for config, one in zip(configs, where, strict=True)]
    everything = sorted({key for one in asked for key in one})
    differing = [key for key in everything if any(one.get(key) != asked[0].get(key) for one in asked)]
    if differing:
        tell(f"the runs differ in {', '.join(differing)}")
    return [
        _Who(name, partial(as_learned, Policy.load(folder.path)), config, one, _digest(folder))
        for name, folder, config, one in zip(names, folders, configs, where, strict=True)
    ]


def _digest(folder: RunFolder) -> str:
    return _short_digest((folder.path / "policy.safetensors").read_bytes())


def _short_digest(content: bytes) -> str:
    return hashlib.blake2b(content, digest_size=8).hexdigest()


def _places(who: Sequence[_Who], axes: Sequence[Axis], tell: Callable[[str], None]) -> list[tuple[_Who, Point]]:
    """Who is judged where, place by place, so that a table that is not finished compares all who act."""
    told: set[str] = set()
    found: list[list[tuple[_Who, Point]]] = []
    for one in who:
        where, left_out = points(one.config.task, one.environment, axes)
        found.append([(one, point) for point in where])
        for sentence in left_out:
            if sentence not in told:
                tell(sentence)
            told.add(sentence)
    order = {(axis.name, value): i for i, (axis, value) in enumerate((a, v) for a in axes for v in a.values)}
    return sorted((pair for pairs in found for pair in pairs), key=lambda pair: order[pair[1].axis.name, pair[1].value])


def _called(axes: str | None, asked: Mapping[str, Any], who: Sequence[str]) -> str:
    """The name of a table, by what was asked for, and of whom: another question does not replace its answer."""
    words = [] if axes is None else [axis.name for axis in chosen_axes(axes)]
    words += [f"{key}={value}" for key, value in sorted(asked.items())]
    name = re.sub(r"[^\w.=-]+", "_", "-".join(["robustness", *words, *who]))
    # A file's name has at most 255 bytes.
    return name if len(name) <= LONGEST else f"{name[:LONGEST]}-{_short_digest(name.encode())}"


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
