"""Robustness of policies: success rate and force under disturbances that they were not trained with."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from guiderail.diagrams.guidance.registry import is_demonstrated
from guiderail.diagrams.stations.station import CONTROL_PERIOD, PLANT_PERIOD
from guiderail.models.common.errors import InputError, brief
from guiderail.models.common.registry import did_you_mean
from guiderail.models.common.transforms import MM
from guiderail.models.primitives.io import find_repeated
from guiderail.tools.environments import check_environment
from guiderail.tools.evaluation.baselines import MakePolicy, digest_of, zero_policy
from guiderail.tools.evaluation.episode import HELD_OUT_SEED, check_seed
from guiderail.tools.evaluation.evaluate import check_num_episodes, evaluate_once
from guiderail.tools.evaluation.evaluation import POLICY
from guiderail.tools.evaluation.forks import check_processes
from guiderail.tools.evaluation.metrics import summary
from guiderail.tools.evaluation.subject import (
    Subject,
    default_baselines,
    find_subject,
    has_constant_offset,
    make_baselines,
)
from guiderail.tools.learning.run_folder import RunConfig
from guiderail.tools.tables import write_table
from guiderail.tools.visualization.figures import label, legend, new_figure, save_figure

Environment = Mapping[str, Any]


@dataclass(frozen=True)
class Axis:
    """Disturbance of the environment, varied over several values."""

    name: str  # name in `--axes`
    label: str  # label of the plot's axis, with the unit
    values: tuple[float, ...]  # values, including the default
    default: float  # value that the default options have
    # Function from an environment's options and a value to the options that change.
    change: Callable[[Environment, float], dict[str, Any]]
    # True if the axis changes the hidden values of a run, which are therefore sampled again in every episode.
    resamples: bool = False


def _range(option: str) -> Callable[[Environment, float], dict[str, Any]]:
    return lambda environment, value: {option: (value, value)}


def _scalar(option: str, unit: float = 1.0, kind: type = float) -> Callable[[Environment, float], dict[str, Any]]:
    return lambda environment, value: {option: kind(value * unit)}


def _force_and_torque(option: str) -> Callable[[Environment, float], dict[str, Any]]:
    """Return the `change` of an option (force [N], torque [Nm]).

    The value on the axis is the force; the torque is the force times a lever arm of 0.02 m.
    """
    return lambda environment, value: {option: (value, 0.02 * value)}


def _clearance(environment: Environment, value: float) -> dict[str, Any]:
    for option in ("bore_clearance", "clearance"):
        if option in environment:
            return {option: value * environment[option]}
    raise InputError("the task has no clearance")


def _offsets(environment: Environment, value: float) -> dict[str, Any]:
    from guiderail.diagrams.tasks.bnc_connector import OFFSET_RANGES
    from guiderail.diagrams.tasks.options import NEGLIGIBLE_OFFSET

    if "offset_range" not in environment:
        raise InputError("the task has no range of offsets")
    default = environment["offset_range"] or OFFSET_RANGES[environment["fixture_offset"]]
    low, high = (value * distance for distance in default)
    # fixture_offset=none refuses offsets above `NEGLIGIBLE_OFFSET`; per_episode samples them in the same way.
    is_refused = environment["fixture_offset"] == "none" and high > NEGLIGIBLE_OFFSET
    return {"offset_range": (low, high)} | ({"fixture_offset": "per_episode"} if is_refused else {})


def _period(environment: Environment, value: float) -> dict[str, Any]:
    period = environment["control_period"] or CONTROL_PERIOD
    return {"disturbances.clock_factor": max(round(value * period / PLANT_PERIOD), 1) * PLANT_PERIOD / period}


FACTORS = (0.5, 0.7, 1.0, 1.4, 2.0)

AXES = (
    Axis("friction", "friction (factor)", FACTORS, 1.0, _range("disturbances.friction_factor")),
    Axis(
        "modulus", "contact stiffness (factor)", (0.1, 0.3, 1.0, 3.0, 10.0), 1.0, _range("disturbances.modulus_factor")
    ),
    Axis(
        "stiffness",
        "impedance stiffness (factor)",
        (1 / 3, 0.6, 1.0, 1.7, 3.0),
        1.0,
        _scalar("disturbances.stiffness_factor"),
    ),
    Axis("clearance", "clearance (factor)", (0.5, 0.75, 1.0, 1.5, 2.0), 1.0, _clearance),
    Axis("offsets", "offsets per episode (factor)", (0.5, 1.0, 1.25, 1.5, 2.0), 1.0, _offsets, resamples=True),
    Axis("wrench_scale", "measured wrench (factor)", FACTORS, 1.0, _range("sensing.wrench_scale")),
    Axis(
        "wrench_bias", "max. wrench bias [N]", (0.0, 0.5, 1.0, 2.0, 4.0), 0.0, _force_and_torque("sensing.wrench_bias")
    ),
    Axis(
        "wrench_noise",
        "wrench noise, σ [N]",
        (0.0, 0.25, 0.5, 1.0, 2.0),
        0.0,
        _force_and_torque("sensing.wrench_noise"),
    ),
    Axis("wrench_delay", "wrench delay [steps]", (0, 1, 2, 5, 10), 0, _scalar("sensing.wrench_delay", kind=int)),
    Axis("pose_bias", "max. pose bias [mm]", (0.0, 0.1, 0.3, 0.6, 1.0), 0.0, _scalar("sensing.pose_bias", MM)),
    Axis("lost", "fraction of commands lost", (0.0, 0.1, 0.3, 0.5, 0.8), 0.0, _scalar("disturbances.lost_commands")),
    Axis("late", "command delay [steps]", (0, 1, 2, 5, 10), 0, _scalar("disturbances.late_commands", kind=int)),
    Axis("period", "control period (factor)", (0.5, 1.0, 1.5, 2.0), 1.0, _period),
    Axis("payload", "unmodeled payload [kg]", (0.0, 0.1, 0.3, 0.6, 1.0), 0.0, _scalar("disturbances.payload")),
    Axis("joint_friction", "joint friction [Nm]", (0.0, 0.1, 0.3, 0.7), 0.0, _scalar("disturbances.joint_friction")),
)
ONLY_ON_ARM = ("payload", "joint_friction")  # names of axes


def select_axes(names: str | None) -> list[Axis]:
    """Return the axes of comma-separated names; all axes for None.

    Raises:
        InputError: For an unknown name.
    """
    if names is None:
        return list(AXES)
    known = {axis.name: axis for axis in AXES}
    selected = [name.strip() for name in names.split(",") if name.strip()]
    for name in selected:
        if name not in known:
            raise InputError(f"there is no axis {name!r}: {did_you_mean(name, known)}")
    return [known[name] for name in selected]


@dataclass(frozen=True)
class Point:
    """One value of one axis."""

    axis: Axis
    value: float  # value on the axis
    environment: Environment  # options of the environment with this value
    trained: float | None  # the axis's default if the policy was trained with it, otherwise None (unknown)
    options: Mapping[str, Any] = field(default_factory=dict)  # options of every reset


def points(task: str, environment: Environment, axes: Sequence[Axis]) -> tuple[list[Point], list[str]]:
    """Return the points of `axes` that an environment supports, and sentences about the points that are left out.

    There is one sentence for each axis and reason. If all points of an axis with a disturbance are left out, the point
    without a disturbance is left out too.

    Raises:
        InputError: If the environment itself is invalid.
    """
    resolved = check_environment(task, environment)
    result, left_out = [], []
    for axis in axes:
        trained = axis.default if _is_default(axis, resolved) else None
        reasons: dict[str, list[str]] = {}
        axis_points = []
        for value in axis.values:
            try:
                changes = {} if value == trained else axis.change(resolved, value)
                if axis.name in ONLY_ON_ARM and resolved.get("station") != "arm":
                    raise InputError("only an arm has it")
                check_environment(task, {**resolved, **changes})
                changed = {**environment, **changes}
                needs_new_run = axis.resamples and has_constant_offset(task, {**resolved, **changed})
                options = {"new_run": True} if needs_new_run else {}
                axis_points.append(Point(axis, value, changed, trained, options))
            except InputError as error:
                reasons.setdefault(str(error).partition(": choose one of")[0], []).append(f"{value:g}")
        if reasons and axis_points and all(point.value == axis.default for point in axis_points):
            next(iter(reasons.values())).insert(0, f"{axis.default:g}")
            axis_points = []
        result += axis_points
        left_out += [f"{axis.name} {', '.join(values)} left out: {reason}" for reason, values in reasons.items()]
    return result, left_out


def _is_default(axis: Axis, resolved: Environment) -> bool:
    """Return True if an environment has the default value of an axis."""
    try:
        neutral = axis.change(resolved, axis.default)
    except InputError:
        return True
    if resolved.get("sensing", "exact") != "exact" and any(resolved.get(option, 0) is None for option in neutral):
        return False  # `sensing` sets the value, so it is not the default
    known = {option: resolved[option] for option in neutral if resolved.get(option) is not None}
    return all(np.allclose(value, neutral[option]) for option, value in known.items())


COLUMNS = 4  # largest number of axes next to each other in the picture
SPACING = 0.06  # distance between the markers of two policies, as a fraction of the distance between two values
COLORS = ("#1f5fbf", "#8a8a8a", "#c0504d", "#4f9d55", "#8064a2", "#d98b2b", "#3aa6a6")


def draw(path: Path, rows: Sequence[Mapping[str, Any]]) -> Path:
    """Draw the rows of a table to a picture: success rate and force over each axis, with a line for each policy.

    Bars are Wilson's 95 % intervals. A solid line shows the mean of the episodes' peak forces, a dot the largest peak
    force. A dashed line marks the value that the first policy was trained with.

    Raises:
        InputError: If the picture cannot be written.
    """
    table = pd.DataFrame(rows)
    axes = list(dict.fromkeys(table["axis"]))
    columns = min(COLUMNS, len(axes))
    bands = -(-len(axes) // columns)
    size = (max(3.2 * columns, 6.4, 1.6 * table["policy"].nunique()), 3.6 * bands + 0.5)
    figure, grid = new_figure(2 * bands, columns, size)
    panels = grid.reshape(bands, 2, columns).swapaxes(1, 2).reshape(-1, 2)  # success and force of each axis
    colors = dict(zip(dict.fromkeys(table["policy"]), COLORS * 9, strict=False))
    order = {name: position for position, name in enumerate(colors)}
    for number, (name, (success, force)) in enumerate(zip(axes, panels, strict=False)):
        of_axis = table[table["axis"] == name]
        positions = {value: position for position, value in enumerate(dict.fromkeys(of_axis["value"]))}
        for policy, of_policy in of_axis.groupby("policy", sort=False):
            # Shifted sideways, because lines of equal success rates would hide each other.
            shift = SPACING * (order[policy] - (len(order) - 1) / 2)
            x = [positions[value] + shift for value in of_policy["value"]]
            rate, color = of_policy["success_rate"], colors[policy]
            bars = [rate - of_policy["success_low"], of_policy["success_high"] - rate]
            text = policy.replace("$", r"\$")
            success.errorbar(x, rate, yerr=bars, color=color, marker="o", markersize=3, capsize=2, label=text)
            force.plot(x, of_policy["peak_force_mean"], color=color)
            force.plot(x, of_policy["peak_force"], ".", color=color)
        for panel in (success, force):
            panel.set_xticks(list(positions.values()), [f"{value:.3g}" for value in positions])
            trained = of_axis["trained"].iloc[0]
            if trained in positions:
                panel.axvline(positions[trained], color="0.8", linestyle="--", zorder=0)
        success.set_ylim(-0.03, 1.03)
        force.set_ylim(bottom=0.0)
        force.set_xlabel(of_axis["label"].iloc[0])
        if number % columns == 0:
            success.set_ylabel("success rate")
            force.set_ylabel("peak force [N]")
    for panel in panels[len(axes) :].flat:
        panel.set_axis_off()
    legend(figure, panels[0, 0])
    return save_figure(figure, path)


EPISODES = 30  # default number of episodes of each policy at each point
MAX_NAME_LENGTH = 120  # largest number of characters of a table's name
DEMONSTRATION = "demonstration"  # name of the zero policy if the guidance then follows the demonstrations


@dataclass(frozen=True)
class _Actor:
    """Policy in the environment of a run."""

    name: str  # name in the table
    make_policy: MakePolicy  # function from an environment to the policy
    # Configuration of the run, with the `environment` options given to `robustness`.
    config: RunConfig
    about: str | None = None  # digest of the policy; None for a baseline policy that its name identifies
    is_stored: bool = True  # False if nothing identifies the policy


def robustness(
    policies: Sequence[Path | str],
    *,
    task: str | None = None,
    episodes: int = EPISODES,
    seed: int = HELD_OUT_SEED,
    environment: Mapping[str, Any] | None = None,
    axes: str | None = None,
    baselines: Mapping[str, MakePolicy] | Sequence[str] | None = (),
    out: Path | None = None,
    log: Callable[[str], None] = lambda sentence: None,
    processes: int | None = None,
    trust_policy: bool = False,
) -> dict[str, Any]:
    """Evaluate policies under one disturbance at a time; the rest of the environment is as in training.

    The episodes of every point are stored in the folder `out`. The same call resumes an interrupted evaluation, and if
    a run is added, only its episodes are simulated.

    Args:
        policies: Runs of one task; with `task`, any policies that `find_subject` takes. Baseline policies act in the
            environment of the first policy.
        task: Task of policies without a run.
        episodes: Number of held-out episodes of each policy at each point, with the same seeds.
        seed: Seed of the first episode.
        environment: Options of the environment that differ from training at all points, such as the station.
        axes: Names of axes, comma-separated; all by default.
        baselines: Baseline policies: their names, or functions that make them, by name; None for the default set of
            the task without "constant". A name that is among `policies` too is evaluated once. Episodes of functions
            other than `partial(BaselinePolicy, FACTORY)` are not stored.
        out: Folder to write; by default `robustness/<station>` in the run. Required for several policies, and for a
            policy without a run. The names of the policies are then part of the table's name.
        log: Function called with a sentence on the differences between the runs, and the sentences of `points`.
        processes: Largest number of processes; None for the number of cores. The results do not depend on it.
        trust_policy: True to read a policy file that can execute code.

    Returns:
        `table` and `picture`, the paths of the files; `rows`, the table's rows; `policies`, the names of the policies,
        without baseline policies.

    Raises:
        InputError: If there is no trained run, runs are of different tasks, two policies have the same name, an
            argument is invalid or missing, or all points are left out.
    """
    episodes, seed, processes = check_num_episodes(episodes), check_seed(seed), check_processes(processes)
    subjects = [find_subject(policy, task, environment, trust_policy=trust_policy) for policy in policies]
    compared = _actors(subjects, dict(environment or {}), log)
    first, folder = compared[0].config, subjects[0].folder if subjects[0].is_stored else None
    if out is None and (len(policies) > 1 or folder is None):
        raise InputError("several runs, or a policy without a run, need a folder for table and picture: give --out")
    are_functions = isinstance(baselines, Mapping)
    if baselines is None:
        baselines = [name for name in default_baselines(first.task, first.environment) if name != "constant"]
    baselines = make_baselines(first, first.environment, baselines)
    actors = [*compared, *_baseline_actors(compared, baselines, are_functions=are_functions)]
    names = [actor.name for actor in compared] if len(compared) > 1 else [] if out is None else [subjects[0].name]
    if out is None:
        assert folder is not None
        out = folder.path / "robustness" / str(first.environment.get("station", ""))
    jobs = _jobs(actors, select_axes(axes), log)
    rows: list[dict[str, Any]] = []
    for number, (actor, point) in enumerate(jobs, start=1):
        progress = f"{number}/{len(jobs)} {point.axis.name} {point.value:.3g} {actor.name}"
        options = {"options": dict(point.options)} if point.options else {}
        evaluated = evaluate_once(
            out / "episodes" if actor.is_stored else None,
            actor.name, actor.config, actor.make_policy, point.environment,
            about=actor.about, episodes=episodes, seed=seed, label=progress, processes=processes, **options,
        )  # fmt: skip
        if evaluated is not None:
            rows.append(_row(point, actor.name, evaluated))
    if not rows:
        raise InputError("the environment has none of these axes: choose others with --axes")
    given = dict(environment or {})
    given |= {"episodes": episodes} if episodes != EPISODES else {}
    given |= {"seed": seed} if seed != HELD_OUT_SEED else {}
    table = write_table(out / _table_name(axes, given, [*names, *sorted(baselines)]), rows).with_suffix(".csv")
    picture = draw(table.with_suffix(".png"), rows)
    return {"table": table, "picture": picture, "rows": rows, "policies": [actor.name for actor in compared]}


def _actors(subjects: Sequence[Subject], environment: Mapping[str, Any], log: Callable[[str], None]) -> list[_Actor]:
    """Return the policies; several are named by their guidance, or by their folders if two have the same guidance."""
    if not subjects:
        raise InputError("robustness needs the folder of a run")
    configs = [subject.config for subject in subjects if subject.config is not None]
    tasks = sorted({config.task for config in configs})
    if len(tasks) > 1:
        raise InputError(f"compared runs have one task, not {' and '.join(tasks)}")
    kinds = [label(str(config.environment.get("guidance"))) for config in configs]
    names = [POLICY] if len(subjects) == 1 else kinds
    if len(set(names)) < len(names):
        names = [subject.name for subject in subjects]
    if len(set(names)) < len(names):
        raise InputError("two compared runs have the same name: give each run once, in a folder with its own name")
    changed = [subject.changed_environment(environment) for subject in subjects]
    settings: list[dict[str, Any]] = [
        {"seed": config.seed, **options} for config, options in zip(configs, changed, strict=True)
    ]
    keys = sorted(set().union(*settings))
    if differing := [key for key in keys if any(values.get(key) != settings[0].get(key) for values in settings)]:
        log(f"the runs differ in {', '.join(differing)}")
    return [
        _Actor(name, subject.make_policy, replace(config, environment=options), subject.digest)
        for name, subject, config, options in zip(names, subjects, configs, changed, strict=True)
    ]


def _baseline_actors(
    compared: Sequence[_Actor], baselines: Mapping[str, MakePolicy], *, are_functions: bool
) -> list[_Actor]:
    """Return the demonstration alone and the baseline policies that are not among the compared policies by name.

    With `are_functions`, `baselines` are functions of the caller. Their episodes are stored only if `digest_of`
    identifies the function.

    Raises:
        InputError: If two policies have the same name.
    """
    config = compared[0].config
    actors = []
    if is_demonstrated(config.environment.get("guidance")):
        actors.append(_Actor(DEMONSTRATION, zero_policy, config))
        baselines = {name: make_policy for name, make_policy in baselines.items() if name != "zero"}
    by_name = {actor.name for actor in compared if actor.about == actor.name}
    for name, make_policy in baselines.items():
        if are_functions:
            about = digest_of(make_policy)
            actors.append(_Actor(name, make_policy, config, about, is_stored=about is not None))
        elif name not in by_name:
            actors.append(_Actor(name, make_policy, config))
    if repeated := find_repeated([actor.name for actor in (*compared, *actors)]):
        raise InputError(f"two policies are called {brief(repeated)}: rename a policy, or leave the baseline out")
    return actors


def _jobs(actors: Sequence[_Actor], axes: Sequence[Axis], log: Callable[[str], None]) -> list[tuple[_Actor, Point]]:
    """Return all pairs of policy and point, point by point, so that an incomplete table compares all policies."""
    sentences: dict[str, None] = {}
    pairs: list[tuple[_Actor, Point]] = []
    for actor in actors:
        result, left_out = points(actor.config.task, actor.config.environment, axes)
        pairs += [(actor, point) for point in result]
        sentences |= dict.fromkeys(left_out)
    for sentence in sentences:
        log(sentence)
    order = {(axis.name, value): i for i, (axis, value) in enumerate((a, v) for a in axes for v in a.values)}
    return sorted(pairs, key=lambda pair: order[pair[1].axis.name, pair[1].value])


def _table_name(axes: str | None, given: Mapping[str, Any], policies: Sequence[str]) -> str:
    """Return a table name that contains the arguments, so that other arguments do not overwrite the table."""
    parts = [] if axes is None else [axis.name for axis in select_axes(axes)]
    parts += [f"{key}={value}" for key, value in sorted(given.items())]
    name = re.sub(r"[^\w.=-]+", "_", "-".join(["robustness", *parts, *policies]))
    if len(name) <= MAX_NAME_LENGTH:
        return name
    return f"{name[:MAX_NAME_LENGTH]}-{hashlib.blake2b(name.encode(), digest_size=8).hexdigest()}"


def _row(point: Point, policy: str, rows: pd.DataFrame) -> dict[str, Any]:
    """Return the row of the table for a policy's episodes at a point."""
    return {
        "axis": point.axis.name,
        "value": float(point.value),
        "trained": None if point.trained is None else float(point.trained),
        "label": point.axis.label,
        "policy": policy,
        "episodes": len(rows),
        "successes": int(rows["success"].sum()),
        **summary(rows, ("success_rate", "success_low", "success_high")),
        "peak_force_mean": float(rows["peak_force"].mean()),
        **summary(rows, ("peak_force", "mean_steps", "max_commanded_violation")),
    }


def values_below(rows: Sequence[Mapping[str, Any]], policy: str) -> dict[str, list[float]]:
    """Return, by axis, the values at which a policy's success rate is below 90 %."""
    result: dict[str, list[float]] = {}
    for row in rows:
        if row["policy"] == policy:
            result.setdefault(row["axis"], []).extend([row["value"]] if row["success_rate"] < 0.9 else [])
    return result
