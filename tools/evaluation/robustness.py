"""`guiderail robustness`: policies judged where they never trained, beside policies that know nothing."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pandas as pd

from guiderail.diagrams.stations.station import CONTROL_PERIOD, PLANT_PERIOD
from guiderail.models.common.errors import InputError
from guiderail.models.common.registry import did_you_mean
from guiderail.models.common.units import MM
from guiderail.models.policy import Policy
from guiderail.tools.environments import changed_environment, check_environment
from guiderail.tools.evaluation.baselines import still
from guiderail.tools.evaluation.evaluate import HELD_OUT_SEED, hides, judged_once
from guiderail.tools.evaluation.metrics import wilson
from guiderail.tools.evaluation.rollout import PolicyFn, check_compatible
from guiderail.tools.learning.run_folder import RunConfig, RunFolder
from guiderail.tools.tables import write_table
from guiderail.tools.visualization.style import is_demonstrated, label, legend, new_figure, save_figure

Environment = Mapping[str, Any]


@dataclass(frozen=True)
class Axis:
    """One thing that is changed.

    Attributes:
        name: as the command takes it.
        words: what it is, with its unit.
        values: in steps, the trained one among them where it has a number.
        trained: what it is where a policy learned without asking for anything else.
        changed: from an environment's arguments and a value to the arguments that differ.
        anew: whether what is hidden in a run is drawn anew in every episode, as it is what is changed.
    """

    name: str
    words: str
    values: tuple[float, ...]
    trained: float
    changed: Callable[[Environment, float], dict[str, Any]]
    anew: bool = False


def _factor(option: str) -> Callable[[Environment, float], dict[str, Any]]:
    return lambda environment, value: {option: (value, value)}


def _plain(option: str, unit: float = 1.0, kind: type = float) -> Callable[[Environment, float], dict[str, Any]]:
    return lambda environment, value: {option: kind(value * unit)}


def _force_and_torque(option: str, lever: float = 0.02) -> Callable[[Environment, float], dict[str, Any]]:
    """A force [N] and the torque that it has at so long a lever [m]."""
    return lambda environment, value: {option: (value, lever * value)}


def _clearance(environment: Environment, value: float) -> dict[str, Any]:
    for option in ("bore_clearance", "clearance"):
        if option in environment:
            return {option: value * environment[option]}
    raise InputError("nothing here has a clearance")


def _offsets(environment: Environment, value: float) -> dict[str, Any]:
    from guiderail.diagrams.tasks.bnc_connector.options import OFFSET_RANGES

    if "offset_range" not in environment:
        raise InputError("nothing here has an offset whose range could be another")
    trained = environment["offset_range"] or OFFSET_RANGES[environment["fixture_offset"]]
    return {"offset_range": tuple(value * distance for distance in trained)}


def _period(environment: Environment, value: float) -> dict[str, Any]:
    return {"control_period": max(round(value * CONTROL_PERIOD / PLANT_PERIOD), 1) * PLANT_PERIOD}


FACTORS = (0.5, 0.7, 1.0, 1.4, 2.0)

AXES = (
    Axis("friction", "friction, times", FACTORS, 1.0, _factor("friction_factor")),
    Axis("modulus", "contact's stiffness, times", (0.1, 0.3, 1.0, 3.0, 10.0), 1.0, _factor("modulus_factor")),
    Axis("stiffness", "impedance's stiffness, times", (1 / 3, 0.6, 1.0, 1.7, 3.0), 1.0, _plain("stiffness_factor")),
    Axis("clearance", "clearance, times", (0.5, 0.75, 1.0, 1.5, 2.0), 1.0, _clearance),
    Axis("offsets", "offsets, new every episode, times", (0.5, 1.0, 1.25, 1.5, 2.0), 1.0, _offsets, anew=True),
    Axis("wrench_scale", "measured wrench, times", FACTORS, 1.0, _factor("wrench_scale")),
    Axis("wrench_bias", "wrench bias up to [N]", (0.0, 0.5, 1.0, 2.0, 4.0), 0.0, _force_and_torque("wrench_bias")),
    Axis("wrench_noise", "wrench noise, σ [N]", (0.0, 0.25, 0.5, 1.0, 2.0), 0.0, _force_and_torque("wrench_noise")),
    Axis("wrench_delay", "wrench late by [steps]", (0, 1, 2, 5, 10), 0, _plain("wrench_delay", kind=int)),
    Axis("pose_bias", "pose error up to [mm]", (0.0, 0.1, 0.3, 0.6, 1.0), 0.0, _plain("pose_bias", MM)),
    Axis("lost", "commands lost, part", (0.0, 0.1, 0.3, 0.5, 0.8), 0.0, _plain("lost_commands")),
    Axis("late", "commands late by [steps]", (0, 1, 2, 5, 10), 0, _plain("late_commands", kind=int)),
    Axis("period", "control period, times", (0.5, 1.0, 1.5, 2.0), 1.0, _period),
    Axis("payload", "ignored payload [kg]", (0.0, 0.1, 0.3, 0.6, 1.0), 0.0, _plain("payload")),
)


def chosen_axes(names: str | None) -> list[Axis]:
    """The axes of such names, comma-separated; all of them for None.

    Raises:
        InputError: for a name that is none.
    """
    if names is None:
        return list(AXES)
    known = {axis.name: axis for axis in AXES}
    wanted = [name.strip() for name in names.split(",") if name.strip()]
    for name in wanted:
        if name not in known:
            raise InputError(f"there is no axis {name!r}: {did_you_mean(name, known)}")
    return [known[name] for name in wanted]


@dataclass(frozen=True)
class Point:
    """One place of one axis.

    Attributes:
        axis, value: where.
        environment: all arguments there.
        trained: the axis's value where the policy learned; None if that is none of them, such as a whole range.
        options: of every reset.
    """

    axis: Axis
    value: float
    environment: Environment
    trained: float | None
    options: Mapping[str, Any] = field(default_factory=dict)


def points(task: str, environment: Environment, axes: Sequence[Axis]) -> tuple[list[Point], list[str]]:
    """The places of some axes that an environment can be made at, and a sentence for each that it can't.

    Raises:
        InputError: if the environment itself can't be made.
    """
    resolved = check_environment(task, environment)
    found, left_out = [], []
    for axis in axes:
        trained = axis.trained if _is_trained(axis, resolved) else None
        for value in axis.values:
            try:
                changed = {} if value == trained else axis.changed(resolved, value)
                if axis.name == "payload" and resolved.get("station") != "arm":
                    raise InputError("a payload hangs from an arm's tool")
                there = {**environment, **_checked(task, resolved, changed)}
                options = {"new_run": True} if axis.anew and hides(task, {**resolved, **there}) else {}
                found.append(Point(axis, value, there, trained, options))
            except InputError as error:
                left_out.append(f"{axis.name} {value:g} is left out: {error}")
    return found, left_out


def _is_trained(axis: Axis, resolved: Environment) -> bool:
    """Whether an environment is at the axis's trained value already, as each is that asks for nothing else."""
    try:
        neutral = axis.changed(resolved, axis.trained)
    except InputError:
        return True
    known = {option: resolved[option] for option in neutral if resolved.get(option) is not None}
    return all(np.allclose(value, neutral[option]) for option, value in known.items())


