"""Encoding of a shared control template as a list of numbers, which the C++ library reads in the same order."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from guiderail.models.common.errors import InputError
from guiderail.models.common.transforms import transform_to_pose
from guiderail.models.templates import SharedControlTemplate, mappings, transitions
from guiderail.models.templates import active_constraints as active
from guiderail.models.templates.parts import WORLD, StatePart, matrix_deg

# Kinds in the order of the enumerations in template.hpp.
MAPPINGS: tuple[type, ...] = (mappings.Translation, mappings.Rotation, mappings.TiltTowards)
CONSTRAINTS: tuple[type, ...] = (
    active.HalfSpace, active.Box, active.Cylinder, active.Sector, active.KeepAbove, active.Funnel,
    active.FixedOrientation, active.TiltLimits, active.TiltByDistance, active.OutsideSphere,
    active.OutsideCylinder, active.OutsideBox, active.InsideSphere,
)  # fmt: skip
DISTANCES: tuple[type, ...] = (
    transitions.Distance, transitions.Height, transitions.AxisDistance, transitions.TiltToGo,
)  # fmt: skip
MAX_INPUTS = 32


def template_arrays(
    template: SharedControlTemplate, frames: Mapping[str, Any], prefix: str = "template/"
) -> dict[str, np.ndarray]:
    """Return the arrays of a template whose object frames have the poses `frames`, transforms by name.

    Raises:
        InputError: If the template has a part of a kind that is not one of guiderail's, or too many inputs.
    """
    if template.inputs > MAX_INPUTS:
        raise InputError(f"a template has at most {MAX_INPUTS} inputs to be exported, not {template.inputs}")
    numbers: list[float] = [len(template.states)]
    for index, state in enumerate(template.states):
        numbers.append(len(state.input_mapping))
        for mapping in state.input_mapping:
            numbers += _mapping(mapping, template.frames)
        numbers.append(len(state.active_constraints))
        for constraint in state.active_constraints:
            numbers += _constraint(constraint, template.frames)
        distance = state.transition_distance
        numbers += [*_head(distance, DISTANCES, template.frames), *_listed(_distance_numbers(distance))]
        exits = template._exits[index]
        numbers += [len(exits), *(float(value) for each in exits for value in each)]
        numbers += template._max_speeds[index]
    poses = [transform_to_pose(frames[name]) for name in template.frames]
    return {
        prefix + "states": np.array(numbers, dtype=float),
        prefix + "frames": np.array(poses, dtype=float).reshape(-1, 6),
        prefix + "inputs": np.array([float(template.inputs)]),
        prefix + "initial_state": np.array([float(template.initial_state)]),
    }


def _listed(values: Sequence[float] | np.ndarray) -> list[float]:
    return [len(values), *(float(value) for value in values)]


def _head(part: StatePart, kinds: tuple[type, ...], frames: Sequence[str]) -> list[float]:
    """Return the number of a part's kind and of its frame: −2 is the tool, −1 the world."""
    if type(part) not in kinds:
        raise InputError(
            f"a template with a part of the kind {type(part).__name__} cannot be exported: use the kinds of guiderail"
        )
    frame = getattr(part, "frame", WORLD)
    number = {WORLD: -1, mappings.TOOL: -2}.get(frame)
    return [kinds.index(type(part)), frames.index(frame) if number is None else number]


def _mapping(mapping: mappings.InputMapping, frames: Sequence[str]) -> list[float]:
    scalings: list[list[float]] = []
    while isinstance(mapping, mappings.Uneven):
        scalings.append([mapping.above, mapping.below])
        mapping = mapping.of
    head = _head(mapping, MAPPINGS, frames)
    is_linear = isinstance(mapping, mappings.Translation)
    speed = mapping.speed_m_per_s if is_linear else mapping.speed_rad_per_s  # type: ignore[attr-defined]
    axes = np.ravel(getattr(mapping, "axes", ()))
    numbers = [len(scalings), *(number for scaling in scalings for number in scaling)]
    return [*numbers, *head, speed, *_listed(mapping.inputs), *_listed(axes)]


def _constraint(constraint: active.ActiveConstraint, frames: Sequence[str]) -> list[float]:
    head = _head(constraint, CONSTRAINTS, frames)
    numbers, xs, ys = _constraint_numbers(constraint)
    return [*head, *_listed(numbers), *_listed(xs), *_listed(ys)]


def _rotation(rpy_deg: tuple[float, ...]) -> list[float]:
    return [float(value) for value in matrix_deg(rpy_deg).ravel()]


def _constraint_numbers(c: Any) -> tuple[Sequence[float], Sequence[float], Sequence[float]]:
    if isinstance(c, active.HalfSpace):
        unit = np.array(c.normal) / np.linalg.norm(c.normal)
        return [*unit, c.offset_m], (), ()
    if isinstance(c, active.Box):
        return [*c.lower_m, *c.upper_m], (), ()
    if isinstance(c, active.Cylinder):
        return [c.min_radius_m, c.max_radius_m], (), ()
    if isinstance(c, active.Sector):
        return [math.radians(c.min_deg), math.radians(c.max_deg)], (), ()
    if isinstance(c, active.KeepAbove):
        return [c.height_m], [float(value) for value in np.ravel(c.points_m)], ()
    if isinstance(c, active.Funnel):
        return [c.radius_m, c.height_m, c.slope], (), ()
    if isinstance(c, active.FixedOrientation):
        return _rotation(c.rpy_deg), (), ()
    if isinstance(c, active.TiltLimits):
        limits = [math.radians(c.min_deg), math.radians(c.max_deg)]
        return [float(c.turns_along), *_rotation(c.rpy_deg), *limits], (), ()
    if isinstance(c, active.TiltByDistance):
        return [float(c.turns_along), *_rotation(c.rpy_deg)], c.distance_m, c.tilt_deg
    if isinstance(c, active.OutsideSphere):
        return [*c.center_m, c.radius_m, 0.0], (), ()
    if isinstance(c, active.OutsideCylinder):
        return [0.0, 0.0, c.min_m, 0.0, 0.0, 1.0, c.max_m - c.min_m, c.radius_m, c.margin_m], (), ()
    if isinstance(c, active.OutsideBox):
        return [*c.lower_m, *c.upper_m, c.margin_m], (), ()
    return [*c.center_m, c.radius_m], (), ()


def _distance_numbers(distance: Any) -> Sequence[float]:
    if isinstance(distance, transitions.Distance):
        return distance.point_m
    if isinstance(distance, transitions.TiltToGo):
        return [math.radians(distance.until_deg), float(distance.turns_along), *_rotation(distance.rpy_deg)]
    return ()
