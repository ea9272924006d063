"""Checks of a shared control template in addition to those when its file is read.

The checks place the template's objects and the end effector at random poses near each other, and evaluate the
template's input mappings, active constraints and transitions there. A fault that occurs in less than one of a few
hundred poses may not be found. An error is proven by a pose or by a contradiction; an unsuccessful search is a remark.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from guiderail.models.common.errors import InputError
from guiderail.models.common.transforms import RigidTransform, RotationMatrix
from guiderail.models.templates.active_constraints import (
    ActiveConstraint,
    Cylinder,
    HalfSpace,
    InsideSphere,
    TiltLimits,
)
from guiderail.models.templates.consistency import find_contradiction
from guiderail.models.templates.parts import Frames, pose_distance
from guiderail.models.templates.schema import load_template, shipped_templates
from guiderail.models.templates.template import SharedControlTemplate, TemplateState, Transition
from guiderail.models.templates.transitions import AxisDistance, Distance, Height, TiltToGo
from guiderail.tools.files import path_exists

SAMPLES = 200  # number of sampled poses of the end effector
REACH = 0.6  # largest distance of a sampled pose from an object [m]
TOLERANCE = 1e-9  # largest error that counts as rounding [m or rad]
GREEDY_STEPS = 400  # largest number of steps of a search for a transition
GREEDY_PERIOD = 0.05  # time step of a search [s]
CONTROL_PERIOD = 0.01  # time step of a search close to the threshold of a transition [s]
ARRIVALS = 5  # largest number of searches that approach each transition

_TEMPLATE_ENDINGS = (".yaml", ".yml")
_SI_UNITS = {"m": "m", "deg": "rad"}  # unit of a loaded transition distance, by the unit in the template file

Scene = tuple[RigidTransform, Frames]  # pose of the end effector, and poses of the objects


@dataclass(frozen=True)
class Finding:
    """Error in a template or remark about it."""

    is_error: bool
    message: str


def describe_template(file: Path, draw: Path | None = None) -> dict[str, Any]:
    """Validate a template and return its inputs, frames, states and transitions, with remarks.

    With `draw`, its state machine is drawn to a .png, .svg, .pdf, .dot or .gv file.
    """
    if not path_exists(file) and str(file) not in shipped_templates():
        raise InputError(
            f"there is no file {file}: name a template (.yaml), or one of {', '.join(shipped_templates())}"
        )
    if path_exists(file) and file.suffix not in _TEMPLATE_ENDINGS:
        raise InputError(f"{file} has the ending {file.suffix!r}: a template is .yaml")
    template = load_template(file)
    findings = validate(template)
    errors = [finding.message for finding in findings if finding.is_error]
    if errors:
        raise InputError(f"{file}: " + "; ".join(message.rstrip(".") for message in errors))
    if draw is not None:
        from guiderail_data.template_drawing import draw as draw_template

        draw_template(template, draw)
    return {
        "file": str(file),
        "template": template.name,
        "inputs": template.inputs,
        "frames": list(template.frames),
        "states": [state.name for state in template.states],
        "transitions": [_describe_transition(s, t) for s in template.states for t in s.transitions],
        "remarks": [finding.message for finding in findings if not finding.is_error],
    }


def _describe_transition(state: TemplateState, transition: Transition) -> str:
    """Return a transition as text, with its unit and the threshold of the transition back."""
    unit = _SI_UNITS[state.transition_distance.unit]
    text = f"{state.name} → {transition.to} below {transition.below:g} {unit}"
    if transition.hysteresis is None:
        return f"{text}, no way back"
    return f"{text}, back above {transition.below + transition.hysteresis:g} {unit}"


def validate(template: SharedControlTemplate, seed: int = 0) -> list[Finding]:
    """Return the errors and remarks about a template, errors first; the poses are sampled with `seed`."""
    rng = np.random.default_rng(seed)
    scenes = [_sample_scene(template, rng) for _ in range(SAMPLES)]
    findings = [
        *_find_unused(template),
        *_find_unreachable(template),
        *_check_constraints(template, scenes),
        *_check_transitions(template, scenes),
    ]
    return sorted(findings, key=lambda finding: not finding.is_error)


def _sample_scene(template: SharedControlTemplate, rng: np.random.Generator) -> Scene:
    """Return a random pose of the end effector near upright objects at random poses."""
    frames = {}
    for name in template.frames:
        yaw = RotationMatrix.MakeZRotation(rng.uniform(-np.pi, np.pi))
        frames[name] = RigidTransform(yaw, rng.uniform(-0.3, 0.3, 3))
    X_WF = frames[template.frames[rng.integers(len(frames))]] if frames else RigidTransform()
    # The distance is uniform, not the position, because more samples are needed near objects, where constraints change.
    p_FE = rng.normal(size=3)
    p_FE *= REACH * rng.uniform() / np.linalg.norm(p_FE)
    R_FE = RotationMatrix(Rotation.random(rng=rng).as_matrix())
    return RigidTransform(X_WF.rotation() @ R_FE, X_WF @ p_FE), frames


def _find_unused(template: SharedControlTemplate) -> Iterator[Finding]:
    used = {i for state in template.states for mapping in state.input_mapping for i in mapping.used_inputs}
    for i in sorted(set(range(template.inputs)) - used):
        yield Finding(False, f"input {i} has no effect in any state; lower `inputs` or map it")
    named = {frame for state in template.states for frame in state.frame_names}
    for frame in sorted(set(template.frames) - named):
        yield Finding(False, f"the frame {frame} is never used; remove it")


def _find_unreachable(template: SharedControlTemplate) -> Iterator[Finding]:
    reached, waiting = set(), [template.initial_state]
    while waiting:
        number = waiting.pop()
        if number not in reached:
            reached.add(number)
            waiting += [template.index(transition.to) for transition in template.states[number].transitions]
    for number, state in enumerate(template.states):
        if number not in reached:
            yield Finding(True, f"no transition leads to the state {state.name}; add one, or remove the state")


def _check_constraints(template: SharedControlTemplate, scenes: Sequence[Scene]) -> Iterator[Finding]:
    """Check that each constraint and the whole sequence are idempotent, and that no constraint undoes another."""
    for number, state in enumerate(template.states):
        if state.contradiction:
            yield Finding(True, state.contradiction)
            continue
        for i, constraint in enumerate(state.active_constraints):
            name = f"{state.name}: active constraint {i + 1} ({type(constraint).__name__})"
            worst = max(constraint.violation(constraint.project(X, frames), frames) for X, frames in scenes)
            if worst > TOLERANCE:
                yield Finding(True, f"{name} is not idempotent: projecting twice moves by {worst:.2g} m or rad")
        outside = np.zeros(len(state.active_constraints))
        repeated = 0.0
        for X, frames in scenes:
            X_WP = template.project(number, X, frames)
            outside += [c.violation(X_WP, frames) > TOLERANCE for c in state.active_constraints]
            repeated = max(repeated, pose_distance(template.project(number, X_WP, frames), X_WP))
        for i in np.flatnonzero(outside).tolist():
            kind = type(state.active_constraints[i]).__name__
            is_always = outside[i] == len(scenes)  # few or no poses satisfy all constraints
            share = "all" if is_always else f"{outside[i] / len(scenes):.0%} of the"
            yield Finding(
                not is_always,
                f"{state.name}: active constraint {i + 1} ({kind}) is undone by a constraint after it in {share} "
                "sampled poses; put it last, or make room for both",
            )
        if repeated > TOLERANCE and not outside.any():
            yield Finding(True, f"{state.name}: the constraints in their order are not idempotent ({repeated:.2g})")


def _check_transitions(template: SharedControlTemplate, scenes: Sequence[Scene]) -> Iterator[Finding]:
    """Check that inputs lead to each transition and to the end, and that one control step leads into the next state.

    A search begins at a pose at which another state made a transition to this state, or at a sampled pose inside the
    constraints if there is none. The search ends at the threshold.
    """
    handovers: dict[int, list[Scene]] = {}
    for number in _in_order(template):
        state = template.states[number]
        if state.contradiction:
            continue
        inside = [(template.project(number, X, frames), frames) for X, frames in scenes]
        goals = [(f"the transition to {t.to}", t.below) for t in state.transitions]
        goals = goals or [("the end", state.ends_at + TOLERANCE)]
        for i, (goal, threshold) in enumerate(goals):
            if _is_excluded(state, threshold):
                yield Finding(
                    True,
                    f"{state.name}: {goal} never fires: no pose within the active constraints is below the threshold "
                    f"{threshold:.3g}; change the threshold or the constraints",
                )
                continue
            starts = _choose_starts(template, number, threshold, handovers.get(number, []), inside)
            arrivals, nearest = _search(template, number, threshold, starts)
            # If no search has led to this state, sampled poses are no evidence of a fault.
            if starts and not arrivals and (number == template.initial_state or number in handovers):
                yield Finding(
                    False,
                    f"{state.name}: {goal} was not reached from any of {len(starts)} poses by one input at a time "
                    f"(nearest {nearest:.3g}, threshold {threshold:.3g}); check that the inputs lead there",
                )
            if state.transitions:
                target = template.index(state.transitions[i].to)
                if arrivals:
                    handovers.setdefault(target, []).extend(arrivals)
                yield from _check_arrivals(template, number, target, arrivals)
        lowest = min(threshold for _, threshold in goals)
        if all(template.distance(number, X, frames) < lowest for X, frames in inside):
            yield Finding(False, f"{state.name}: every sampled pose is below the threshold; the state is left at once")


def _in_order(template: SharedControlTemplate) -> list[int]:
    """Return the numbers of all states, first those that transitions reach from the initial state, in order."""
    order = [template.initial_state]
    for number in order:
        targets = (template.index(transition.to) for transition in template.states[number].transitions)
        order += [target for target in dict.fromkeys(targets) if target not in order]
    return order + [number for number in range(len(template.states)) if number not in order]


def _is_excluded(state: TemplateState, threshold: float) -> bool:
    """Return True if it is proven that the distance of a state is above a threshold within its active constraints."""
    goal: ActiveConstraint
    if threshold <= 0.0 and not state.transition_distance.can_be_negative:
        return True
    match state.transition_distance:
        case Distance(frame, point):
            goal = InsideSphere(threshold, point, frame)
        case AxisDistance(frame):
            goal = Cylinder(frame, 0.0, threshold)
        case Height(frame):
            goal = HalfSpace((0.0, 0.0, -1.0), -threshold, frame)
        case TiltToGo(frame, until_deg, rpy_deg, turns_along) if until_deg - np.rad2deg(threshold) <= 180.0:
            least = max(-180.0, until_deg - float(np.rad2deg(threshold)))
            goal = TiltLimits(frame, least, 180.0, rpy_deg, turns_along)
        case _:
            return False
    return len(state.active_constraints) in find_contradiction((*state.active_constraints, goal))


def _choose_starts(
    template: SharedControlTemplate, number: int, threshold: float, handovers: list[Scene], inside: list[Scene]
) -> list[Scene]:
    """Return poses above a threshold: those of handovers or, if there are none, sampled poses and the nearest one."""
    arrived, sampled = (
        [start for start in starts if template.distance(number, *start) >= threshold] for starts in (handovers, inside)
    )
    if arrived:
        return arrived[:ARRIVALS]
    sampled.sort(key=lambda start: template.distance(number, *start))
    step = max(1, len(sampled) // (2 * ARRIVALS))
    return [*sampled[len(sampled) // 2 :: step][:ARRIVALS], *sampled[:1]]


def _search(
    template: SharedControlTemplate, number: int, threshold: float, starts: list[Scene]
) -> tuple[list[Scene], float]:
    """Return the poses below a threshold that searches from `starts` reach, and the least distance of all searches."""
    reach = GREEDY_PERIOD * max(template.max_speed_m_per_s, template.max_speed_rad_per_s)
    arrivals, nearest = [], np.inf
    for X, frames in starts:
        # The last part uses the control period, because a longer step would overshoot the threshold.
        _, X_WE = _greedy(template, number, X, frames, threshold + reach)
        distance, X_WE = _greedy(template, number, X_WE, frames, threshold, CONTROL_PERIOD)
        nearest = min(nearest, distance)
        if distance < threshold:
            arrivals.append((X_WE, frames))
    return arrivals, nearest


def _greedy(
    template: SharedControlTemplate,
    number: int,
    X_WE: RigidTransform,
    frames: Frames,
    threshold: float,
    period: float = GREEDY_PERIOD,
) -> tuple[float, RigidTransform]:
    """Search greedily, one input set to ±1 at every step; return the least distance and the last pose."""
    candidates = [sign * row for row in np.eye(template.inputs) for sign in (1.0, -1.0)]
    best = template.distance(number, X_WE, frames)
    for _ in range(GREEDY_STEPS):
        options = []
        for inputs in candidates:
            request = template.displace(X_WE, template.map(number, inputs, X_WE, frames, period))
            X = template.command(number, X_WE, request, frames, period).X_WE
            options.append((template.distance(number, X, frames), X))
        distance, X_WE = min(options, key=lambda option: option[0])
        if distance > best - 1e-6 * period:
            return min(best, distance), X_WE
        best = distance
        if best < threshold:
            return best, X_WE
    return best, X_WE


def _check_arrivals(
    template: SharedControlTemplate, number: int, target: int, arrivals: list[Scene]
) -> Iterator[Finding]:
    """Check that a transition fires at its threshold: one control step must lead into the next state's constraints."""
    waiting = sum(not template.can_enter(target, X, frames, CONTROL_PERIOD) for X, frames in arrivals)
    if waiting:
        worst = max(template.violation(target, X, frames) for X, frames in arrivals)
        yield Finding(
            False,
            f"{template.states[number].name}: the transition to {template.states[target].name} waits in {waiting} of "
            f"{len(arrivals)} arrivals, as the command is up to {worst:.2g} m or rad outside of the next state's "
            "constraints; change the constraints of either state so that they agree at the threshold",
        )