def _checked(task: str, resolved: Environment, changed: dict[str, Any]) -> dict[str, Any]:
    check_environment(task, {**resolved, **changed})
    return changed


COLUMNS = 4
APART = 0.06  # of the distance between two places, from one who to the next
COLOURS = ("#1f5fbf", "#8a8a8a", "#c0504d", "#4f9d55", "#8064a2", "#d98b2b", "#3aa6a6")


def draw(path: Path, rows: Sequence[Mapping[str, Any]]) -> Path:
    """Writes the picture of a table's rows: two panels for each axis, a line for each who.

    Bars are Wilson's 95 % intervals; of forces the mean over episodes of each one's largest is a line, the largest of
    all a dot. What the policy was trained with is a dashed line.
    """
    table = pd.DataFrame(rows)
    axes = list(dict.fromkeys(table["axis"]))
    columns = min(COLUMNS, len(axes))
    bands = -(-len(axes) // columns)
    figure, panels = new_figure(
        2 * bands, columns, (max(3.2 * columns, 6.4, 1.6 * table["who"].nunique()), 3.6 * bands + 0.5)
    )
    colours = dict(zip(dict.fromkeys(table["who"]), COLOURS * 9, strict=False))
    order = {who: place for place, who in enumerate(colours)}
    for number, name in enumerate(axes):
        success, force = (panels[2 * (number // columns) + part, number % columns] for part in (0, 1))
        of_axis = table[table["axis"] == name]
        places = {value: place for place, value in enumerate(dict.fromkeys(of_axis["value"]))}
        for who, points in of_axis.groupby("who", sort=False):
            # Beside each other: several who always succeed would be one line, and nobody could tell whose.
            x = [places[value] + APART * (order[who] - (len(order) - 1) / 2) for value in points["value"]]
            rate, colour = points["success_rate"], colours[who]
            bars = [rate - points["success_low"], points["success_high"] - rate]
            success.errorbar(
                x, rate, yerr=bars, color=colour, marker="o", markersize=3, capsize=2, label=who.replace("$", r"\$")
            )
            force.plot(x, points["peak_force_mean"], color=colour)
            force.plot(x, points["peak_force"], ".", color=colour)
        for panel in (success, force):
            panel.set_xticks(list(places.values()), [f"{value:.3g}" for value in places])
            trained = of_axis["trained"].iloc[0]
            if trained in places:
                panel.axvline(places[trained], color="0.8", linestyle="--", zorder=0)
        success.set_ylim(-0.03, 1.03)
        force.set_ylim(bottom=0.0)
        force.set_xlabel(of_axis["words"].iloc[0])
        if number % columns == 0:
            success.set_ylabel("success")
            force.set_ylabel("peak force [N]")
    for number in range(len(axes), bands * columns):
        for part in (0, 1):
            panels[2 * (number // columns) + part, number % columns].set_axis_off()
    legend(figure, panels[0, 0])
    return save_figure(figure, path)


EPISODES = 30  # of each who at each place
LONGEST = 120  # characters of a table's name
POLICY, DEMONSTRATION = "policy", "demonstration"  # names in the table

Acts = Callable[[gymnasium.Env], PolicyFn]


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
    baselines: Mapping[str, Acts] | None = None,
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
    for name, acts in (baselines or {}).items():
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
    others = [*([one.name for one in policies] if len(policies) > 1 else []), *sorted(baselines or {})]
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
        _Who(
            name,
            partial(check_compatible, Policy.load(folder.path), learned_in=config.environment),
            config,
            one,
            _digest(folder),
        )
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
        "max_commanded_violation": float(judged["max_commanded_violation"].max()),
    }


def breaks(rows: Sequence[Mapping[str, Any]], name: str, least: float = 0.9) -> dict[str, list[float]]:
    """The places of each axis at which somebody's success rate is below `least`."""
    found: dict[str, list[float]] = {}
    for row in rows:
        if row["who"] == name:
            found.setdefault(row["axis"], []).extend([row["value"]] if row["success_rate"] < least else [])
    return found
