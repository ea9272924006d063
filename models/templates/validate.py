"""Checks of a template beyond those that are made when its file is read.

The checks place the template's objects and the end effector at random near each other, and evaluate the template's
input mappings, active constraints and transitions there. A fault that occurs in less than one of a few hundred poses
may not be found.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from guiderail.models.common.transforms import RigidTransform, RotationMatrix
from guiderail.models.templates.geometry import Frames, pose_distance
from guiderail.models.templates.template import SharedControlTemplate

SAMPLES = 200  # number of sampled poses of the end effector
REACH = 0.6  # largest distance of a sampled pose from an object [m]
TOLERANCE = 1e-9  # largest error that counts as rounding [m or rad]
GREEDY_STEPS = 400  # largest number of steps of a search for a transition
GREEDY_PERIOD = 0.05  # time step of a search [s]
CONTROL_PERIOD = 0.01  # time step of a search close to the threshold of a transition [s]
ARRIVALS = 5  # largest number of searches that approach each transition

Scenes = Sequence[tuple[RigidTransform, Frames]]


@dataclass(frozen=True)
class Finding:
    """Error in a template or remark about it."""

    is_error: bool
    message: str


def validate(template: SharedControlTemplate, seed: int = 0) -> list[Finding]:
    """Return the errors and remarks about a template, errors first; the poses are sampled with `seed`."""
    rng = np.random.default_rng(seed)
    scenes = [_sample_scene(template, rng) for _ in range(SAMPLES)]
    findings = [
        *_find_unused(template),
        *_find_unreachable(template),
        *_check_constraints(template, scenes),
        *_check_transitions(template, scenes),
        *_check_arrivals(template, scenes),
    ]
    return sorted(findings, key=lambda finding: not finding.is_error)


def _sample_scene(
    template: SharedControlTemplate, rng: np.random.Generator
) -> tuple[RigidTransform, dict[str, RigidTransform]]:
    """Return a random pose of the end effector near upright objects at random poses."""
    frames = {}
    for name in template.frames:
        yaw = RotationMatrix.MakeZRotation(rng.uniform(-np.pi, np.pi))
        frames[name] = RigidTransform(yaw, rng.uniform(-0.3, 0.3, 3))
    X_WF = frames[template.frames[rng.integers(len(frames))]] if frames else RigidTransform()
    # The distance is uniform, not the position, because more samples are needed near an object, where constraints meet.
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


def _check_constraints(template: SharedControlTemplate, scenes: Scenes) -> Iterator[Finding]:
    """Check that each constraint and the whole sequence are idempotent, and that no constraint undoes another."""
    for number, state in enumerate(template.states):
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
            if outside[i] == len(scenes):
                why = "contradicts the constraints after it; no pose satisfies them all"
            else:
                why = (
                    f"is undone by a constraint after it in {outside[i] / len(scenes):.0%} of the poses; "
                    "put it last, or make room for both"
                )
            yield Finding(True, f"{state.name}: active constraint {i + 1} ({kind}) {why}")
        if repeated > TOLERANCE and not outside.any():
            yield Finding(True, f"{state.name}: the constraints in their order are not idempotent ({repeated:.2g})")


def _check_transitions(template: SharedControlTemplate, scenes: Scenes) -> Iterator[Finding]:
    """Check that inputs can lead from a pose inside a state's constraints to each of its transitions."""
    for number, state in enumerate(template.states):
        goals = [(f"the transition to {t.to}", t.below) for t in state.transitions]
        goals = goals or [("the end", state.ends_at + TOLERANCE)]
        lowest = min(threshold for _, threshold in goals)
        starts = sorted(
            ((template.project(number, X, frames), frames) for X, frames in scenes),
            key=lambda start: template.distance(number, *start),
        )
        # Search from the nearest pose and from several others: one success proves that the threshold can be reached.
        best = np.inf
        for X, frames in [starts[0], *starts[len(starts) // 2 :: len(starts) // 8]]:
            best = min(best, _greedy(template, number, X, frames, lowest)[0])
            if best < lowest:
                break
        for goal, threshold in goals:
            if best > threshold:
                yield Finding(
                    True,
                    f"{state.name}: {goal} never fires: no sampled pose within the active constraints is there, and no "
                    f"input leads there (nearest {best:.3g}, threshold {threshold:.3g})",
                )
        if all(template.distance(number, X, frames) < lowest for X, frames in starts):
            yield Finding(False, f"{state.name}: every sampled pose is below the threshold; the state is left at once")


def _greedy(
    template: SharedControlTemplate,
    number: int,
    X_WE: RigidTransform,
    frames: Frames,
    threshold: float,
    period: float = GREEDY_PERIOD,
) -> tuple[float, RigidTransform]:
    """Return the least distance, and the last pose, of a greedy search that sets one input to ±1 at every step."""
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


def _check_arrivals(template: SharedControlTemplate, scenes: Scenes) -> Iterator[Finding]:
    """Check that a transition fires at its threshold: one control step must lead into the next state's constraints."""
    reach = GREEDY_PERIOD * max(template.max_speed_m_per_s, template.max_speed_rad_per_s)
    for number, state in enumerate(template.states):
        inside = [(template.project(number, X, frames), frames) for X, frames in scenes]
        for transition in state.transitions:
            target, arrived, waiting, worst = template.index(transition.to), 0, 0, 0.0
            before = [start for start in inside if template.distance(number, *start) >= transition.below]
            for X, frames in before[:ARRIVALS]:
                # The last part uses the control period, because a longer step would overshoot the threshold.
                _, X_WE = _greedy(template, number, X, frames, transition.below + reach)
                distance, X_WE = _greedy(template, number, X_WE, frames, transition.below, CONTROL_PERIOD)
                if distance < transition.below:
                    arrived += 1
                    waiting += not template.can_enter(target, X_WE, frames, CONTROL_PERIOD)
                    worst = max(worst, template.violation(target, X_WE, frames))
            if waiting:
                yield Finding(
                    False,
                    f"{state.name}: the transition to {transition.to} waits in {waiting} of {arrived} arrivals, as the "
                    f"command is up to {worst:.2g} m or rad outside of the next state's constraints; change the "
                    "constraints of either state so that they agree at the threshold",
                )
