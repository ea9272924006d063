"""What is changed, one thing at a time, and in which steps."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from guiderail.diagrams.stations.station import CONTROL_PERIOD, PLANT_PERIOD
from guiderail.models.errors import InputError
from guiderail.models.registry import did_you_mean
from guiderail.models.units import MM
from guiderail.tools.rollouts.evaluate import hides
from guiderail.tools.tasks import check_environment

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
    from guiderail.diagrams.tasks.bnc_uncertainty import OFFSET_RANGES

    if "offset_range" not in environment:
        raise InputError("nothing here has an offset whose range could be another")
    trained = environment["offset_range"] or OFFSET_RANGES[environment["uncertainty"]]
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
